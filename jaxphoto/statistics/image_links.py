"""Which images of a block share points, and where the block hangs together by the fewest.

Images are nodes, and the points that two of them both measured are the strength of the link between them. The spanning
tree of the strongest links holds, for every pair of images, the way between them whose weakest link is as strong as
can be; so its weakest links are where the block would come apart first.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Int

from jaxphoto.adjustment import Adjustment


class ImageLinks(NamedTuple):
    """Pairs of images that have points in common."""

    first: Int[np.ndarray, "pairs"]
    second: Int[np.ndarray, "pairs"]
    """Indices of images; the first is the smaller."""
    common: Int[np.ndarray, "pairs"]
    """How many object points both measured."""


class WeakLink(NamedTuple):
    """A link without which the block would hang together by weaker ones."""

    first: int
    second: int
    common: int
    """Points that these two images share,"""
    across: int
    """and all points measured on both sides of it."""
    side: Int[np.ndarray, "images"]
    """The images of the smaller side."""


def image_links(adjusted: Adjustment) -> ImageLinks:
    """All pairs of images with at least one point in common."""
    measured = _measured(adjusted)
    common = scipy.sparse.triu(measured @ measured.T, k=1, format="coo")
    first, second = common.coords
    return ImageLinks(first.astype(int), second.astype(int), common.data.astype(int))


def weak_links(adjusted: Adjustment, links: ImageLinks, most: int) -> list[WeakLink]:
    """The `most` weakest links of the tree of the strongest ones, the weakest first."""
    n, measured = len(adjusted.block.images), _measured(adjusted)
    # The strongest tree is the shortest one of what falls as links grow stronger.
    ends = links.first.astype(np.int32), links.second.astype(np.int32)
    length = scipy.sparse.coo_array((1.0 / links.common, ends), shape=(n, n))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(length.tocsr()).tocoo()
    found = []
    for cut in np.argsort(-tree.data, kind="stable")[:most]:
        first, second = (int(end[cut]) for end in tree.coords)
        rest = np.arange(tree.nnz) != cut
        apart = scipy.sparse.coo_array((tree.data[rest], [end[rest] for end in tree.coords]), shape=(n, n))
        _, part = scipy.sparse.csgraph.connected_components(apart, directed=False)
        one, other = (np.flatnonzero(part == part[end]) for end in (first, second))
        seen = [np.asarray(measured[side].sum(axis=0)).ravel() > 0 for side in (one, other)]
        common = round(1 / float(tree.data[cut]))
        side = min(one, other, key=len)
        found.append(WeakLink(min(first, second), max(first, second), common, int((seen[0] & seen[1]).sum()), side))
    return found


def _measured(adjusted: Adjustment) -> "scipy.sparse.csr_array":
    """Images by points: one where an image measured a point."""
    s = adjusted.structure
    shape = len(adjusted.block.images), len(adjusted.block.points)
    found = scipy.sparse.csr_array((np.ones(len(s.image), int), (s.image, s.point)), shape=shape)
    # Measured twice in one image is measured once.
    found.data[:] = 1
    return found
