"""Exposures on the trajectory of a scanner flown with the camera."""

import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.georeferencing import StripErrors
from jaxphoto.rotation import matrix_from_roll_pitch_yaw, roll_pitch_yaw_from_matrix
from jaxphoto.simulation.chunks import in_chunks
from jaxphoto.simulation.flight import Flight
from jaxphoto.simulation.platform_path import Path
from jaxphoto.simulation.scan_errors import turned_by

_CHUNK = 64


def exposure_times(paths: list[Path], flight: Flight) -> Float[np.ndarray, "images"]:
    """Return the times of all images, on the clock of the paths (s)."""
    time, of = np.zeros(len(flight.images)), np.array(flight.strips)
    for path in paths:
        # A path extends beyond its first and last exposure.
        time[of == path.strip] = path.node[1:-1]
    return time


def recorded_on_path(
    position: Float[np.ndarray, "images 3"],
    roll_pitch_yaw: Float[np.ndarray, "images 3"],
    time: Float[np.ndarray, "images"],
    paths: list[Path],
    flight: Flight,
    errors: StripErrors,
) -> tuple[Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3"]]:
    """Return positions (m) and angles (rad) of the exposures with the trajectory errors at their times."""
    off, turn, of = np.zeros_like(position), np.zeros_like(position), np.array(flight.strips)
    for k, path in enumerate(paths):
        own = of == path.strip
        off[own], turn[own] = errors.at(k, time[own])
    turned = turned_by(in_chunks(_matrices, _CHUNK, roll_pitch_yaw), turn)
    return position + off, in_chunks(_angles, _CHUNK, turned)


_matrices = jax.jit(jax.vmap(matrix_from_roll_pitch_yaw))
_angles = jax.jit(jax.vmap(roll_pitch_yaw_from_matrix))
