"""Pseudo control points of a whole block: heights for its measured image points.

A point appears in several images, each of which gives it a height. These share laser points, so their mean is hardly
better than one; the image that sees the point most steeply is best, because an orientation error there changes the
place least, and occlusions are rare.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.collinearity import ExteriorOrientation, image_ray
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError
from jaxphoto.lidar.grid import Grid
from jaxphoto.lidar.height_settings import HeightSettings
from jaxphoto.lidar.pseudo_control import Interpolation, PseudoControl, pseudo_control_points
from jaxphoto.observations import ControlCoordinates
from jaxphoto.unknowns import Unknowns


class BlockControl(eqx.Module):
    """Pseudo control of the points of a block, one entry each."""

    point: Int[np.ndarray, "n"]
    """Indices of the block's points."""
    image: Int[np.ndarray, "n"]
    """Image used for each."""
    control: PseudoControl

    def rows(self) -> ControlCoordinates:
        """Return vertical control: Z of the determined points, with its standard deviation."""
        good = np.flatnonzero(np.isfinite(self.control.sigma_z))
        z, sigma = self.control.xyz[good, 2], self.control.sigma_z[good]
        return ControlCoordinates(self.point[good], np.full(len(good), 2), z, sigma)


def pseudo_control_of_block(
    block: Block,
    unknowns: Unknowns,
    grid: Grid,
    points: Int[np.ndarray, "chosen"] | None = None,
    settings: HeightSettings | None = None,
    *,
    interpolation: Interpolation = "weighted",
) -> BlockControl:
    """Return heights from the cloud of `grid`, in the block's frame, for measured `points` (by index; all by default).

    Interior and exterior orientation are those of `unknowns`; the control changes with them. Of the images that
    determine the height of a point, the one with the steepest ray is used. Raises BlockError if no image measured any
    of the points.
    """
    rows = block.image_points
    chosen = np.isin(rows.point, points) if points is not None else np.ones(len(rows.point), bool)
    measured = np.flatnonzero(chosen)
    if not len(measured):
        raise BlockError("no image measured any of the points that are to take heights from the cloud; name others")
    image, point, xy = rows.image[measured], rows.point[measured], to_numpy(rows.xy)[measured]
    exterior = jax.tree.map(lambda v: to_numpy(v)[image], unknowns.exterior)
    camera = np.array(block.image_camera, object)[image]
    found: list[tuple[np.ndarray, PseudoControl, np.ndarray]] = []
    for name in dict.fromkeys(camera):
        of = np.flatnonzero(camera == name)
        one, taken = jax.tree.map(lambda v, of=of: v[of], exterior), xy[of]
        interior = jax.tree.map(to_numpy, unknowns.interior[name])
        control = pseudo_control_points(
            interior, one, taken, grid, settings, interpolation=interpolation, corrections=block.corrections
        )
        steep = call_compiled(_falls, interior, one, taken)
        found.append((of, jax.tree.map(np.asarray, control), np.asarray(steep)))
    back = np.argsort(np.concatenate([of for of, _, _ in found]))
    control = jax.tree.map(lambda *parts: np.concatenate(parts)[back], *(part for _, part, _ in found))
    fall = np.concatenate([steep for _, _, steep in found])[back]
    # By point, valid heights before refused ones, steepest first: the first row of each point.
    order = np.lexsort((fall, np.isnan(control.sigma_z), point))
    first = order[np.unique(point[order], return_index=True)[1]]
    return BlockControl(point[first], image[first], jax.tree.map(lambda v: v[first], control))


@eqx.filter_jit
def _falls(interior, exterior: ExteriorOrientation, xy: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Return the third components of the rays: -1 straight down."""
    return jax.vmap(lambda image, at: image_ray(interior, image, at)[1][2])(exterior, xy)
