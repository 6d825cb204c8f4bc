"""Features of two photographs that look alike: each nearest to the other, and clearly nearer than a third."""

from typing import NamedTuple

import faiss
import numpy as np
from jaxtyping import Int

from jaxphoto.image_measurement.features import SiftFeatures

RATIO = 0.8
"""Lowe's: how much nearer the best match must be than the second best."""
# Descriptors are sorted into cells of so many, and looked for in so many of them: a seventh of the time that a look at
# all takes where they are 10,000, and 98 of 100 true matches.
_OF_A_CELL, _CELLS = 40, 8
# Of faiss' k-means, from a fixed seed: rounds, and descriptors of each cell that they are made of.
_ROUNDS, _SAMPLE = 5, 16
METHOD = (faiss.__version__, RATIO, _OF_A_CELL, _CELLS, _ROUNDS, _SAMPLE)
"""What matches depend on beside the features."""


class FindableFeatures(NamedTuple):
    """Features of a photograph, sorted by their looks."""

    features: SiftFeatures
    cells: faiss.IndexIVFScalarQuantizer | None
    """The descriptors; None where they are fewer than two, of which nothing is clearly the nearest."""


def findable(features: SiftFeatures) -> FindableFeatures:
    """Sort the descriptors of a photograph into cells, in which those of other photographs can be looked for."""
    n = len(features.descriptors)
    if n < 2:
        return FindableFeatures(features, None)
    size = features.descriptors.shape[1]
    # The numbers are bytes and stay so: sums of their squares are below 2^24, which single precision holds exactly.
    cells = faiss.IndexIVFScalarQuantizer(
        faiss.IndexFlatL2(size), size, max(1, n // _OF_A_CELL), faiss.ScalarQuantizer.QT_8bit_direct
    )
    # The quantizer belongs to the index, and goes with it.
    cells.by_residual, cells.nprobe = False, _CELLS
    cells.cp.niter, cells.cp.min_points_per_centroid, cells.cp.max_points_per_centroid = _ROUNDS, 1, _SAMPLE
    descriptors = features.descriptors.astype(np.float32)
    cells.train(descriptors)
    cells.add(descriptors)
    return FindableFeatures(features, cells)


def match_descriptors(one: FindableFeatures, other: FindableFeatures) -> Int[np.ndarray, "matches 2"]:
    """Features of two photographs that look alike: indices in `one` and `other`, each feature once at most.

    The nearest descriptor must be below 0.8 of the distance of the second, and so must it be seen from the other side.
    Both are looked for in the cells nearest to a descriptor, so that a second one may be overlooked that is in another.
    """
    if one.cells is None or other.cells is None:
        return np.zeros((0, 2), int)
    rows = np.arange(len(one.features.descriptors))
    best, clear = _nearest(one.features.descriptors, other.cells)
    rows, best = rows[clear], best[clear]
    # From the other side only where it matters.
    columns, where = np.unique(best, return_inverse=True)
    back, clear_back = _nearest(other.features.descriptors[columns], one.cells)
    mutual = (back[where] == rows) & clear_back[where]
    pairs = np.column_stack([one.features.feature[rows[mutual]], other.features.feature[best[mutual]]])
    # A place with several descriptors may match twice.
    pairs = np.unique(pairs, axis=0)
    once = np.ones(len(pairs), bool)
    for side in pairs.T:
        _, inverse, times = np.unique(side, return_inverse=True, return_counts=True)
        once &= times[inverse] == 1
    return pairs[once]


def _nearest(descriptors: np.ndarray, cells: faiss.IndexIVFScalarQuantizer) -> tuple[np.ndarray, np.ndarray]:
    """Of each descriptor the nearest one, and whether it is clearly nearer than the second."""
    square, nearest = cells.search(descriptors.astype(np.float32), 2)
    # Where the cells hold less than two, the square of what is missing is the largest number, and the index -1.
    return nearest[:, 0], (nearest[:, 1] >= 0) & (square[:, 0] < RATIO**2 * square[:, 1])
