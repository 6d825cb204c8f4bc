"""A recipe in TOML -> `Recipe`; what cannot be flown or measured is refused with one sentence.

Cameras, mounts, strips and datum are written as in block.toml. What is truly otherwise stands in a table `truth`
below each (docs/simulation.md).
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxphoto.camera import InteriorOrientation, RollingShutter, constant_names, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Mount, StripBias
from jaxphoto.io.block_folder.camera_section import Camera, read_camera
from jaxphoto.io.block_folder.mount_sections import read_mounts, read_strips
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.block_folder.settings import read_settings
from jaxphoto.io.recipe.camera_sections import (
    CHANGES,
    RIG,
    WALK,
    flown_cameras,
    read_changes,
    read_rig,
    read_temperature,
    read_walk,
    refuse_changes,
)
from jaxphoto.io.recipe.convergent_section import read_convergent
from jaxphoto.io.recipe.flight_section import Mounted, read_flight
from jaxphoto.io.recipe.keys import sigmas, tables
from jaxphoto.io.recipe.lidar_section import read_lidar
from jaxphoto.io.recipe.points_section import (
    check_points,
    read_jitter,
    read_points,
    read_sigmas,
    read_start,
    read_targets,
    read_terrain,
)
from jaxphoto.io.recipe.settlement_section import read_settlement
from jaxphoto.io.toml import read_toml
from jaxphoto.simulation import (
    Assumed,
    ConvergentPlan,
    FlightPlan,
    Recipe,
    SimulatedBias,
    SimulatedShutter,
)

_KEYS = (
    "title", "cameras", "mounts", "strips", "datum", "truth", "flight", "convergent", "jitter", "terrain", "points",
    "targets", "sigmas", "noise", "start", "lidar", "shutters", "temperature", *CHANGES, WALK, RIG,
)  # fmt: skip
_ZERO = (0.0, 0.0, 0.0)


def read_recipe(path: str | Path) -> Recipe:
    """The recipe in a TOML file. Raises InputError, naming file, key and mend."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no file {path}; give the TOML file of a recipe")
    return recipe_from(read_toml(path), path.name)


def recipe_from(values: Mapping[str, Any], file: str = "recipe.toml") -> Recipe:
    """The recipe that the content of a TOML file describes; `file` is what messages call it.

    Experiments change `values` between reading and this: a variant is another dictionary. Raises InputError.
    """
    top = Section(file, "", _of_measured_coordinates(values))
    top.known(*_KEYS)
    # What the block says, as block.toml would say it.
    told = {key: _without_truth(top.section(key)) for key in ("cameras", "mounts", "strips")}
    settings = read_settings(told | {key: top.values[key] for key in ("title", "datum") if key in top}, file)
    cameras = {name: _camera(top.section("cameras").section(name), camera) for name, camera in settings.cameras.items()}
    sensors = {name: camera.sensor for name, camera in settings.cameras.items()}
    mounts = _mounts(top.section("mounts"), settings.mounts, cameras)
    image_x = {n: (mounts.get(n) or mounts.get("default") or _NO_MOUNT).truth.image_x for n in cameras}
    flown = flown_cameras(top, tuple(cameras))
    plan = _plan(top, {name: Mounted(sensors[name], cameras[name].truth, image_x[name]) for name in flown})
    strips = [strip.name for strip in plan.strips] if isinstance(plan, FlightPlan) else []
    points = read_points(top.section("points"), in_swaths=isinstance(plan, FlightPlan))
    targets = tuple(map(read_targets, tables(top, "targets")))
    check_points(top, points, targets, plan.n_images * (1 + len(top.section(RIG).values)))
    stated, noise = read_sigmas(top, targets)
    terrain = read_terrain(top.section("terrain"))
    truth = top.section("truth")
    truth.known("datum_offset_m")
    return Recipe(
        title=settings.title,
        sensors=sensors,
        cameras=cameras,
        plan=plan,
        points=points,
        stated=stated,
        noise=noise,
        targets=targets,
        mounts=mounts,
        biases=_biases(top.section("strips"), settings.strips, strips),
        shutters=_shutters(top.section("shutters"), cameras),
        changes=read_changes(top, tuple(cameras), strips),
        temperature=read_temperature(top),
        walk=read_walk(top),
        rig=read_rig(top, tuple(cameras), stated),
        datum_offset_m=tuple(truth.vector("datum_offset_m").tolist()),
        jitter=read_jitter(top.section("jitter")),
        terrain=terrain,
        start=read_start(top.section("start"), plan),
        datum=settings.datum,
        settlement=read_settlement(top.section("terrain")),
        lidar=read_lidar(top, plan, terrain, stated),
    )


# NumPy's arrays: those of JAX would start a device and compile at import.
_NO_MOUNT = Assumed(*[Mount(np.zeros(3), np.zeros(3))] * 3)  # type: ignore[arg-type]


def _plan(top: Section, cameras: Mapping[str, Mounted]) -> FlightPlan | ConvergentPlan:
    """The flight or the convergent set; every camera takes part in it."""
    if ("flight" in top) == ("convergent" in top):
        raise top.error("", "a recipe has a table [flight] or a table [convergent]; give one of the two")
    plan: FlightPlan | ConvergentPlan
    if "flight" in top:
        plan, images = read_flight(top.section("flight"), cameras), "strip is flown"
    else:
        if "strips" in top:
            raise top.error("strips", "a convergent set has no strips; remove the table")
        refuse_changes(top)
        plan, images = read_convergent(top.section("convergent"), list(cameras)), "image is taken"
    for name in cameras:
        if name not in plan.cameras:
            raise top.section("cameras").error(name, f"no {images} with this camera; use it or remove it")
    return plan


def _of_measured_coordinates(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same, residuals being those of the image that has the noise where a camera does not say which."""
    cameras = values.get("cameras")
    if not isinstance(cameras, Mapping):
        return dict(values)
    usual = {"residuals": "measured"}
    told = {name: {**usual, **camera} if isinstance(camera, Mapping) else camera for name, camera in cameras.items()}
    return {**values, "cameras": told}


def _without_truth(section: Section) -> dict[str, Any]:
    """The tables of `section`, each without its table `truth`."""
    return {name: {k: v for k, v in section.section(name).values.items() if k != "truth"} for name in section}


def _camera(section: Section, told: Camera) -> Assumed[InteriorOrientation]:
    truth = section.section("truth")
    truth.known(*parameter_names(told.interior), *constant_names(told.interior))
    values = section.section("interior").values | {key: truth.number(key) for key in truth}
    known = {key: value for key, value in section.values.items() if key != "truth"}
    true = read_camera(Section(section.file, section.path, known | {"interior": values}))
    return Assumed(true.interior, told.interior, told.priors)


def _mounts(section: Section, told: Section, cameras: Iterable[str]) -> dict[str, Assumed[Mount]]:
    starts, priors = read_mounts(told, cameras)
    mounts = {}
    for name, start in starts.items():
        truth = section.section(name).section("truth")
        truth.known("lever_arm_m", "boresight_deg", "time_offset_s")
        arm = truth.vector("lever_arm_m") if "lever_arm_m" in truth else start.lever_arm
        boresight = np.deg2rad(truth.vector("boresight_deg")) if "boresight_deg" in truth else start.boresight
        offset = truth.number("time_offset_s", float(start.time_offset))
        true = Mount(jnp.asarray(arm), jnp.asarray(boresight), jnp.asarray(offset), start.image_x)
        mounts[name] = Assumed(true, start, priors[name])
    return mounts


def _shutters(section: Section, cameras: Iterable[str]) -> dict[str, SimulatedShutter]:
    """Of a table that holds nothing but a `truth` the block's model does not know."""
    section.known("default", *cameras)
    shutters = {}
    for name in cameras:
        key = name if name in section else "default"
        if key not in section:
            continue
        own = section.section(key)
        own.known("readout_ms", "readout", "velocity_m_per_s", "rate_deg_per_s", "truth")
        truth = own.section("truth")
        truth.known("readout_ms")
        start = own.number("readout_ms", 0.0)
        errors = {word: own.positive(word) for word in ("velocity_m_per_s", "rate_deg_per_s") if word in own}
        prior = own.prior("readout", np.asarray(start), "_ms")
        model = (RollingShutter(np.asarray(start)), RollingShutter(prior))  # type: ignore[arg-type]
        knows = any(word != "truth" for word in own)
        shutters[name] = SimulatedShutter(
            RollingShutter(np.asarray(truth.number("readout_ms", start))),  # type: ignore[arg-type]
            **errors,
            model=model if knows else None,
        )
    return shutters


def _biases(section: Section, told: Section, strips: list[str]) -> dict[str, SimulatedBias]:
    """A table that holds nothing but a `truth` leaves the bias out of the block's model."""
    section.known("default", *strips)
    modelled = Section(told.file, told.path, {name: values for name, values in told.values.items() if values})
    starts, priors = read_strips(modelled, strips)
    biases = {}
    for name in strips:
        key = name if name in section else "default"
        if key not in section:
            continue
        truth = section.section(key).section("truth")
        truth.known("shift_m", "drift_m_per_s", "shift_sigma_m", "drift_sigma_m_per_s")
        start = starts.get(name, StripBias(jnp.zeros(3), jnp.zeros(3)))
        shift = truth.vector("shift_m") if "shift_m" in truth else start.shift
        drift = truth.vector("drift_m_per_s") if "drift_m_per_s" in truth else start.drift
        biases[name] = SimulatedBias(
            StripBias(jnp.asarray(shift), jnp.asarray(drift)),
            sigmas(truth, "shift_sigma_m") or _ZERO,
            sigmas(truth, "drift_sigma_m_per_s") or _ZERO,
            (start, priors[name]) if name in starts else None,
        )
    return biases
