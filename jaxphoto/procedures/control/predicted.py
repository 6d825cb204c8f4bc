"""Where photographs should show surveyed points, with the covariance that says how far to look.

    C = J_i C_i J_i' + J_X C_X J_X'

J_i is by the exterior orientation of the image and the interior one of its camera, with their joint covariance from the
adjustment; J_X by the point, with the covariance of the survey and of what survey and block may differ by in common.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import to_numpy
from jaxphoto.camera import parameter_names
from jaxphoto.collinearity import ExteriorOrientation, in_field, project
from jaxphoto.compiling import jit_quickly
from jaxphoto.georeferencing import apparent_point
from jaxphoto.georeferencing.ground import moved_exterior, moved_interior
from jaxphoto.initial.rays import padded_length
from jaxphoto.statistics import covariance
from jaxphoto.statistics.covariance import rotation_jacobians


class Predicted(NamedTuple):
    """Surveyed points in images; pixels from the upper-left corner, whose pixel has its centre at (0.5, 0.5)."""

    image: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    covariance: Float[np.ndarray, "n 2 2"]
    """In px^2."""
    px_per_m: Float[np.ndarray, "n 2 3"]
    """How the place in the picture moves with X, Y, Z of the point."""

    def take(self, chosen: np.ndarray) -> "Predicted":
        """Those that a mask or indices choose."""
        return Predicted(*(v[chosen] for v in self))


def predicted(
    adjusted: Adjustment, xyz: Float[np.ndarray, "points 3"], of_points: Float[np.ndarray, "points 3 3"]
) -> Predicted:
    """All places where `xyz` (m, in the frame of the block, of covariance `of_points`) are in a picture."""
    block, unknowns = adjusted.block, adjusted.unknowns
    joint = covariance(adjusted)
    n, factor = len(block.images), float(joint.variance_factor)
    matrix, labels = np.asarray(joint.matrix) * factor, list(joint.labels)
    position, turn = to_numpy(unknowns.exterior.position), to_numpy(unknowns.exterior.camera_from_object)
    to_angles = np.asarray(rotation_jacobians(jnp.asarray(np.moveaxis(turn, 0, -1)), joint.rotations))
    found: list[Predicted] = []
    image = np.arange(n).repeat(len(xyz))
    point = np.tile(np.arange(len(xyz)), n)
    camera = np.array(block.image_camera, object)[image]
    for name, interior in unknowns.interior.items():
        own = np.flatnonzero(camera == name)
        if not len(own):
            continue
        i, p = image[own], point[own]
        pad = np.resize(np.arange(len(own)), padded_length(len(own)))
        numbers = jax.tree.map(partial(np.asarray, dtype=float), interior)
        exterior = ExteriorOrientation(position[i[pad]], turn[i[pad]])  # type: ignore[arg-type]
        told = _projected(numbers, exterior, xyz[p[pad]], block.corrections)
        xy, seen, by_point, by_exterior, by_interior = (np.asarray(v)[: len(own)] for v in told)
        free = [k for k, q in enumerate(parameter_names(interior)) if f"interior[{name}].{q}" in labels]
        place = [labels.index(f"interior[{name}].{parameter_names(interior)[k]}") for k in free]
        sensor = block.sensors[name]
        half = np.array([sensor.width_mm, sensor.height_mm]) / 2
        for k in np.flatnonzero(seen & (np.abs(xy) < half).all(axis=1)):
            where = [*range(6 * i[k], 6 * i[k] + 6), *place]
            by_angles = by_exterior[k, :, 3:] @ np.linalg.inv(to_angles[i[k]])
            by = np.column_stack([by_exterior[k, :, :3], by_angles, by_interior[k][:, free]])
            pixel = np.array([1, -1]) / sensor.pixel_mm
            c = by @ matrix[np.ix_(where, where)] @ by.T + by_point[k] @ of_points[p[k]] @ by_point[k].T
            found.append(
                Predicted(
                    i[k : k + 1],
                    p[k : k + 1],
                    sensor.px_from_mm(xy[k : k + 1]),
                    (c * np.outer(pixel, pixel))[None],
                    (by_point[k] * pixel[:, None])[None],
                )
            )
    none = Predicted(
        *(np.zeros((0, *s), t) for s, t in (((), int), ((), int), ((2,), float), ((2, 2), float), ((2, 3), float)))
    )
    return Predicted(*(np.concatenate(parts) for parts in zip(none, *found, strict=True)))


@partial(jit_quickly, static_argnum=3)
def _projected(interior, exterior, points, corrections):
    def one(exterior, point):
        def place(d_point, d_exterior, d_interior):
            image = moved_exterior(exterior, d_exterior)
            aim = apparent_point(image.position, point + d_point, corrections)
            value = project(moved_interior(interior, d_interior), image, aim)
            return value, value

        zeros = jnp.zeros(3), jnp.zeros(6), jnp.zeros(len(parameter_names(interior)))
        by, value = jax.jacfwd(place, argnums=(0, 1, 2), has_aux=True)(*zeros)
        return value, in_field(interior, exterior, point), *by

    return jax.vmap(one)(exterior, points)
