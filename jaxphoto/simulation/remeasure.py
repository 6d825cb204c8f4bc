"""Simulation of new observations of a block: the same rows, from known unknowns, with new noise of their sigmas."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxphoto.block import Block, bent_cameras, exposures, mountings
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.georeferencing import apparent_point
from jaxphoto.observations import AbstractObservations, Correlated, ImageState, KnownParameters, SurfaceRows
from jaxphoto.simulation.flight import sensor_record
from jaxphoto.static_values import with_plain_arrays
from jaxphoto.unknowns import Unknowns

Rows = AbstractObservations | KnownParameters


def remeasure_rows(rows: Rows, block: Block, truth: Unknowns, key: PRNGKeyArray) -> Rows:
    """Return the rows with their observations under `truth`, plus normal noise of their sigmas.

    Rows with joint covariances, and those that touch parameters `truth` does not have, are not changed.
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
        return jax.tree.map(lambda *v: jnp.stack(v)[index], *map(_numbers, truth.tables[what].values()))
    exterior, taken, parameters = truth.exterior, jax.tree.map(lambda v: jnp.asarray(v)[index], exposures(block)), {}
    for kind, owners in truth.tables.items():
        if not owners:
            continue
        table = jax.tree.map(lambda *v: jnp.stack([*v, jnp.zeros_like(v[0])]), *map(_numbers, owners.values()))
        place = {name: k for k, name in enumerate(owners)}
        names = block.owners(type(next(iter(owners.values()))).owner)
        at = np.array([place.get(name, len(place)) for name in names])[index]
        parameters[kind] = jax.tree.map(lambda v: v[at], table)  # noqa: B023
    position, rotation = (jnp.asarray(v)[index] for v in (exterior.position, exterior.camera_from_object))
    states = ImageState
    # One image each: a state is declared as that of one.
    for _ in range(index.ndim):
        states = jax.vmap(states)
    return states(position, rotation, taken, parameters)


def _numbers(parameters: Any) -> Any:
    return jax.tree.map(lambda v: jnp.asarray(v, float), parameters)


def remeasure(block: Block, truth: Unknowns, key: PRNGKeyArray) -> Block:
    """Replace every observation of `block` by its true value under `truth` plus normal noise of its sigma.

    Image points, stations, attitudes, control, surfaces, distances and further rows are drawn independently; check and
    fixed coordinates become true ones; weighted priors and joint covariances stay. Pure and differentiable in `truth`;
    `vmap` over keys gives many blocks at once. An adjustment should recover `truth`.
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
    """Return laser points of the surfaces with shift and boresight of the scanner, and noise along the normal."""
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
