"""Residuals of a block: every observation, divided by its standard deviation, as a function of increments.

Increments are scaled and small: `unknown = start (+) scale * increment`, rotations by a small rotation in the
camera frame. Arrays are batch-last (components first, rows last), which XLA vectorises best on a CPU.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.shared import MOUNT_SIZE, STRIP_SIZE
from jaxphoto.adjustment.structure import Structure, total
from jaxphoto.georeferencing import (
    Exposure,
    Mount,
    StripBias,
    attitude_residual,
    recorded_attitude,
    sensor_position,
)
from jaxphoto.rotation import matrix_from_roll_pitch_yaw, small_rotation


class Increments(NamedTuple):
    """Scaled changes of the unknowns since the start: what the solver iterates on."""

    eop: Float[Array, "6 images"]
    shared: Float[Array, "shared"]
    points: Float[Array, "3 points"]


class Residuals(NamedTuple):
    """Observed minus computed over sigma, by group. `datum` holds the constraints that observations leave open.

    Of a padded structure, `image` is (chunks, tiles, 2, m, p), as `Values.xy`, `control` (3, points), and `surfaces`
    (rows, points).
    """

    image: Float[Array, "2 rows"]
    stations: Float[Array, "stations"]
    attitudes: Float[Array, "3 attitudes"]
    control: Float[Array, "control"]
    surfaces: Float[Array, "surfaces"]
    distances: Float[Array, "distances"]
    priors: Float[Array, "weighted"]
    datum: Float[Array, "constraints"]


GROUPS = {
    "image": "image_points",
    "stations": "stations",
    "attitudes": "attitudes",
    "control": "control_points",
    "surfaces": "surfaces",
    "distances": "distances",
    "priors": "priors",
}
"""Groups of observations: field of `Residuals` -> the name tables and files give it."""


class Values(eqx.Module):
    """The numbers of an adjustment, batch-last: observations, sigmas, start, and constraint rows of the datum.

    Of a padded structure, `xy` is (chunks, tiles, 2, m, p) and `control` (3, points), each with its sigmas.
    """

    xy: Float[Array, "2 rows"]
    sigma_xy: Float[Array, "2 rows"]
    stations: Float[Array, "stations"]
    sigma_stations: Float[Array, "stations"]
    time: Float[Array, "images"]
    velocity: Float[Array, "3 images"]
    rate: Float[Array, "3 images"]
    nominal: Float[Array, "3 3 images"]
    attitudes: Float[Array, "3 attitudes"]
    sigma_attitudes: Float[Array, "3 attitudes"]
    control: Float[Array, "control"]
    sigma_control: Float[Array, "control"]
    foot: Float[Array, "3 surfaces"]
    """Of the rows of surfaces (`Block.surfaces`); of a padded structure these are (rows, points)."""
    normal: Float[Array, "3 surfaces"]
    turn: Float[Array, "3 surfaces"]
    sigma_surfaces: Float[Array, "surfaces"]
    distances: Float[Array, "distances"]
    sigma_distances: Float[Array, "distances"]
    priors: Float[Array, "weighted"]
    sigma_priors: Float[Array, "weighted"]
    position: Float[Array, "3 images"]
    rotation: Float[Array, "3 3 images"]
    shared: Float[Array, "parameters"]
    points: Float[Array, "3 points"]
    datum_eop: Float[Array, "constraints 6 images"]
    datum_points: Float[Array, "constraints 3 points"]


class State(NamedTuple):
    """The unknowns themselves, batch-last."""

    position: Float[Array, "3 images"]
    rotation: Float[Array, "3 3 images"]
    shared: Float[Array, "parameters"]
    points: Float[Array, "3 points"]


def state_at(increments: Increments, scale: Increments, values: Values, structure: Structure) -> State:
    """Start values moved by scaled increments; what is fixed does not move."""
    eop = increments.eop * scale.eop
    turn = jax.vmap(small_rotation, in_axes=-1, out_axes=-1)(eop[3:])
    rotation = jnp.stack([jnp.stack([jnp.sum(turn[i] * values.rotation[:, j], 0) for j in range(3)]) for i in range(3)])
    return State(
        values.position + eop[:3],
        rotation,
        jnp.asarray(values.shared).at[structure.free].add(increments.shared * scale.shared, unique_indices=True),
        values.points + increments.points * scale.points,
    )


def other_residuals(increments: Increments, scale: Increments, values: Values, structure: Structure) -> Residuals:
    """All residuals but those of the image rows, which are left empty (for them see `normal.residuals_at`)."""
    state = state_at(increments, scale, values, structure)
    stations, attitudes, control, distances = georeferencing_residuals(state, values, structure)
    priors = (values.priors - state.shared[structure.free[structure.weighted]]) / values.sigma_priors
    return Residuals(
        jnp.zeros((2, 0)),
        stations / values.sigma_stations,
        attitudes / values.sigma_attitudes,
        control / values.sigma_control,
        surface_residuals(state, values, structure) / values.sigma_surfaces,
        distances / values.sigma_distances,
        priors,
        datum_residuals(increments, scale, values, structure),
    )


def surface_residuals(state: State, values: Values, structure: Structure) -> Float[Array, "surfaces"]:
    """By how much points lie below the laser scanner's surfaces (m), along their normals (`Block.surfaces`)."""
    v, s = values, structure
    points = state.points[:, None] if s.tiles is not None else state.points[:, s.surface_point]
    apart = points - v.foot
    rise = jnp.zeros(())
    if s.mount_offset > s.scanner_offset:
        boresight, *shifts = state.shared[s.scanner_offset : s.mount_offset].reshape(-1, 3)
        apart = apart + jnp.stack(shifts, axis=1)[:, s.surface_strip] if shifts else apart
        rise = sum((b * t for b, t in zip(boresight, v.turn, strict=True)), rise)
    return -(sum((n * a for n, a in zip(v.normal, apart, strict=True)), jnp.zeros(())) + rise)


def datum_residuals(
    increments: Increments, scale: Increments, values: Values, structure: Structure
) -> Float[Array, "constraints"]:
    """By how much the constraints of the datum are violated."""
    eop = jnp.einsum("kci,ci->k", values.datum_eop * scale.eop, increments.eop)
    points = jnp.einsum("kcp,cp->k", values.datum_points * scale.points, increments.points)
    return eop + total(points, structure)


def georeferencing_residuals(state: State, values: Values, structure: Structure) -> tuple[Array, ...]:
    """Residuals of stations (m), attitudes (rad), control (m) and distances (m), not divided by their sigmas."""
    mounts, strips = _mounts(state, structure)
    exposures = Exposure(values.time, values.velocity, values.rate, values.nominal)

    def station(image, axis, observed):
        rotation = state.rotation[:, :, image]
        mount, strip, exposure = jax.tree.map(lambda v: v[..., image], (mounts, strips, exposures))
        return observed - sensor_position(state.position[:, image], rotation, mount, strip, exposure)[axis]

    def attitude(image, observed):
        mount, exposure = jax.tree.map(lambda v: v[..., image], (mounts, exposures))
        computed = recorded_attitude(state.rotation[:, :, image], mount, exposure)
        return attitude_residual(matrix_from_roll_pitch_yaw(observed), computed)

    # Groups without rows are left out of the program: what is not there need not be compiled.
    stations, attitudes, distances = jnp.zeros(0), jnp.zeros((3, 0)), jnp.zeros(0)
    if structure.mount_offset == state.shared.shape[0]:
        # Neither mounts nor strips: a station is the projection centre itself.
        stations = values.stations - state.position[structure.station_axis, structure.station_image]
    elif len(structure.station_image):
        stations = jax.vmap(station)(structure.station_image, structure.station_axis, values.stations)
    if len(structure.attitude_image):
        attitudes = jax.vmap(attitude, in_axes=(0, -1), out_axes=-1)(structure.attitude_image, values.attitudes)
    padded = structure.tiles is not None
    control = values.control - state.points[() if padded else (structure.control_axis, structure.control_point)]
    if len(structure.distance_points):
        a, b = structure.distance_points.T
        distances = values.distances - jnp.sqrt(jnp.sum((state.points[:, a] - state.points[:, b]) ** 2, axis=0))
    return stations, attitudes, control, distances


def _mounts(state: State, structure: Structure) -> tuple[Mount, StripBias]:
    """Mount and strip bias of every image (3, images); zeros where the block has none."""

    def table(start: int, stop: int, size: int, index) -> Array:
        # The last row, of zeros, serves images that have no mount or strip of their own.
        return jnp.concatenate([state.shared[start:stop].reshape(-1, size), jnp.zeros((1, size))])[index].T

    mount = table(structure.mount_offset, structure.strip_offset, MOUNT_SIZE, structure.mount)
    strip = table(structure.strip_offset, state.shared.shape[0], STRIP_SIZE, structure.strip)
    return Mount(mount[:3], mount[3:6], mount[6]), StripBias(strip[:3], strip[3:])
