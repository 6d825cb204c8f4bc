"""Rays and ideal coordinates from image coordinates, vectorised."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.camera import InteriorOrientation, Perspective
from jaxphoto.compiling import jit_quickly

# Cosine of the maximum angle (80 degrees) from the axis at which a fisheye ray is projected to the perspective plane; a
# pixel there is 30 times as large as in the centre.
_FLATTEST = 0.17


@jit_quickly
def directions_of(interior: InteriorOrientation, xy: Float[Array, "rows 2"]) -> Float[Array, "rows 3"]:
    """Return directions in the camera frame of image coordinates (mm); accepts traced values."""
    return jax.vmap(lambda one: jnp.stack(interior.direction_from_ideal(interior.ideal_from_measured(one))))(xy)


def ideal_coordinates(interior: InteriorOrientation, xy_mm: Float[np.ndarray, "rows 2"]) -> Float[np.ndarray, "rows 2"]:
    """Return the ideal coordinates (mm, from the principal point) of one camera's measured rows in the perspective
    plane.

    NaN for a fisheye ray farther than 80 degrees from the axis.
    """
    directions = _of_rows(interior, xy_mm)
    # Compute the quotient first: it is exactly 1 for a perspective camera.
    ideal = directions[:, :2] * (-float(interior.c) / directions[:, 2:])
    if type(interior.projection) is not Perspective:
        ideal[~(-directions[:, 2] > _FLATTEST * np.linalg.norm(directions, axis=1))] = np.nan
    return ideal


def camera_rays(interior: InteriorOrientation, xy_mm: Float[np.ndarray, "rows 2"]) -> Float[np.ndarray, "rows 3"]:
    """Return unit directions in the camera frame for measured rows of one camera with any projection."""
    directions = _of_rows(interior, xy_mm)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _of_rows(interior: InteriorOrientation, xy_mm: Float[np.ndarray, "rows 2"]) -> Float[np.ndarray, "rows 3"]:
    n = len(xy_mm)
    xy = np.zeros((padded_length(n), 2))
    xy[:n] = xy_mm
    # Convert floats to arrays: constants would require a separate compiled program for each camera.
    numbers = jax.tree.map(partial(np.asarray, dtype=float), interior)
    return np.asarray(directions_of(numbers, xy))[:n]


def padded_length(n: int) -> int:
    """Return the next of 32, 128, 512, 2048, 4096, ...: a block of a hundred images compiles two or three times."""
    length = 32
    while length < n:
        length *= 4 if length < 2048 else 2
    return length


def padded(values: np.ndarray, length: int) -> np.ndarray:
    """Repeat the last row of `values` up to `length` rows."""
    return values[np.minimum(np.arange(length), len(values) - 1)]


def unit_rays(
    c_mm: Float[np.ndarray, " rows"] | float, ideal: Float[np.ndarray, "rows 2"]
) -> Float[np.ndarray, "rows 3"]:
    """Return unit directions (x, y, -c) in the camera frame."""
    rays = np.column_stack([ideal, -np.broadcast_to(c_mm, len(ideal))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def turn_to_object(
    camera_from_object: Float[np.ndarray, "images 3 3"],
    image: Int[np.ndarray, " rows"],
    rays: Float[np.ndarray, "rows 3"],
) -> Float[np.ndarray, "rows 3"]:
    """Rotate rays from the camera frames of their images to the object frame."""
    return np.einsum("nij,ni->nj", camera_from_object[image], rays)
