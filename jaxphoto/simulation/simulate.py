"""Simulation of a block with known truth, from a recipe and a seed."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxphoto.argument_checks import require
from jaxphoto.block import Block, Start, Temperatures, bent_cameras, exposures, mountings
from jaxphoto.camera import InteriorOrientation
from jaxphoto.cloud import Cloud
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Mount, RigCamera, StripBias, StripErrors, Trajectory, apparent_point
from jaxphoto.observations import (
    Attitudes,
    CameraPositions,
    ControlCoordinates,
    Correlated,
    Distances,
    ImagePoints,
    ImageState,
    KnownParameters,
    SurfaceRows,
)
from jaxphoto.short_repr import simulation_html, simulation_repr
from jaxphoto.simulation.camera_changes import (
    camera_motions,
    camera_steps,
    draw_changes,
    draw_deviations,
    reproject_changing,
    with_changes,
    with_shutters,
)
from jaxphoto.simulation.flight import (
    NO_BIAS,
    NO_MOUNT,
    Flight,
    add_rig_images,
    fly,
    gnss_images,
    has_delay,
    record,
    relative_rows,
    rig_rows,
    rotate_cameras,
    sensor_record,
    take_images,
)
from jaxphoto.simulation.plans import ConvergentPlan, FlightPlan
from jaxphoto.simulation.points import TruePoints, scatter, thin_rays
from jaxphoto.simulation.recipe import Assumed, Recipe, SimulatedBias, Triple, triple
from jaxphoto.simulation.sampling import stream
from jaxphoto.simulation.scan import exposure_times, paths, recorded_on_path, scan
from jaxphoto.simulation.scene import Terrain
from jaxphoto.static_values import with_plain_arrays
from jaxphoto.unknowns import FIXED, FREE, Unknowns

# Control axes of each role; number of sample positions for the mean ground height.
_AXES = {"control": (0, 1, 2), "vertical": (2,), "check": (0, 1, 2)}
_PLACES = 4096


class Simulation(eqx.Module):
    """Simulated block and its true parameters; with a lidar also cloud and trajectory. Unpacks to (block, truth,
    datum_offset_m).

    `truth` contains all mounts and strips of the recipe, modelled or not, and the scanner; the shifts of its strips
    include `datum_offset_m`. Use `remeasure(block, truth, key)` for new observations with noise of the stated sigmas.
    """

    block: Block
    truth: Unknowns
    datum_offset_m: Float[np.ndarray, "3"]
    terrain: Terrain = eqx.field(static=True)
    """Terrain, with its random parts drawn."""
    cloud: Cloud | None = None
    """Measured cloud. Without drifts and calibration errors, `corrected_point` with `truth.scanner` corrects it."""
    trajectory: Trajectory | None = None
    """Recorded trajectory of the scanner, on the clock of the cloud."""
    errors: StripErrors | None = None
    """True errors of the cloud: `corrected_return` with these gives the hits plus noise."""

    def __iter__(self) -> Iterator[Any]:
        return iter((self.block, self.truth, self.datum_offset_m))

    __repr__ = simulation_repr

    def _repr_html_(self) -> str:
        return simulation_html(self)


def simulate(recipe: Recipe, seed: int = 0) -> Simulation:
    """Simulate the block of `recipe` for `seed`; results are bit-reproducible.

    Ground, flight, points and each kind of noise have independent random streams: changing a sigma only scales its own
    noise. Raises BlockError if points or images have too few rays.
    """
    require(recipe, Recipe, "read a file by jaxphoto.read_recipe")
    terrain = recipe.settlement.settled(recipe.terrain.drawn(stream(seed, "terrain")), recipe.ground, seed)
    # Use the same positions for every seed: the flying height depends on the ground only.
    height = float(np.mean(terrain.height(recipe.ground.draw(stream(0, "ground"), _PLACES))))
    if isinstance(recipe.plan, ConvergentPlan):
        flight = take_images(recipe.plan, recipe.jitter, height, seed)
    else:
        flight = fly(recipe, recipe.plan, height, seed)
    rig = draw_deviations(recipe.rig, seed)
    alone = flight
    flight, event = add_rig_images(recipe, alone, rig, seed)
    scene = _seen(recipe, flight, scatter(recipe, flight, terrain, seed), seed)
    mounts = [recipe.mounts[name].truth if (name := recipe.mount_of(c)) else NO_MOUNT for c in flight.cameras]
    motions = camera_motions(flight.exterior, flight.motion.velocity, flight.motion.rate, mounts)
    biases = _true_biases(recipe, flight, seed)
    flown = [] if recipe.lidar is None else paths(recipe, recipe.lidar, alone)
    cloud = trajectory = scanner = errors = None
    if recipe.lidar is not None:
        cloud, trajectory, scanner, errors = scan(recipe.lidar, flown, terrain, _sigma(recipe.noise.lidar_m), seed)
    on_path = recipe.lidar is not None and recipe.lidar.same_trajectory
    # Times per strip are sufficient unless cameras change.
    clock = None
    if on_path:
        clock = exposure_times(flown, alone)[event]
    elif (recipe.changes or recipe.temperature) and isinstance(recipe.plan, FlightPlan):
        clock = recipe.plan.clock[event]
    times = flight.time if clock is None else clock
    cooling = recipe.temperature
    temperatures = None if cooling is None else Temperatures(cooling.at(times), cooling.reference_c)
    above = np.zeros(len(times)) if temperatures is None else np.asarray(temperatures.above)
    changes = draw_changes(recipe, flight, times, seed)
    scene = scene._replace(
        rays=reproject_changing(recipe, flight, scene.rays, scene.xyz, motions, times, above, changes)
    )
    truth = Unknowns(
        {name: _numbers(camera.truth) for name, camera in recipe.cameras.items()},
        flight.exterior,
        scene.xyz,
        {name: _numbers(mount.truth) for name, mount in recipe.mounts.items()},
        biases,
        scanner,
    )
    position, attitude = record(flight, mounts, [biases.get(s, NO_BIAS) for s in flight.strips])
    relative = relative_rows(recipe, flight, mounts, seed)
    if on_path and clock is not None and errors is not None:
        position, attitude = recorded_on_path(position, attitude, clock, flown, flight, errors)
    stations, attitudes = _georeferencing(recipe, position, attitude, gnss_images(recipe, flight), seed)
    control, check = _control(recipe, scene, seed)
    start, priors = _start(recipe, flight, scene, control, seed)
    known = with_shutters(recipe, flight, motions, seed, start.unknowns, priors, truth)
    unknowns, priors, truth = with_changes({**changes, RigCamera.kind: rig}, *known)
    start = dataclasses.replace(start, unknowns=unknowns)
    block = Block(
        title=recipe.title, images=flight.images, points=scene.ids, sensors=recipe.sensors, image_camera=flight.cameras,
        image_mount=tuple(recipe.mount_of(camera) for camera in flight.cameras), image_strip=flight.strips,
        image_time=flight.time, image_points=_image_points(recipe, scene, seed), control=control,
        fixed=ControlCoordinates.none(), check=check, stations=stations, attitudes=attitudes,
        distances=Distances.none(), datum=recipe.datum, start=start, priors=priors,
        motion=flight.motion if has_delay(rig) or any(map(_has_time_offset, recipe.mounts.values())) else None,
        flight_time=clock, temperatures=temperatures,
        more=(*camera_steps(recipe, flight, times, start.unknowns), *rig_rows(recipe, flight), *relative),
    )  # fmt: skip
    return Simulation(block, truth, triple(recipe.datum_offset_m), terrain, cloud, trajectory, errors)


def _seen(recipe: Recipe, flight: Flight, scene: TruePoints, seed: int) -> TruePoints:
    """Return the scene with thinned rays. Raises BlockError for an image with fewer than 3 points."""
    points, rays = recipe.points, scene.rays
    if points.mean_rays is not None:
        rays = thin_rays(rays, len(scene.ids), points.min_images, points.mean_rays, stream(seed, "thinning"))
    per_image = np.bincount(rays.image, minlength=len(flight.images))
    for k in np.flatnonzero(per_image < 3):
        raise BlockError(
            f"image {flight.images[k]} sees {per_image[k]} point(s), but an orientation needs 3; request more points "
            "or rays, or extend the swaths beyond the ends"
        )
    return scene._replace(rays=rays)


def _image_points(recipe: Recipe, scene: TruePoints, seed: int) -> ImagePoints:
    image, point, xy = scene.rays
    target = scene.is_target[point][:, None]
    noise = np.where(target, recipe.noise.target_mm, recipe.noise.image_mm)
    stated = np.where(target, recipe.stated.target_mm, recipe.stated.image_mm)
    xy = xy + noise * _draw(seed, "noise of image points", xy.shape)
    return ImagePoints(image, point, xy, np.broadcast_to(stated, xy.shape).copy())


def _control(recipe: Recipe, scene: TruePoints, seed: int) -> tuple[ControlCoordinates, ControlCoordinates]:
    """Return surveyed coordinates of control and check points; noise is drawn for every point, independent of roles."""
    surveyed = scene.xyz + _sigma(recipe.noise.control_m) * _draw(seed, "noise of control", scene.xyz.shape)
    sigma = _sigma(recipe.stated.control_m)

    def rows(*roles: str) -> ControlCoordinates:
        pairs = [(k, axis) for k, role in enumerate(scene.roles) if role in roles for axis in _AXES[role]]
        who, axis = np.array(pairs, int).reshape(-1, 2).T
        return ControlCoordinates(who, axis, surveyed[who, axis], sigma[axis])

    return rows("control", "vertical"), rows("check")


def _georeferencing(
    recipe: Recipe,
    position: Float[np.ndarray, "images 3"],
    attitude: Float[np.ndarray, "images 3"],
    of: Int[np.ndarray, "n"],
    seed: int,
) -> tuple[CameraPositions, Attitudes]:
    """Return GNSS and IMU observations `of` the given images, from `position` (m) and roll, pitch, yaw (rad)."""
    n = len(of)
    stations, attitudes = CameraPositions.none(), Attitudes.none()
    if recipe.stated.station_m is not None:
        position = position[of] + _sigma(recipe.noise.station_m) * _draw(seed, "noise of stations", (n, 3))
        who, axis = np.indices((n, 3)).reshape(2, -1)
        stations = CameraPositions(of[who], axis, position.ravel(), _sigma(recipe.stated.station_m)[axis])
    if recipe.stated.attitude_deg is not None:
        noise = np.deg2rad(_sigma(recipe.noise.attitude_deg)) * _draw(seed, "noise of attitudes", (n, 3))
        sigma = np.deg2rad(_sigma(recipe.stated.attitude_deg))
        attitudes = Attitudes(of, attitude[of] + noise, np.tile(sigma, (n, 1)))
    return stations, attitudes


def _true_biases(recipe: Recipe, flight: Flight, seed: int) -> dict[str, StripBias]:
    """Return shift and drift of every strip that has any, including the datum offset."""
    offset, biases = triple(recipe.datum_offset_m), {}
    for strip in dict.fromkeys(flight.strips):
        bias = _bias_of(recipe, strip)
        if bias is None and not offset.any():
            continue
        bias = bias or SimulatedBias(NO_BIAS)
        shift, drift = _draw(seed, f"bias of strip {strip}", (2, 3))
        biases[strip] = StripBias(
            np.asarray(bias.truth.shift) + offset + triple(bias.shift_sigma_m) * shift,
            np.asarray(bias.truth.drift) + triple(bias.drift_sigma_m_per_s) * drift,
        )
    return biases


def _start(
    recipe: Recipe, flight: Flight, scene: TruePoints, control: ControlCoordinates, seed: int
) -> tuple[Start, Unknowns]:
    """Return start values and priors; control coordinates replace approximate ones."""
    n, near = len(flight.images), recipe.start
    deviation = _draw(seed, "approximate orientation", (2, n, 3))
    position = np.asarray(flight.exterior.position) + near.position_m * deviation[0]
    turn = np.deg2rad(near.angle_deg) * deviation[1]
    exterior = ExteriorOrientation(position, rotate_cameras(flight.exterior, turn))  # type: ignore[arg-type]
    points = np.full(scene.xyz.shape, np.nan)
    if near.points_m is not None:
        points = scene.xyz + near.points_m * _draw(seed, "approximate points", scene.xyz.shape)
    points[control.who, control.axis] = control.value
    known = ~np.isnan(points).any(axis=1)
    points[~known] = 0.0
    strips = dict.fromkeys(flight.strips)
    modelled = {name: bias.model for name in strips if (bias := _bias_of(recipe, name)) and bias.model}
    start = Unknowns(
        {name: _numbers(camera.start) for name, camera in recipe.cameras.items()},
        exterior,
        points,
        {name: _numbers(mount.start) for name, mount in recipe.mounts.items()},
        {name: _numbers(start) for name, (start, _) in modelled.items()},
    )
    priors = Unknowns(
        {name: camera.prior for name, camera in recipe.cameras.items()},
        ExteriorOrientation(FREE, FREE),  # type: ignore[arg-type]
        FREE,  # type: ignore[arg-type]
        {name: mount.prior for name, mount in recipe.mounts.items()},
        {name: prior for name, (_, prior) in modelled.items()},
    )
    return Start(start, np.ones(n, bool), known), priors


def _bias_of(recipe: Recipe, strip: str) -> SimulatedBias | None:
    return recipe.biases.get(strip, recipe.biases.get("default"))


def _has_time_offset(mount: Assumed[Mount]) -> bool:
    """Return True if a time offset is nonzero or estimated: the block then needs the motion of the sensor."""
    offsets = (mount.truth.time_offset, mount.start.time_offset)
    return any(float(offset) != 0 for offset in offsets) or mount.prior.time_offset != FIXED


def _draw(seed: int, purpose: str, shape: tuple[int, ...]) -> np.ndarray:
    return stream(seed, purpose).standard_normal(shape)


def _sigma(values: Triple | None) -> np.ndarray:
    return np.zeros(3) if values is None else triple(values)


def _numbers(tree: InteriorOrientation | Mount | StripBias):
    return jax.tree.map(lambda value: np.asarray(value, float), tree)


# New observations of a block: the same rows, computed from true parameters, with new noise of their sigmas.


def remeasure_rows(rows: Any, block: Block, truth: Unknowns, key: PRNGKeyArray) -> Any:
    """Return the rows with their observations under `truth`, plus normal noise of their sigmas.

    Rows with joint covariances, and rows with parameters missing from `truth`, are not changed.
    """
    if isinstance(rows, Correlated | KnownParameters) or rows.block_parameters or rows.uses_interior or not len(rows):
        return rows
    missing = {what for what, _ in rows.indices()} - {"image", "point", *truth.tables}
    if missing:
        return rows
    touched = [_touched(what, np.asarray(index), block, truth) for what, index in rows.indices()]
    residual = jax.vmap(lambda row, of: row.residual(*of))(with_plain_arrays(rows), touched)
    noise = jnp.asarray(rows.sigmas) * jax.random.normal(key, np.shape(rows.sigmas))
    return rows.with_observation(jnp.asarray(rows.observation) - residual + noise)


def _touched(what: str, index: np.ndarray, block: Block, truth: Unknowns) -> Any:
    if what == "point":
        return jnp.asarray(truth.points)[index]
    if what != "image":
        return jax.tree.map(lambda *v: jnp.stack(v)[index], *map(_floats, truth.tables[what].values()))
    exterior, taken, parameters = truth.exterior, jax.tree.map(lambda v: jnp.asarray(v)[index], exposures(block)), {}
    for kind, owners in truth.tables.items():
        if not owners:
            continue
        table = jax.tree.map(lambda *v: jnp.stack([*v, jnp.zeros_like(v[0])]), *map(_floats, owners.values()))
        place = {name: k for k, name in enumerate(owners)}
        names = block.owners(type(next(iter(owners.values()))).owner)
        at = np.array([place.get(name, len(place)) for name in names])[index]
        parameters[kind] = jax.tree.map(lambda v: v[at], table)  # noqa: B023
    position, rotation = (jnp.asarray(v)[index] for v in (exterior.position, exterior.camera_from_object))
    states = ImageState
    # Vectorise: `ImageState` is defined for a single image.
    for _ in range(index.ndim):
        states = jax.vmap(states)
    return states(position, rotation, taken, parameters)


def _floats(parameters: Any) -> Any:
    return jax.tree.map(lambda v: jnp.asarray(v, float), parameters)


def remeasure(block: Block, truth: Unknowns, key: PRNGKeyArray) -> Block:
    """Replace every observation of `block` by its true value under `truth` plus normal noise of its sigma.

    Image points, stations, attitudes, control, surfaces, distances and further rows are drawn independently. Check and
    fixed coordinates are set to their true values; weighted priors and joint covariances are not changed. Pure and
    differentiable in `truth`; use `vmap` over keys for many blocks at once. An adjustment should estimate `truth`.
    """
    keys = jax.random.split(key, 5)
    draw = lambda k, value, sigma: value + jnp.asarray(sigma) * jax.random.normal(k, value.shape)  # noqa: E731
    rows, points = block.image_points, jnp.asarray(truth.points)
    stations, attitudes = _georeferenced(block, truth)
    a, b = np.asarray(block.distances.points).reshape(-1, 2).T
    length = jnp.sqrt(jnp.sum((points[a] - points[b]) ** 2, axis=1))
    where = lambda x: (  # noqa: E731
        x.image_points.xy, x.stations.value, x.attitudes.roll_pitch_yaw, x.control.value, x.distances.value,
        x.check.value, x.fixed.value, x.surfaces.foot,
    )  # fmt: skip
    new = (
        draw(keys[0], image_coordinates(block, truth), rows.sigma),
        draw(keys[1], stations, block.stations.sigma),
        draw(keys[2], attitudes, block.attitudes.sigma),
        draw(keys[3], points[block.control.who, block.control.axis], block.control.sigma),
        draw(keys[4], length, block.distances.sigma),
        points[block.check.who, block.check.axis],
        points[block.fixed.who, block.fixed.axis],
        _feet(block.surfaces, truth, jax.random.fold_in(key, 5)),
    )
    further = (jax.random.fold_in(key, 6 + k) for k in range(len(block.more)))
    more = tuple(remeasure_rows(rows, block, truth, k) for rows, k in zip(block.more, further, strict=True))
    return dataclasses.replace(eqx.tree_at(where, block, new), more=more)


def _feet(surfaces: SurfaceRows, truth: Unknowns, key: PRNGKeyArray) -> Float[Array, "rows 3"]:
    """Return foot points on the surfaces with shift and boresight of the scanner, and noise along the normal."""
    foot = jnp.asarray(truth.points)[surfaces.point]
    rise = jnp.asarray(surfaces.sigma) * jax.random.normal(key, surfaces.sigma.shape)
    if truth.scanner is not None:
        shifts = jnp.stack([jnp.zeros(3), *truth.scanner.shifts.values()])[1:]
        foot = foot + shifts[surfaces.strip] if len(shifts) else foot
        rise = rise + jnp.asarray(surfaces.turn) @ truth.scanner.boresight
    return foot + rise[:, None] * surfaces.normal


def image_coordinates(block: Block, truth: Unknowns) -> Float[Array, "rows 2"]:
    """Return image coordinates (mm, without noise) of every image row under `truth`."""
    image, point = np.asarray(block.image_points.image), np.asarray(block.image_points.point)
    camera = np.array(block.image_camera)[image]
    exterior, points = jax.tree.map(jnp.asarray, (truth.exterior, truth.points))
    xy, bent = jnp.zeros((len(image), 2)), bent_cameras(block, truth)
    for name, interior in truth.interior.items():
        of_camera = np.flatnonzero(camera == name)
        eo = ExteriorOrientation(exterior.position[image[of_camera]], exterior.camera_from_object[image[of_camera]])
        aim = jax.vmap(apparent_point, in_axes=(0, 0, None))(eo.position, points[point[of_camera]], block.corrections)
        camera_of_row = None if bent is None else 0
        cameras = interior if bent is None else jax.tree.map(lambda v: v[image[of_camera]], bent[name])  # noqa: B023
        xy = xy.at[of_camera].set(jax.vmap(project, in_axes=(camera_of_row, 0, 0))(cameras, eo, aim))
    return xy


def _georeferenced(block: Block, truth: Unknowns) -> tuple[Float[Array, "stations"], Float[Array, "attitudes 3"]]:
    """Return error-free GNSS and IMU observations."""
    arrays = (truth.exterior, *mountings(block, truth), exposures(block))
    exterior, mount, strip, exposure = jax.tree.map(jnp.asarray, arrays)
    sensors, angles = jax.vmap(sensor_record)(exterior.position, exterior.camera_from_object, mount, strip, exposure)
    return sensors[block.stations.who, block.stations.axis], angles[np.asarray(block.attitudes.image)]
