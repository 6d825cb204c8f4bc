"""Keys of a recipe, by table (docs/simulation.md).

Tables that describe a plan have the fields and defaults of its class in `jaxphoto.simulation`.
"""
# mypy: disable-error-code="valid-type"

import dataclasses
import itertools
import typing
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, StrictBool, StrictStr, create_model, model_validator

from jaxphoto.camera import RATES, CameraSpline, StripCamera
from jaxphoto.georeferencing import Pattern, RigCamera
from jaxphoto.io.toml import Count, KeyMistake, Keys, NotNegative, Number, OneOrMore, Positive, Section, Vector, Whole
from jaxphoto.parameters import AbstractParameters
from jaxphoto.simulation import (
    ROLLING,
    Approximation,
    Buildings,
    Choice,
    Cooling,
    Jitter,
    PointPlan,
    RandomWaves,
    ScanPlan,
    Sigmas,
    Station,
    TargetPlan,
    Terrain,
    Trees,
    Wave,
    plans,
    scene,
)

_KINDS: tuple[type[AbstractParameters], ...] = (*RATES, CameraSpline, StripCamera)
CHANGES = {kind.kind: kind for kind in _KINDS}
"""Classes of camera changes, by the name of their table."""
# Maximum scan angle (degrees); beyond it, a rolling aircraft scans the horizon.
_WIDEST_DEG = 60.0


def _for_all_axes(value: Any) -> Any:
    return value if isinstance(value, list) else [value] * 3


def _range(value: Any) -> Any:
    values = value if isinstance(value, list) else [value]
    if len(values) in (1, 2) and all(isinstance(v, int | float) for v in values) and values[0] <= values[-1]:
        return [values[0], values[-1]]
    raise ValueError(f"{values} is not a range; give one number, or [minimum, maximum]")


def _strip_name(name: str) -> str:
    if name in ("", "default"):
        raise ValueError(f"a strip cannot be called {name!r}; give it another name")
    return name


Triple = Annotated[list[NotNegative], BeforeValidator(_for_all_axes), Field(min_length=3, max_length=3)]
PositiveTriple = Annotated[list[Positive], BeforeValidator(_for_all_axes), Field(min_length=3, max_length=3)]
Range = Annotated[list[Number], BeforeValidator(_range)]
PositiveRange = Annotated[list[Positive], BeforeValidator(_range)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]
Place = Annotated[list[Number], Field(min_length=2, max_length=3)]
Heading = Annotated[Number, Field(ge=-360, le=360)]
Percent = Annotated[Number, Field(ge=0, lt=100)]
Name = Annotated[StrictStr, AfterValidator(_strip_name)]


def plain(value: Any) -> Any:
    """Convert values of a model to values of a dataclass: lists to tuples, tables to plans."""
    if isinstance(value, PlanKeys):
        return value.plan()
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    return tuple(map(plain, value)) if isinstance(value, list) else value


class PlanKeys(Keys):
    """Keys of a table with the fields of a dataclass of `jaxphoto.simulation`."""

    kind_of_plan: ClassVar[type]

    def plan(self, **more: Any) -> Any:
        """Build the plan; missing keys have its defaults."""
        fields = {f.name for f in dataclasses.fields(self.kind_of_plan)}
        given = {name: plain(getattr(self, name)) for name in self.model_fields_set & fields}
        return self.kind_of_plan(**(given | more))


# Types of keys, by types of fields.
_TYPES: dict[Any, Any] = {
    float: Number, int: Whole, bool: StrictBool, str: StrictStr,
    plans.Triple: Triple, scene.Range: PositiveRange,
    tuple[tuple[float, float], ...]: list[Pair], tuple[tuple[float, ...], ...]: list[Place],
    dict[str, plans.Triple]: dict[str, Vector],
}  # fmt: skip


def plan_keys(kind: type, base: type[PlanKeys] = PlanKeys, /, **keys: Any) -> Any:
    """Build a model with the fields of a dataclass. `keys` overrides the types of fields; None removes a field."""
    hints, types = typing.get_type_hints(kind), {}
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        optional = type(None) in typing.get_args(hint)
        inner = typing.get_args(hint)[0] if optional else hint
        key = keys.get(field.name, _TYPES.get(inner, inner)) if field.name not in base.model_fields else None
        # Optional keys default to None: `plan` then uses the default of the field.
        required = field.default is field.default_factory is dataclasses.MISSING
        if key is not None:
            types[field.name] = (
                key | None if optional else key,
                ... if required and type(None) not in typing.get_args(key) else None,
            )
    model = create_model(f"{kind.__name__}Keys", __base__=base, **types)  # type: ignore[call-overload]
    model.kind_of_plan = kind
    return model


class _PointKeys(PlanKeys):
    @model_validator(mode="after")
    def _check(self: Any) -> Any:
        least = self.min_images or PointPlan.min_images
        if self.mean_rays is not None and self.mean_rays < least:
            message = f"{self.mean_rays:g} is less than min_images = {least}; raise it or lower min_images"
            raise KeyMistake("mean_rays", message)
        return self


class _TargetKeys(PlanKeys):
    grid: Annotated[list[Annotated[Whole, Field(ge=2, le=2_000)]], Field(min_length=2, max_length=2)] | None = None

    def plan(self: Any, **more: Any) -> TargetPlan:
        """Build the plan; grid nodes are added to the listed positions."""
        sides = [np.linspace(-1, 1, n).tolist() for n in self.grid or ()]
        grid = tuple((x, y) for y in sides[1] for x in sides[0]) if sides else ()
        return super().plan(at=plain(self.at or []) + grid, **more)


JitterKeys = plan_keys(Jitter, angle_deg=NotNegative, crab_deg=NotNegative, rate_deg_per_s=NotNegative)
StartKeys = plan_keys(Approximation, position_m=NotNegative, angle_deg=NotNegative, points_m=NotNegative)
CoolingKeys = plan_keys(Cooling, time_constant_s=Positive, reference_c=Number | None)
ChoiceKeys = plan_keys(Choice)
PointKeys = plan_keys(
    PointPlan, _PointKeys, ties=Whole | None, min_images=Annotated[Count, Field(ge=2)], mean_rays=Positive,
    across=Positive, ends=NotNegative, margin_mm=NotNegative, on_roofs=Annotated[Number, Field(ge=0, le=1)],
)  # fmt: skip
TargetKeys = plan_keys(TargetPlan, _TargetKeys, choice=ChoiceKeys)  # fmt: skip
_OBSERVED = dict.fromkeys((f.name for f in dataclasses.fields(Sigmas)), PositiveTriple)
SigmaKeys = plan_keys(Sigmas, **_OBSERVED | {"image_mm": Positive, "target_mm": Positive | None})
NoiseKeys = plan_keys(Sigmas, image_mm=NotNegative | None, target_mm=NotNegative | None)
WaveKeys = plan_keys(Wave, amplitude_m=Positive, length_m=Positive)
RandomKeys = plan_keys(RandomWaves, count=Count, rms_m=Positive, length_m=Positive)
BuildingKeys = plan_keys(Buildings, heading_deg=Range)
TreeKeys = plan_keys(Trees)
LidarTruthKeys = plan_keys(
    ScanPlan, correlation_s=Positive, knots_s=Positive, eccentricity_deg=Pair,
    **dict.fromkeys(("density_per_m2", "scan_angle_deg", "pattern", "strips", "same_trajectory")),
    **dict.fromkeys(("boresight_deg", "lever_arm_m"), Vector),
)  # fmt: skip


class TerrainKeys(Keys):
    """Keys of [terrain]."""

    kind: Literal["flat", "plane", "waves", "random", "rolling"] = "flat"
    height_m: Number = 0.0
    roughness_m: NotNegative = 0.0
    slope_east_percent: Number = 0.0
    slope_north_percent: Number = 0.0
    waves: list[WaveKeys] = []  # noqa: RUF012
    count: Any = None
    rms_m: Any = None
    length_m: Any = None
    buildings: list[BuildingKeys] = []  # noqa: RUF012
    trees: list[TreeKeys] = []  # noqa: RUF012
    seed: Whole | None = None

    @model_validator(mode="after")
    def _check(self) -> "TerrainKeys":
        shapes = {
            "plane": ("slope_east_percent", "slope_north_percent"), "waves": ("waves",),
            "random": tuple(RandomKeys.model_fields),
        }  # fmt: skip
        known = ["kind", "buildings", "trees", "seed"]
        if self.kind != "rolling":
            known += ["height_m", "roughness_m", *shapes.get(self.kind, ())]
        for key in sorted(self.model_fields_set - set(known)):
            raise KeyMistake(key, f"unknown key for {self.kind} terrain; use {', '.join(known)} or remove it")
        return self

    def terrain(self, section: Section) -> Terrain:
        """Build the terrain."""
        if self.kind == "rolling":
            return dataclasses.replace(ROLLING, seed=self.seed)
        random = None
        if self.kind == "random":
            values = {key: section.values[key] for key in RandomKeys.model_fields if key in section}
            random = Section(section.file, section.path, values).model(RandomKeys).plan()
        slope = self.slope_east_percent / 100, self.slope_north_percent / 100
        return Terrain(self.height_m, slope, plain(self.waves), self.roughness_m, random, self.seed)


class _Flown(Keys):
    """Keys of [flight] that its strips may override, and their pairs of alternatives."""

    height_m: Positive | None = None
    gsd_m: Positive | None = None
    base_m: Positive | None = None
    forward_overlap_percent: Percent | None = None
    spacing_m: Positive | None = None
    side_overlap_percent: Percent | None = None
    pairs: ClassVar = {
        "height": ("height_m", "gsd_m"),
        "base": ("base_m", "forward_overlap_percent"),
        "spacing": ("spacing_m", "side_overlap_percent"),
    }

    @model_validator(mode="after")
    def _check(self) -> "_Flown":
        for one, other in self.pairs.values():
            if getattr(self, one) is not None and getattr(self, other) is not None:
                raise KeyMistake(other, f"{one} gives the same; keep one of them")
        return self

    def either(self, thing: str) -> tuple[str, float] | None:
        """Return the specified key of two alternatives, and its value; None if both are missing."""
        return next(((key, getattr(self, key)) for key in self.pairs[thing] if getattr(self, key) is not None), None)


class StripKeys(_Flown):
    """Keys of [[flight.strips]]."""

    name: Name
    camera: StrictStr | None = None
    heading_deg: Heading
    images: Count
    count: Count = 1
    along_m: Number = 0.0
    across_m: Number = 0.0
    along_bases: Number = 0.0
    across_spacings: Number = 0.0


class FlightKeys(_Flown):
    """Keys of [flight]."""

    speed_m_per_s: Positive | None = None
    turn_s: Positive | None = None
    strips: Annotated[list[StripKeys], Field(min_length=1)]


class StationKeys(Keys):
    """Keys of [[convergent.stations]]: one station per combination of distance, azimuth, tilt and roll."""

    name: StrictStr
    camera: StrictStr | None = None
    distance_m: OneOrMore
    azimuth_deg: OneOrMore = [0.0]  # noqa: RUF012
    tilt_deg: OneOrMore
    roll_deg: OneOrMore = [0.0]  # noqa: RUF012

    @model_validator(mode="after")
    def _check(self) -> "StationKeys":
        if min(self.distance_m) <= 0:
            raise KeyMistake("distance_m", f"{min(self.distance_m):g} is not positive; correct it")
        if min(self.tilt_deg) < 0 or max(self.tilt_deg) >= 90:
            raise KeyMistake("tilt_deg", "tilts must be at least 0 and less than 90 degrees; correct them")
        return self

    def stations(self, camera: str) -> Iterator[Station]:
        """Yield the stations of the table."""
        each = itertools.product(self.distance_m, self.azimuth_deg, self.tilt_deg, self.roll_deg)
        return (Station(f"{self.name}_{k:02d}", camera, *numbers) for k, numbers in enumerate(each, start=1))


class ConvergentKeys(Keys):
    """Keys of [convergent]."""

    field_m: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    stations: list[StationKeys] = []  # noqa: RUF012

    @model_validator(mode="after")
    def _check(self) -> "ConvergentKeys":
        names = [station.name for station in self.stations]
        if twice := [name for name in names if names.count(name) > 1]:
            raise KeyMistake("stations", f"two tables have the name {twice[0]}; give each its own name")
        return self


class LidarKeys(PlanKeys):
    """Keys of [lidar]."""

    kind_of_plan = ScanPlan
    density_per_m2: Positive
    scan_angle_deg: Annotated[Positive, Field(le=_WIDEST_DEG)] = 0.0
    pattern: Pattern = "line"
    same_trajectory: StrictBool = False
    truth: LidarTruthKeys = LidarTruthKeys()


class WalkKeys(Keys):
    """Keys of [camera_walk] and [camera_walk.truth]."""

    c_mm: NotNegative = 0.0
    xp_mm: NotNegative = 0.0
    yp_mm: NotNegative = 0.0
    truth: "WalkKeys | None" = None


class TruthKeys(Keys):
    """Keys of [truth]."""

    datum_offset_m: Vector = [0.0, 0.0, 0.0]  # noqa: RUF012


class _RecipeKeys(Keys):
    title: StrictStr = ""
    cameras: dict[str, dict[str, Any]] = {}  # noqa: RUF012
    mounts: dict[str, dict[str, Any]] = {}  # noqa: RUF012
    strips: dict[str, dict[str, Any]] = {}  # noqa: RUF012
    datum: dict[str, Any] = {}  # noqa: RUF012
    truth: TruthKeys = TruthKeys()
    flight: FlightKeys | None = None
    convergent: ConvergentKeys | None = None
    jitter: JitterKeys = JitterKeys()
    terrain: TerrainKeys = TerrainKeys()
    points: PointKeys = PointKeys()
    targets: list[TargetKeys] = []  # noqa: RUF012
    sigmas: SigmaKeys
    noise: NoiseKeys = NoiseKeys()
    start: StartKeys = StartKeys()
    lidar: LidarKeys | None = None
    shutters: dict[str, dict[str, Any]] = {}  # noqa: RUF012
    temperature: CoolingKeys | None = None
    camera_walk: WalkKeys | None = None


RecipeKeys: Any = create_model(
    "RecipeKeys",
    __base__=_RecipeKeys,
    **{name: (dict[str, dict[str, Any]], {}) for name in (*CHANGES, RigCamera.kind)},  # type: ignore[call-overload]
)
"""Keys of a recipe."""
