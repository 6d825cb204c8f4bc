"""Map of the height differences between strips, by cell.

In a cell with planes of several strips, the gap is the height of the plane of the later strip above that of the earlier
one at their common place; of more than two strips that of the two that differ most. Rough ground and partly covered
cells have no plane and no gap, so slopes and trees cause none.
"""

from collections.abc import Iterable
from itertools import combinations

import numpy as np

from jaxphoto.cloud import Cloud
from jaxphoto.lidar.cell_returns import CellReturns, CellTally, columns_and_rows
from jaxphoto.lidar.corresponding_planes import corresponding, planes_from
from jaxphoto.lidar.raster import Raster
from jaxphoto.lidar.strip_settings import StripSettings


def strip_differences(strips: Cloud | Iterable[CellReturns], settings: StripSettings) -> Raster | None:
    """Return the gaps (m) of strips in cells of `settings.cell_m`, NaN if there is none; None without any.

    For a cloud larger than memory its accumulated cells suffice.
    """
    cells = _cells(strips, settings) if isinstance(strips, Cloud) else strips
    patches = [planes_from(own, settings) for own in cells]
    columns, ups = columns_and_rows(np.concatenate([p.cell for p in patches]))
    if not len(columns):
        return None
    west, south = int(columns.min()), int(ups.min())
    rows = int(ups.max()) + 1 - south
    gaps = np.full((rows, int(columns.max()) + 1 - west), np.nan)
    for one, other in combinations(range(len(patches)), 2):
        pairs = corresponding(patches[one], patches[other], settings)
        column, up = columns_and_rows(pairs.cell)
        # Along the normal, of the earlier over the later.
        height = -pairs.gap / pairs.normal[:, 2]
        row, column = rows - 1 - (up - south), column - west
        larger = ~(np.abs(gaps[row, column]) >= np.abs(height))
        gaps[row[larger], column[larger]] = height[larger]
    if np.isnan(gaps).all():
        return None
    return Raster(gaps, west * settings.cell_m, (south + rows) * settings.cell_m, settings.cell_m)


def _cells(cloud: Cloud, settings: StripSettings) -> Iterable[CellReturns]:
    tally = CellTally(settings)
    for k, name in enumerate(cloud.strips):
        tally.add(name, cloud.xyz[cloud.strip == k])
    return tally.strips.values()
