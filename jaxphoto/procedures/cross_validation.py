"""k-fold cross-validation of an adjustment: image points predicted from all others.

Image points are omitted such that every object point keeps at least two rays. The block without them is adjusted, and
their prediction by its cameras, orientations and points is compared with the measurements.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import PaddedSizes, common_sizes
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block, bent_cameras
from jaxphoto.collinearity import ExteriorOrientation, image_residual
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import apparent_point
from jaxphoto.observations import ImagePoints
from jaxphoto.unknowns import Unknowns

_LEAST_RAYS = 2


def folds(block: Block, k: int, seed: int = 0) -> Int[np.ndarray, "rows"]:
    """Return the fold (0 ... k - 1) in which each image row is omitted; -1 for rows that never are.

    Rows of a point are assigned to the folds in turn and at random, leaving the point two rays in each. Raises
    BlockError if no point was measured in three images.
    """
    point = np.asarray(block.image_points.point)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(point))
    order = order[np.argsort(point[order], kind="stable")]
    rays = np.bincount(point, minlength=len(block.points))
    first = np.concatenate([[0], np.cumsum(rays)[:-1]])
    place = np.arange(len(order)) - first[point[order]]
    turn = rng.integers(0, k, len(block.points))
    fold = np.full(len(point), -1)
    # The place // k-th of its fold: the point keeps the others.
    allowed = place // k < rays[point[order]] - _LEAST_RAYS
    fold[order] = np.where(allowed, (place + turn[point[order]]) % k, -1)
    if not (fold >= 0).any():
        raise BlockError(
            "no point was measured in three images: there is nothing to leave out, so measure more of them"
        )
    return fold


def without_rows(block: Block, left_out: Bool[np.ndarray, "rows"]) -> Block:
    """Remove some image points of the block."""
    kept, p = ~left_out, block.image_points
    rows = ImagePoints(p.image[kept], p.point[kept], to_numpy(p.xy)[kept], to_numpy(p.sigma)[kept])
    return dataclasses.replace(block, image_points=rows)


def fold_blocks(block: Block, fold: Int[np.ndarray, "rows"]) -> tuple[list[Block], PaddedSizes]:
    """Return the block without each of the folds, and sizes that fit these and the block itself."""
    parts = [without_rows(block, fold == k) for k in range(fold.max() + 1)]
    return parts, common_sizes([block, *parts])


def measured_discrepancies(block: Block, unknowns: Unknowns) -> Float[np.ndarray, "rows 2"]:
    """Return measured minus predicted image coordinate (mm) of every image row, whatever the domain of the distortion.

    It is the residual "measured" of `InteriorOrientation`, so that all models are compared by the same numbers.
    """
    p = block.image_points
    found = np.zeros((len(p.image), 2))
    camera = np.array(block.image_camera, object)[p.image]
    positions, matrices = (to_numpy(v) for v in (unknowns.exterior.position, unknowns.exterior.camera_from_object))
    bent = bent_cameras(block, unknowns)
    for name, interior in unknowns.interior.items():
        own = np.flatnonzero(camera == name)
        if len(own):
            image, point = p.image[own], p.point[own]
            exterior = ExteriorOrientation(positions[image], matrices[image])
            taken = interior if bent is None else jax.tree.map(lambda v: to_numpy(v)[image], bent[name])  # noqa: B023
            numbers = jax.tree.map(lambda v: np.asarray(v, float), dataclasses.replace(taken, residuals="measured"))
            rows = (exterior, to_numpy(unknowns.points)[point], to_numpy(p.xy)[own])
            found[own] = call_compiled(_discrepancies, numbers, *rows, block.corrections, bent is not None)
    return found


@eqx.filter_jit
def _discrepancies(interior, exterior, points, xy, corrections, by_row: bool):
    def of_one(interior, exterior, point, xy):
        aim = apparent_point(exterior.position, point, corrections)
        return image_residual(interior, exterior, aim, xy)

    return jax.vmap(of_one, (0 if by_row else None, 0, 0, 0))(interior, exterior, points, xy)
