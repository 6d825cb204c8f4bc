"""block.toml: title, frame, corrections, trajectory, cameras, default sigmas, mounts, strips, scanner and datum."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.block import Datum, Frame
from jaxphoto.errors import quoted
from jaxphoto.io.block_folder.camera_section import Camera, read_camera
from jaxphoto.io.block_folder.frame_sections import read_frame
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.block_folder.table_layout import LAYOUTS, PLACE, TOML
from jaxphoto.variants import MODES

_KEYS = (
    "title",
    "frame",
    "corrections",
    "trajectory",
    "sigmas",
    "cameras",
    "mounts",
    "strips",
    "scanner",
    "datum",
    "georeferencing",
    "observations",
    "unknowns",
    "partitions",
    "breaklines",
    "reference_temperature_c",
    "converted_from",
)
_SIGMAS = (
    "image_mm", "image_px", "control_m", "control_X_m", "control_Y_m", "control_Z_m", "station_m", "attitude_deg",
)  # fmt: skip


class Settings(NamedTuple):
    """What block.toml says; sections are read when what they depend on is known."""

    file: str
    title: str
    frame: Frame
    corrections: Section
    trajectory: Section
    sigmas: dict[str, float]
    cameras: dict[str, Camera]
    mounts: Section
    strips: Section
    scanner: Section
    datum: Datum
    mode: str
    """Of georeferencing: a name of `variants.MODES`."""
    observations: tuple[str, ...]
    """Tables of classes that are not jaxphoto's own."""
    unknowns: Section
    partitions: tuple[str, ...]
    """Columns of images.csv that say whose further unknowns are."""
    breaklines: tuple[str, ...]
    """Points on breaklines, by names in which * stands for any letters."""
    reference_temperature_c: float | None
    """At which cameras with thermal rates are what they are; None: the mean of all exposures."""
    converted_from: str
    """As in `Block`."""


def read_settings(values: dict[str, Any], file: str = TOML, sigma_keys: Sequence[str] = ()) -> Settings:
    """The settings in the content of block.toml; `file` is what messages call it, `sigma_keys` of further tables."""
    top = Section(file, "", values)
    top.known(*_KEYS)
    sigmas = top.section("sigmas")
    sigmas.known(*_SIGMAS, *sigma_keys)
    cameras = top.section("cameras")
    if not cameras.values:
        raise top.error("", "there is no camera; add a table [cameras.NAME] with its format and interior orientation")
    if "default" in cameras:
        raise cameras.error("default", "this name means every camera in [mounts]; give the camera another one")
    return Settings(
        file,
        top.text("title", ""),
        read_frame(top.section("frame")),
        top.section("corrections"),
        top.section("trajectory"),
        {name: sigmas.positive(name) for name in sigmas},
        {name: read_camera(cameras.section(name)) for name in cameras},
        top.section("mounts"),
        top.section("strips"),
        top.section("scanner"),
        _read_datum(top.section("datum")),
        _read_mode(top.section("georeferencing")),
        top.texts("observations"),
        top.section("unknowns"),
        read_partitions(top),
        top.texts("breaklines"),
        top.number("reference_temperature_c") if "reference_temperature_c" in top else None,
        top.text("converted_from", ""),
    )


def read_partitions(top: Section) -> tuple[str, ...]:
    """The names of columns of images.csv. Raises InputError for those that have another meaning."""
    names, images = top.texts("partitions"), LAYOUTS["images"]
    taken = (*images.columns, *images.optional, *PLACE, "mount", "block", "lidar", "knot")
    for name in names:
        if name in taken or names.count(name) > 1:
            raise top.error("partitions", f"{name} has a meaning already; give the partition another name")
    return names


def datum_section(datum: Datum) -> dict[str, Any]:
    """The [datum] table that `read_settings` reads as `datum`."""
    written: dict[str, Any] = {"kind": datum.kind}
    if datum.kind == "inner":
        written["over"] = datum.over if isinstance(datum.over, str) else list(datum.over)
        if datum.scale is not None:
            written["scale"] = datum.scale
    return written


def toml_text(values: dict[str, Any]) -> str:
    """Nested tables as TOML; numbers are written so that they come back exactly."""
    return "\n".join(_table_lines("", values)).lstrip("\n") + "\n"


def _read_datum(section: Section) -> Datum:
    section.known("kind", "over", "scale")
    kind = section.text("kind", "control")
    if kind not in ("control", "minimal", "inner"):
        raise section.error("kind", f'{quoted(kind)} is no datum; write "control", "minimal" or "inner"')
    if kind != "inner":
        for key in ("over", "scale"):
            if key in section:
                raise section.error(key, f'only kind = "inner" has it; remove it or change kind from "{kind}"')
        return Datum(kind)  # type: ignore[arg-type]
    over = section.values.get("over", "points")
    if isinstance(over, list):
        if not over or not all(isinstance(point, str) for point in over):
            raise section.error(
                "over", f'{quoted(over)} is no list of point ids; write them as text, like ["1", "2", "3"]'
            )
        over = tuple(over)
    elif over not in ("points", "images"):
        raise section.error("over", f'{quoted(over)} is unknown; write "points", "images" or a list of point ids')
    scale = section.values.get("scale")
    if scale is not None and not isinstance(scale, bool):
        raise section.error("scale", f"{quoted(scale)} is neither true nor false; write one of them")
    return Datum("inner", over, scale)


def _read_mode(section: Section) -> str:
    section.known("mode")
    mode = section.text("mode", "integrated")
    if mode not in MODES:
        raise section.error("mode", f"{quoted(mode)} is no mode; write {', '.join(MODES)}")
    return mode


def _table_lines(path: str, values: dict[str, Any]) -> list[str]:
    lines = [f"{_key(k)} = {_value(v)}" for k, v in values.items() if not _is_table(v)]
    if path and lines:
        lines = ["", f"[{path}]", *lines]
    for key, value in values.items():
        if _is_table(value):
            lines += _table_lines(f"{path}.{_key(key)}" if path else _key(key), value)
    return lines


def _is_table(value: Any) -> bool:
    # A weighted status is the one table that stands on a line of its key.
    return isinstance(value, dict) and not {"sigma", "covariance"} & set(value)


def _key(key: str) -> str:
    bare = key.isascii() and key.replace("-", "").replace("_", "").isalnum()
    return key if bare else _text(key)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return _text(value)
    return repr(float(value)) if isinstance(value, float | np.floating) else str(value)


def _text(text: str) -> str:
    escaped = {c: f"\\u{ord(c):04x}" for c in text if ord(c) < 32 or ord(c) == 127} | {'"': '\\"', "\\": "\\\\"}
    return '"' + "".join(escaped.get(c, c) for c in text) + '"'
