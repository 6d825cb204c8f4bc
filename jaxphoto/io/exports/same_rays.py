"""Image points for formats whose cameras are f, k1 and k2 alone: where such a camera sees the same rays.

Nothing of the geometry is lost by that: a ray of the adjusted camera, principal point and all terms taken into account,
is one of the fitted camera through the image point that is written. Coordinates then count from the principal point.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.camera import BundlerRadial, InteriorOrientation, Perspective
from jaxphoto.camera.conversion import Conversion
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.io.cameras.camera_file import CameraModel
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs

RADIAL = CameraModel(BundlerRadial, (), Perspective())


def on_same_rays(photographs: AdjustedPhotographs, cameras: Mapping[str, Conversion]) -> Float[np.ndarray, "n 2"]:
    """The image points (px) at which the cameras that `cameras` were converted to see the rays of `photographs`.

    Raises InputError for an image point that has no ray, because a distortion folds there.
    """
    p, found = photographs, photographs.column_row.copy()
    of_row = np.array(p.image_camera, object)[p.image]
    for name, (sensor, interior) in p.cameras.items():
        rows = np.flatnonzero(of_row == name)
        if cameras[name].max_px == 0 or not len(rows):
            continue
        # To a power of two: one program serves many cameras.
        xy = np.zeros((1 << (len(rows) - 1).bit_length(), 2))
        xy[: len(rows)] = sensor.mm_from_px(found[rows])
        moved, good = (np.asarray(v)[: len(rows)] for v in call_compiled(_moved, interior, cameras[name].interior, xy))
        for k in rows[~good]:
            raise InputError(
                f"point {p.points[p.point[k]]} in image {p.images[p.image[k]]} lies where the distortion of camera "
                f"{name} folds, so that it has no ray; delete the image point, or correct the camera"
            )
        found[rows] = sensor.px_from_mm(moved)
    return found


def from_principal_point(p: AdjustedPhotographs) -> Float[np.ndarray, "n 2"]:
    """Image points in pixels from the principal point, x right and y up."""
    centre = {
        name: sensor.px_from_mm(np.array([[float(interior.x_p), float(interior.y_p)]]))[0]
        for name, (sensor, interior) in p.cameras.items()
    }
    of_image = np.array([centre[name] for name in p.image_camera]).reshape(-1, 2)
    return (p.column_row - of_image[p.image]) * [1.0, -1.0]


def radial_values(p: AdjustedPhotographs) -> Float[np.ndarray, "images 3"]:
    """f in pixels, k1 and k2 of each photograph."""
    own = {
        name: [float(i.c) / sensor.pixel_mm, float(i.distortion.k1), float(i.distortion.k2)]  # type: ignore[attr-defined]
        for name, (sensor, i) in p.cameras.items()
    }
    return np.array([own[name] for name in p.image_camera]).reshape(-1, 3)


@eqx.filter_jit
def _moved(one: InteriorOrientation, other: InteriorOrientation, xy):
    """Where `other` sees the rays that `one` has at image points (mm), and whether these have any."""

    def of_one(at):
        ideal = one.ideal_from_measured(at)
        u, v, w = one.direction_from_ideal(ideal)
        there = other.ideal_from_direction(u, v, w)
        back = jnp.max(jnp.abs(one.measured_from_ideal(ideal) - at))
        good = one.invertible(ideal) & other.invertible(there) & (back < 1e-9 * one.c)
        return other.measured_from_ideal(there), good

    return jax.vmap(of_one)(xy)
