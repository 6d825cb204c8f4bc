"""Points behind the images that measured them: the collinearity equations do not mind, photographs do."""

from collections.abc import Iterator

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.errors import counted, few
from jaxphoto.initial.approximate import in_front, looking_away
from jaxphoto.report.findings import Finding, Level


def behind_findings(adjusted: Adjustment) -> Iterator[Finding]:
    """Images that look away from what they measured, and single points behind others."""
    block = adjusted.block
    rows, seen = block.image_points, in_front(block, adjusted.unknowns)
    away = looking_away(block, seen)
    if names := [block.images[k] for k in away]:
        yield Finding(
            Level.ALARM,
            f"what was measured in image {few(names)} lies behind it: it is mirrored, x and y of its image points are "
            "exchanged or one of them has the other sign (or all of it is, and what tells up from down is wrong)",
        )
    behind = np.flatnonzero(~seen & ~np.isin(rows.image, away))
    if len(behind):
        names = [f"{block.points[rows.point[k]]} in {block.images[rows.image[k]]}" for k in behind]
        yield Finding(
            Level.WARNING,
            f"{counted(len(behind), 'image point')} of points behind the image: {few(names)}; rays that meet there are "
            "nearly parallel or wrong, so leave them out",
        )
