"""Read a TOML recipe as `Recipe`.

Cameras, mounts, strips and datum have the keys of block.toml. Their subtable `truth` contains true values that differ
(docs/simulation.md).
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxphoto.camera import (
    InteriorOrientation,
    RollingShutter,
    Sensor,
    StripCamera,
    ThermalRates,
    constant_names,
    parameter_names,
)
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Mount, RigCamera, StripBias
from jaxphoto.io.block_folder.camera_section import Camera, read_camera
from jaxphoto.io.block_folder.parameters import (
    by_owner,
    keys_of,
    mounts_of,
    read_mounts,
    read_parameters,
    read_strips,
    static_fields,
)
from jaxphoto.io.block_folder.settings import read_settings
from jaxphoto.io.recipe.recipe_keys import CHANGES, RecipeKeys, Triple, plain
from jaxphoto.io.toml import Keys, Positive, Section, read_toml
from jaxphoto.parameters import AbstractParameters, dynamic_fields
from jaxphoto.simulation import (
    Assumed,
    CameraWalk,
    ConvergentPlan,
    Field,
    FlightPlan,
    Recipe,
    ScanPlan,
    Settlement,
    Sigmas,
    SimulatedBias,
    SimulatedChange,
    SimulatedShutter,
    Strip,
    Terrain,
    footprint,
)
from jaxphoto.unknowns import FREE

_ZERO = (0.0, 0.0, 0.0)
# Default error of approximate positions at close range, divided by the shortest object distance.
_NEAR = 0.02


class BiasTruthKeys(Keys):
    """Keys of [strips.X.truth]: standard deviations of randomly drawn biases."""

    shift_sigma_m: Triple = [0.0, 0.0, 0.0]  # noqa: RUF012
    drift_sigma_m_per_s: Triple = [0.0, 0.0, 0.0]  # noqa: RUF012


class MotionKeys(Keys):
    """Keys of the motion errors of images with a rolling shutter."""

    velocity_m_per_s: Positive = 0.0
    rate_deg_per_s: Positive = 0.0


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe from a TOML file. Raises InputError with file, key and cure."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"file not found: {path}; give the TOML file of a recipe")
    return recipe_from(read_toml(path), path.name)


def recipe_from(values: Mapping[str, Any], file: str = "recipe.toml") -> Recipe:
    """Build a recipe from the content of a TOML file; `file` is its name in messages.

    Experiments modify `values` before this call. Raises InputError.
    """
    top = Section(file, "", dict(values))
    keys = top.model(RecipeKeys)
    # Read the tables of block.toml.
    stated = {name: _without_truth(getattr(keys, name)) for name in ("cameras", "mounts", "strips")}
    settings = read_settings(stated | {key: top.values[key] for key in ("title", "datum") if key in top}, file)
    cameras = {
        name: _camera(settings.top.section("cameras").section(name), top.section("cameras").section(name), camera)
        for name, camera in settings.cameras.items()
    }
    sensors = {name: camera.sensor for name, camera in settings.cameras.items()}
    mount_starts, mount_priors = read_mounts(settings.top.section("mounts"), cameras)
    mounts = {
        name: Assumed(_truth(Mount, top.section("mounts").section(name))[0], start, mount_priors[name])
        for name, start in mount_starts.items()
    }
    rig = top.section(RigCamera.kind)
    flown = _flown_cameras(top, rig, list(cameras))
    mount_of = mounts_of(flown, mounts)
    image_x = {name: mounts[mount].truth.image_x if mount else "forward" for name, mount in mount_of.items()}
    plan = _plan(top, keys, {name: (sensors[name], cameras[name].truth, image_x[name]) for name in flown})
    strips = [strip.name for strip in plan.strips] if isinstance(plan, FlightPlan) else []
    targets = plain(keys.targets)
    ties = keys.points.ties or 0
    points = ties + sum(t.count + len(t.at) + len(t.at_m) for t in targets)
    if points < 3:
        raise InputError(f"{file}, [points] ties: {points} points in total; request more than 2")
    stated_sigmas, noise = _sigmas(top, keys, targets)
    if rig.values and (stated_sigmas.rig_place_m is None or stated_sigmas.rig_turn_deg is None):
        raise top.section("sigmas").error("", "the rigidity of the rig is missing; add rig_place_m and rig_turn_deg")
    terrain, air = keys.terrain.terrain(top.section("terrain")), keys.temperature
    near = {}
    if isinstance(plan, ConvergentPlan) and "position_m" not in keys.start.model_fields_set:
        near["position_m"] = _NEAR * min(station.distance_m for station in plan.stations)
    return Recipe(
        title=keys.title,
        sensors=sensors,
        cameras=cameras,
        plan=plan,
        points=keys.points.plan(ties=ties),
        stated=stated_sigmas,
        noise=noise,
        targets=targets,
        mounts=mounts,
        biases=_biases(settings.top.section("strips"), top.section("strips"), strips),
        shutters={n: _shutter(table) for n, table in by_owner(top.section("shutters"), cameras).items()},
        changes=_changes(top, keys, list(cameras), strips),
        temperature=air and air.plan(reference_c=air.air_c if air.reference_c is None else air.reference_c),
        walk=_walk(top, keys.camera_walk),
        rig=_change(RigCamera, rig, cameras),
        datum_offset_m=tuple(keys.truth.datum_offset_m),
        jitter=keys.jitter.plan(),
        terrain=terrain,
        start=keys.start.plan(**near),
        datum=settings.datum,
        settlement=Settlement(plain(keys.terrain.buildings), plain(keys.terrain.trees)),
        lidar=_lidar(top, keys, plan, terrain, stated_sigmas),
    )


def _without_truth(tables: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    return {name: {k: v for k, v in table.items() if k != "truth"} for name, table in tables.items()}


# Parameters ------------------------------------------------------------------------------------------------------


def _camera(stated: Section, section: Section, camera: Camera) -> Assumed[InteriorOrientation]:
    truth = section.section("truth")
    truth.known(*parameter_names(camera.interior), *constant_names(camera.interior))
    values = stated.section("interior").values | {key: truth.number(key) for key in truth}
    true = read_camera(Section(stated.file, stated.path, stated.values | {"interior": values}))
    return Assumed(true.interior, camera.interior, camera.priors)


def _truth(kind: type[AbstractParameters], section: Section, *others: str, drawn: bool = False) -> tuple[Any, Any]:
    """Read the true parameters of a table, and the priors from which they are drawn if `drawn`.

    `others` are keys that are not parameters. Parameters missing in `truth` have the values of the block.
    """
    starts = {key.start for key in keys_of(kind)} | set(static_fields(kind))
    truth = section.section("truth")
    if not drawn:
        truth.known(*sorted(starts), *others)
    values = {key: value for key, value in section.values.items() if key in starts}
    values |= {key: value for key, value in truth.values.items() if key not in others}
    return read_parameters(kind, Section(truth.file, truth.path, values))


def _biases(stated: Section, section: Section, strips: list[str]) -> dict[str, SimulatedBias]:
    """Read biases; the block's model omits a bias whose table has `truth` only."""
    tables = by_owner(section, strips)
    modelled = Section(stated.file, stated.path, {name: values for name, values in stated.values.items() if values})
    starts, priors = read_strips(modelled, strips)
    biases = {}
    for name, table in tables.items():
        drawn = table.section("truth")
        sigmas = {key: drawn.values[key] for key in BiasTruthKeys.model_fields if key in drawn}
        keys = Section(drawn.file, drawn.path, sigmas).model(BiasTruthKeys)
        biases[name] = SimulatedBias(
            _truth(StripBias, table, *sigmas)[0],
            plain(keys.shift_sigma_m),
            plain(keys.drift_sigma_m_per_s),
            (starts[name], priors[name]) if name in starts else None,
        )
    return biases


def _shutter(table: Section) -> SimulatedShutter:
    motion = {key: table.values[key] for key in MotionKeys.model_fields if key in table}
    keys = Section(table.file, table.path, motion).model(MotionKeys)
    stated = {key: value for key, value in table.values.items() if key not in (*motion, "truth")}
    model = read_parameters(RollingShutter, Section(table.file, table.path, stated))
    knows = any(key != "truth" for key in table)
    return SimulatedShutter(
        _truth(RollingShutter, table)[0], keys.velocity_m_per_s, keys.rate_deg_per_s, model if knows else None
    )


def _change(kind: type[AbstractParameters], section: Section, owners: Iterable[str]) -> dict[str, SimulatedChange]:
    """Read changes by owner; the block's model omits a change whose table has `truth` only."""
    changes = {}
    for name, table in by_owner(section, owners).items():
        true, spread = _truth(kind, table, drawn=True)
        for field in dynamic_fields(kind):
            if getattr(spread, field) == FREE:
                raise table.section("truth").error(field, "a true value cannot be free; give its value or a sigma")
        stated = {key: value for key, value in table.values.items() if key != "truth"}
        model: Any = read_parameters(kind, Section(table.file, table.path, stated)) if stated else None
        changes[name] = SimulatedChange(true, spread, model)
    return changes


def _changes(top: Section, keys: Any, cameras: list[str], strips: list[str]) -> dict[str, dict[str, SimulatedChange]]:
    owners = {"camera": cameras, "strip": strips}
    changes = {
        name: change
        for name, kind in CHANGES.items()
        if (change := _change(kind, top.section(name), owners[kind.owner]))
    }
    if ThermalRates.kind in changes and keys.temperature is None:
        raise top.error(ThermalRates.kind, "the recipe has no temperature; add a table [temperature]")
    return changes


def _walk(top: Section, keys: Any) -> CameraWalk | None:
    """Read the true drift of cameras along strips, and its prior in the block."""
    if keys is None:
        return None
    if not top.section(StripCamera.kind).values:
        raise top.error("camera_walk", "no strip cameras for a random walk; add [strip_cameras.default]")
    stated = (keys.c_mm, keys.xp_mm, keys.yp_mm) if keys.model_fields_set - {"truth"} else None
    if stated and not all(stated):
        raise top.section("camera_walk").error("", "give c_mm, xp_mm and yp_mm above zero, or none of them")
    truth = keys.truth
    return CameraWalk((truth.c_mm, truth.xp_mm, truth.yp_mm) if truth else stated or _ZERO, stated)


def _sigmas(top: Section, keys: Any, targets: Sequence[Any]) -> tuple[Sigmas, Sigmas]:
    """Read stated and true sigmas; true sigmas equal the stated ones unless [noise] overrides them."""
    section, image = top.section("sigmas"), keys.sigmas.image_mm
    stated = keys.sigmas.plan(target_mm=keys.sigmas.target_mm or image)
    for key in keys.noise.model_fields_set:
        if getattr(stated, key) is None:
            raise top.section("noise").error(key, f"this has no observation; add {key} under [sigmas], or remove it")
    for key in ("relative_position_m", "relative_attitude_deg"):
        if key in section and keys.flight is None:
            raise section.error(key, "it applies between exposures of a strip, but [flight] is missing; remove it")
    roles = {role for group in targets for role in (group.role, *([group.choice.role] if group.choice else []))}
    if stated.control_m is None and roles & {"control", "vertical"}:
        raise section.error("control_m", "the key is missing, but the recipe has control points; add it")
    noise = vars(stated) | {name: plain(getattr(keys.noise, name)) for name in keys.noise.model_fields_set}
    if "target_mm" not in section and "target_mm" not in keys.noise.model_fields_set:
        # Targets have the standard deviation of tie points by default.
        noise["target_mm"] = noise["image_mm"]
    return stated, Sigmas(**noise)


# Plans -----------------------------------------------------------------------------------------------------------


def _flown_cameras(top: Section, rig: Section, cameras: list[str]) -> list[str]:
    """Return all cameras, or the reference camera of the rig only."""
    rig.known(*cameras)
    flown = [name for name in cameras if name not in rig]
    if rig.values and len(flown) != 1:
        raise rig.error("", "all cameras but the reference camera need a rig table; add one for each")
    if rig.values and "convergent" in top:
        raise top.error("convergent", "a rig requires a flight; remove this table, or that of the rig")
    return flown


Flown = Mapping[str, tuple[Sensor, InteriorOrientation, Any]]
"""Sensor, interior orientation and direction of the x axis, by camera."""


def _plan(top: Section, keys: Any, cameras: Flown) -> FlightPlan | ConvergentPlan:
    """Read the flight or the convergent stations; every camera must be used."""
    if ("flight" in top) == ("convergent" in top):
        raise top.error("", "a recipe needs either [flight] or [convergent]; give one of the two")
    plan = _flight(top, keys.flight, cameras) if keys.flight else _convergent(top, keys.convergent, list(cameras))
    if plan.n_images < 2:
        table, key = ("flight", "strips") if keys.flight else ("convergent", "stations")
        raise top.section(table).error(key, f"{plan.n_images} images in total; give 2 or more")
    for name in cameras:
        if name not in plan.cameras:
            raise top.section("cameras").error(name, "no image uses this camera; use it or remove it")
    return plan


def _camera_of(section: Section, name: str | None, cameras: Iterable[str], number: int) -> str:
    """Return the camera of a strip or station; the only camera by default."""
    cameras = list(cameras)
    if name is None and len(cameras) == 1:
        return cameras[0]
    place = Section(section.file, f"{section.path}, number {number}", {})
    if name is None:
        raise place.error("camera", "the key is missing; add it")
    if name not in cameras:
        raise place.error("camera", f"unknown camera {name}; use one of {', '.join(cameras)}")
    return name


def _convergent(top: Section, keys: Any, cameras: list[str]) -> ConvergentPlan:
    for key in ("strips", *CHANGES, "temperature", "camera_walk"):
        if key in top:
            raise top.error(key, "a convergent set has no strips and no times; remove the table")
    for key in {"across", "ends"} & set(top.section("points").values):
        raise top.section("points").error(key, "only a flight has this key; remove it")
    section = Section(top.file, "convergent.stations", {})
    stations = [
        station
        for k, table in enumerate(keys.stations, 1)
        for station in table.stations(_camera_of(section, table.camera, cameras, k))
    ]
    return ConvergentPlan(tuple(stations), Field(tuple(keys.field_m)))  # type: ignore[arg-type]


def _flight(top: Section, keys: Any, cameras: Flown) -> FlightPlan:
    section = Section(top.file, "flight.strips", {})
    strips: list[Strip] = []
    for number, table in enumerate(keys.strips, 1):
        camera = _camera_of(section, table.camera, cameras, number)
        for strip in _strips(table, keys, camera, cameras[camera], top.section("flight")):
            if strip.name in [other.name for other in strips]:
                place = Section(top.file, f"flight.strips, number {number}", {})
                raise place.error("name", f"duplicate strip name {strip.name}; give each its own name")
            strips.append(strip)
    given = {name: value for name in ("speed_m_per_s", "turn_s") if (value := getattr(keys, name)) is not None}
    return FlightPlan(tuple(strips), **given)


def _strips(table: Any, flight: Any, camera: str, flown: tuple, section: Section) -> list[Strip]:
    """Build the parallel strips of one table, flown in alternating directions, from left to right of the first."""
    sensor, interior, image_x = flown

    def either(thing: str) -> tuple[str, float]:
        given = table.either(thing) or flight.either(thing)
        if given is None:
            raise section.error("", f"the {thing} is not given; add {' or '.join(flight.pairs[thing])}")
        return given

    def step(thing: str, footprint_m: float) -> float:
        key, value = either(thing)
        return value if key.endswith("_m") else (1 - value / 100) * footprint_m

    c = float(interior.c)
    key, height = either("height")
    height *= 1.0 if key == "height_m" else c / sensor.pixel_mm
    ground = footprint(sensor, c, height, image_x)
    base = step("base", ground.along)
    spacing = step("spacing", ground.across) if table.count > 1 or table.across_spacings else 0.0
    along = table.along_m + table.along_bases * base
    strips = []
    for k in range(table.count):
        # `along_m` and `across_m` refer to the strip's own heading: change their signs in the opposite direction.
        sign = -1 if k % 2 else 1
        across = table.across_m + (table.across_spacings + k - (table.count - 1) / 2) * spacing
        name, heading = f"{table.name}{k + 1}" if table.count > 1 else table.name, table.heading_deg + 180 * (k % 2)
        strips.append(Strip(name, camera, heading, table.images, base, height, ground, sign * along, sign * across))
    return strips


def _lidar(
    top: Section, keys: Any, plan: FlightPlan | ConvergentPlan, terrain: Terrain, stated: Sigmas
) -> ScanPlan | None:
    """Read the plan of the scanner; None without [lidar]."""
    sigmas = top.section("sigmas")
    if keys.lidar is None:
        if stated.lidar_m is not None:
            raise sigmas.error("lidar_m", "missing table [lidar]; add it, or remove this key")
        return None
    if isinstance(plan, ConvergentPlan):
        raise top.error("lidar", "a convergent set has no lidar strips; remove the table")
    if terrain.roughness_m:
        raise top.section("terrain").error(
            "roughness_m",
            f"points {terrain.roughness_m:g} m above or below the ground are not on a surface that lidar can measure; "
            'use 0, and replace "rolling" by its waves',
        )
    if stated.lidar_m is None:
        raise sigmas.error(
            "lidar_m", "the key is missing, but the recipe has lidar; add its sigmas, like [0.5, 0.5, 0.15]"
        )
    truth, names = keys.lidar.truth.plan(density_per_m2=1.0), [strip.name for strip in plan.strips]
    for key in ("shift_m", "drift_m_per_s", "attitude_deg", "attitude_drift_deg_per_s"):
        top.section("lidar").section("truth").section(key).known("default", *names)
    given = {name: getattr(truth, name) for name in keys.lidar.truth.model_fields_set}
    return keys.lidar.plan(**given)
