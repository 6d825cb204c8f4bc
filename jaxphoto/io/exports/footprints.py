"""What photographs show of the ground: the border of the format on the mean height of the points that each shows."""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.arrays import still
from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation, image_ray
from jaxphoto.compiling import call_compiled
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs

# Points along each side of the format: distortion and relief of a map bend its border.
_ALONG = 8
# A ray that comes to the ground so many times the height above it away looks at the horizon.
_FARTHEST = 20.0


def footprints(photographs: AdjustedPhotographs) -> list[Float[np.ndarray, "n 3"] | None]:
    """Of each photograph the border on the ground in the block's frame (m), counter-clockwise from above.

    On the mean height of all points where it shows none. None for a photograph that looks at the horizon.
    """
    p = photographs
    everywhere = float(np.mean(p.xyz[:, 2])) if len(p.xyz) else 0.0
    found = []
    for i, rows in enumerate(p.rows_of_images):
        camera = p.cameras[p.image_camera[i]]
        ground = float(np.mean(p.xyz[p.point[rows], 2])) if len(rows) else everywhere
        border = _border(camera.sensor.width_mm, camera.sensor.height_mm)
        exterior = ExteriorOrientation(p.exterior.position[i], p.exterior.camera_from_object[i])
        directions = still(call_compiled(_directions, camera.interior, exterior, border))
        found.append(_on_the_ground(still(exterior.position), directions, ground))
    return found


def _border(width_mm: float, height_mm: float) -> np.ndarray:
    """Points of the border (mm), counter-clockwise as the picture is seen, each corner once."""
    t = np.arange(_ALONG) / _ALONG - 0.5
    half = np.full(_ALONG, 0.5)
    sides = [(t, -half), (half, t), (-t, half), (-half, -t)]
    return np.concatenate([np.stack(side, axis=1) for side in sides]) * [width_mm, height_mm]


@eqx.filter_jit
def _directions(interior: InteriorOrientation, exterior: ExteriorOrientation, xy: Float[Array, "n 2"]):
    return jax.vmap(lambda one: image_ray(interior, exterior, one)[1])(xy)


def _on_the_ground(position: np.ndarray, directions: np.ndarray, ground: float) -> np.ndarray | None:
    above = position[2] - ground
    with np.errstate(divide="ignore", invalid="ignore"):
        way = -above / directions[:, 2]
    if not (above > 0 and np.all((way > 0) & (way < _FARTHEST * above))):
        return None
    ring = position + way[:, None] * directions
    x, y = (ring - position)[:, :2].T
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    return ring if area > 0 else ring[::-1]
