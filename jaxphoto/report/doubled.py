"""Images that are there twice: what is measured once and counted twice makes standard deviations too small."""

from collections.abc import Iterator

import numpy as np

from jaxphoto.block import Block
from jaxphoto.report.findings import Finding, Level

# So many image points of two images, and such a part of those of either, are not alike to a tenth of their standard
# deviation by chance: a photograph measured anew differs by all of it.
_SEVERAL, _MOST, _ALIKE = 4, 0.5, 0.1


def doubled_images(block: Block) -> list[tuple[str, str, int]]:
    """Two images and how many of their image points have the same point, x and y, or next to it."""
    rows = block.image_points
    x, y = np.asarray(rows.xy).T
    order = np.lexsort([rows.image, y, x, rows.point])
    least = _ALIKE * np.asarray(rows.sigma).min(axis=1)[order][1:]
    point, image, x, y = (v[order] for v in (rows.point, rows.image, x, y))
    alike = (point[1:] == point[:-1]) & (image[1:] != image[:-1]) & (np.diff(x) <= least) & (abs(np.diff(y)) <= least)
    pairs, count = np.unique(np.sort(np.stack([image[1:], image[:-1]])[:, alike], axis=0), axis=1, return_counts=True)
    seen = np.bincount(rows.image, minlength=len(block.images))
    enough = (count >= _SEVERAL) & (count > _MOST * seen[pairs].max(axis=0))
    return [
        (block.images[a], block.images[b], int(n)) for (a, b), n in zip(pairs.T[enough], count[enough], strict=True)
    ]


def doubled_findings(block: Block) -> Iterator[Finding]:
    """A sentence for the first such pair, and how many more there are."""
    if found := doubled_images(block):
        one, other, n = found[0]
        more = f", and so are {len(found) - 1} more pairs" if len(found) > 1 else ""
        yield Finding(
            Level.WARNING,
            f"images {one} and {other} are alike: {n} image points have the same coordinates{more}; "
            "one photograph counted twice makes standard deviations too small, delete one of each",
        )
