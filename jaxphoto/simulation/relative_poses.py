"""Simulation of relative control: positions and attitudes relative to the exposure before, in the same strip."""

from typing import Any

import jax
import numpy as np

from jaxphoto.georeferencing import Mount
from jaxphoto.observations import RelativeAttitudes, RelativePositions
from jaxphoto.rotation import matrix_from_roll_pitch_yaw, roll_pitch_yaw_from_matrix
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.flight import NO_BIAS, Flight, record
from jaxphoto.simulation.recipe import Recipe, triple
from jaxphoto.simulation.rig import with_gnss
from jaxphoto.simulation.streams import stream

_CHUNK = 64


def relative_rows(
    recipe: Recipe, flight: Flight, mounts: list[Mount], seed: int
) -> tuple[RelativePositions | RelativeAttitudes, ...]:
    """Return relative observations by carrier phases and gyros of successive exposures of each strip.

    Only their own noise: biases of a strip or trajectory errors do not enter.
    """
    stated, noise = recipe.stated, recipe.noise
    if stated.relative_position_m is None and stated.relative_attitude_deg is None:
        return ()
    position, angles = record(flight, mounts, [NO_BIAS] * len(mounts))
    of, strip = with_gnss(recipe, flight), np.array(flight.strips)
    together = strip[of[:-1]] == strip[of[1:]]
    pair = of[:-1][together], of[1:][together]
    if not (n := len(pair[0])):
        return ()
    rows: list[Any] = []
    if stated.relative_position_m is not None:
        off = triple(noise.relative_position_m) * stream(seed, "noise of relative positions").standard_normal((n, 3))  # type: ignore[arg-type]
        sigma = np.tile(triple(stated.relative_position_m), (n, 1))
        rows.append(RelativePositions(*pair, position[pair[1]] - position[pair[0]] + off, sigma))
    if stated.relative_attitude_deg is not None:
        turn = in_chunks(_relative_angles, _CHUNK, angles[pair[0]], angles[pair[1]])
        off = triple(noise.relative_attitude_deg) * stream(seed, "noise of relative attitudes").standard_normal((n, 3))  # type: ignore[arg-type]
        sigma = np.tile(np.deg2rad(triple(stated.relative_attitude_deg)), (n, 1))
        rows.append(RelativeAttitudes(*pair, turn + np.deg2rad(off), sigma))
    return tuple(rows)


@jax.jit
@jax.vmap
def _relative_angles(first, second):
    """Return roll, pitch and yaw of one body relative to another."""
    return roll_pitch_yaw_from_matrix(matrix_from_roll_pitch_yaw(first).T @ matrix_from_roll_pitch_yaw(second))
