"""Keys of block.toml without cameras and unknowns: frame, corrections, trajectory, default sigmas, datum."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, StrictBool, StrictStr, model_validator

from jaxphoto.block import Datum, Frame
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Corrections
from jaxphoto.georeferencing.map_frame import check_heights, map_system
from jaxphoto.io.block_folder.camera_section import Camera, read_camera
from jaxphoto.io.block_folder.table_layout import LAYOUTS, PLACE, TOML
from jaxphoto.io.toml import Count, KeyMistake, Keys, Number, Positive, Section, Vector
from jaxphoto.variants import MODES

_SIGMAS = (
    "image_mm", "image_px", "control_m", "control_X_m", "control_Y_m", "control_Z_m", "station_m", "attitude_deg",
)  # fmt: skip
_Texts = list[StrictStr]


class FrameKeys(Keys):
    """Keys of [frame]."""

    kind: Literal["local", "enu", "grid", "epsg"] = "local"
    code: Count | None = None
    vertical: Annotated[Count | None, BeforeValidator(lambda v: None if v == "ellipsoidal" else v)] = None
    yaw: Literal["true", "grid"] = "true"
    origin: Vector | None = None

    @model_validator(mode="after")
    def _check(self) -> "FrameKeys":
        if self.kind != "epsg":
            for key in sorted(self.model_fields_set - {"kind"}):
                raise KeyMistake(key, 'only kind = "epsg" has this key; remove it')
            return self
        if self.code is None:
            raise KeyMistake("code", "the key is missing; add it")
        key = "code"
        try:
            system = map_system(self.code)
            key = "vertical"
            if self.vertical is not None:
                check_heights(self.code, self.vertical)
        except InputError as error:
            raise KeyMistake(key, str(error)) from None
        if self.origin is not None and (abs(self.origin[0]) > 360 or abs(self.origin[1]) > 90):
            raise KeyMistake(
                "origin", "this is not a position; give [longitude, latitude, height] in degrees and metres"
            )
        if self.yaw == "grid" and system.is_geographic:
            raise KeyMistake("yaw", f'EPSG:{self.code} has no grid; write yaw = "true"')
        return self


class CorrectionKeys(Keys):
    """Keys of [corrections]."""

    refraction: StrictBool = False
    curvature: StrictBool = False
    sea_level_m: Number | None = None


class TrajectoryKeys(Keys):
    """Keys of [trajectory]."""

    file: StrictStr
    shift_s: Number = 0.0
    max_gap_s: Positive | None = None


class DatumKeys(Keys):
    """Keys of [datum]."""

    kind: Literal["control", "minimal", "inner"] = "control"
    over: Any = "points"
    scale: StrictBool | None = None

    @model_validator(mode="after")
    def _check(self) -> "DatumKeys":
        for key in sorted(self.model_fields_set - {"kind"}) if self.kind != "inner" else ():
            raise KeyMistake(key, f'only kind = "inner" has this key; remove it or change kind from "{self.kind}"')
        ids = isinstance(self.over, list) and self.over and all(isinstance(point, str) for point in self.over)
        if not ids and self.over not in ("points", "images"):
            raise KeyMistake("over", 'write "points", "images" or a list of ids as text, like ["1", "2", "3"]')
        return self


class GeoreferencingKeys(Keys):
    """Keys of [georeferencing]."""

    mode: Literal[tuple(MODES)] = "integrated"  # type: ignore[valid-type]


class BlockKeys(Keys):
    """Keys of block.toml."""

    title: StrictStr = ""
    frame: FrameKeys = FrameKeys()
    corrections: CorrectionKeys = CorrectionKeys()
    trajectory: TrajectoryKeys | None = None
    sigmas: dict[str, Positive] = {}  # noqa: RUF012
    cameras: dict[str, Any] = {}  # noqa: RUF012
    mounts: dict[str, Any] = {}  # noqa: RUF012
    strips: dict[str, Any] = {}  # noqa: RUF012
    scanner: dict[str, Any] = {}  # noqa: RUF012
    datum: DatumKeys = DatumKeys()
    georeferencing: GeoreferencingKeys = GeoreferencingKeys()
    observations: _Texts = []  # noqa: RUF012
    unknowns: dict[str, Any] = {}  # noqa: RUF012
    partitions: _Texts = []  # noqa: RUF012
    reference_temperature_c: Number | None = None
    converted_from: StrictStr = ""

    @model_validator(mode="after")
    def _check(self) -> "BlockKeys":
        taken = [*(c.name for c in LAYOUTS["images"].columns), *PLACE, "mount", "block", "lidar", "knot"]
        for name in self.partitions:
            if name in taken or self.partitions.count(name) > 1:
                raise KeyMistake("partitions", f"{name} is reserved; give the partition another name")
        return self


@dataclasses.dataclass(frozen=True)
class Settings:
    """Content of block.toml. Tables of unknowns are read later, when their owners are known."""

    top: Section
    keys: BlockKeys
    frame: Frame
    cameras: dict[str, Camera]
    datum: Datum

    @property
    def file(self) -> str:
        """File name in messages."""
        return self.top.file

    @property
    def sigmas(self) -> dict[str, float]:
        """Default standard deviations."""
        return self.keys.sigmas


def read_settings(values: dict[str, Any], file: str = TOML, sigma_keys: Sequence[str] = ()) -> Settings:
    """Read the settings from the content of block.toml; `sigma_keys` are the additional keys of [sigmas]."""
    top = Section(file, "", values)
    keys = top.model(BlockKeys)
    top.section("sigmas").known(*_SIGMAS, *sigma_keys)
    if not keys.cameras:
        raise top.error("", "no cameras; add a table [cameras.NAME] with its format and interior orientation")
    cameras = top.section("cameras")
    if "default" in cameras:
        raise cameras.error("default", "default means every camera in [mounts]; give the camera another name")
    over = keys.datum.over
    datum = Datum(keys.datum.kind, tuple(over) if isinstance(over, list) else over, keys.datum.scale)
    return Settings(
        top, keys, frame_of(keys.frame, file), {name: read_camera(cameras.section(name)) for name in cameras}, datum
    )


def frame_of(keys: FrameKeys, file: str) -> Frame:
    """Return the frame; a frame of kind epsg may lack its origin."""
    if keys.kind == "epsg" and "vertical" not in keys.model_fields_set:
        warnings.warn(
            f"{file}, [frame]: heights are assumed ellipsoidal (GNSS); write "
            'vertical = "ellipsoidal", or the EPSG code of their system (5773 for EGM96) if they are not',
            UserWarning,
            stacklevel=2,
        )
    origin = None if keys.origin is None else tuple(keys.origin)
    return Frame(keys.kind, keys.code, keys.vertical, keys.yaw, origin)  # type: ignore[arg-type]


def corrections_in(frame: Frame, settings: Settings) -> Corrections:
    """Return the corrections that [corrections] enables in `frame`, which has its origin."""
    keys, section = settings.keys.corrections, settings.top.section("corrections")
    if keys.curvature and frame.kind != "grid":
        raise section.error(
            "curvature",
            f'a frame of kind "{frame.kind}" is Cartesian and needs no curvature correction; remove the key (only '
            'kind = "grid" needs it)',
        )
    if frame.kind == "epsg":
        if keys.sea_level_m is not None:
            raise section.error("sea_level_m", "a frame of kind epsg defines its heights; remove the key")
        return Corrections(keys.refraction, False, frame.map.sea_level() if keys.refraction else 0.0)
    if keys.sea_level_m is not None and not keys.refraction:
        raise section.error("sea_level_m", "only refraction = true needs it; remove the key or switch refraction on")
    if keys.sea_level_m is None and keys.refraction and frame.kind != "grid":
        raise section.error(
            "sea_level_m",
            f'refraction depends on heights above sea level, which a frame of kind "{frame.kind}" does not have; give '
            "the Z of sea level",
        )
    return Corrections(keys.refraction, keys.curvature, keys.sea_level_m or 0.0)


def frame_section(frame: Frame) -> dict[str, Any]:
    """Return the [frame] table of `frame`."""
    if frame.kind != "epsg":
        return {"kind": frame.kind}
    vertical = "ellipsoidal" if frame.vertical is None else frame.vertical
    return {
        "kind": "epsg", "code": frame.code, "vertical": vertical, "yaw": frame.yaw, "origin": list(frame.origin or ()),
    }  # fmt: skip


def corrections_section(corrections: Corrections, frame: Frame) -> dict[str, Any]:
    """Return the [corrections] table of `corrections`; empty if all are disabled."""
    written: dict[str, Any] = {name: True for name in ("refraction", "curvature") if getattr(corrections, name)}
    if corrections.refraction and frame.kind != "epsg":
        written["sea_level_m"] = corrections.sea_level_m
    return written


def datum_section(datum: Datum) -> dict[str, Any]:
    """Return the [datum] table of `datum`."""
    written: dict[str, Any] = {"kind": datum.kind}
    if datum.kind == "inner":
        written["over"] = datum.over if isinstance(datum.over, str) else list(datum.over)
        if datum.scale is not None:
            written["scale"] = datum.scale
    return written


def default_sigma(settings: Settings, *keys: str) -> float:
    """Return the value of the first of `keys` in [sigmas]; NaN if there is none."""
    return next((settings.sigmas[key] for key in keys if key in settings.sigmas), np.nan)
