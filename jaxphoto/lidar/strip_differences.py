"""Where strips differ, and by how much: a map of the gaps between their planes, cell by cell.

In a cell that several strips have a plane in, the gap is by how much the plane of the later strip lies above that of
the earlier one, in height at the place that both share; of more than two strips that of the two that differ most. Rough
ground and cells that a strip fills in part only have no plane and no gap, so that slopes and trees make none.
"""

from itertools import combinations

import numpy as np

from jaxphoto.cloud import Cloud
from jaxphoto.lidar.corresponding_planes import cells_of, columns_and_rows, corresponding, planes_of
from jaxphoto.lidar.raster import Raster
from jaxphoto.lidar.strip_settings import StripSettings


def strip_differences(cloud: Cloud, settings: StripSettings) -> Raster | None:
    """The gaps (m) of the strips of `cloud` in cells of `settings.cell_m`, NaN where none is; None without any."""
    assert cloud.strip is not None
    origin = np.floor(cloud.extent[0, :2] / settings.cell_m) * settings.cell_m
    patches = []
    for k in range(len(cloud.strips)):
        xyz = cloud.xyz[cloud.strip == k]
        patches.append(planes_of(xyz, xyz, np.zeros(len(xyz)), cells_of(xyz, origin, settings), settings))
    columns, rows = (np.ceil((cloud.extent[1, :2] - origin) / settings.cell_m).astype(int) + 1).tolist()
    gaps = np.full((rows, columns), np.nan)
    for one, other in combinations(range(len(patches)), 2):
        pairs = corresponding(patches[one], patches[other], settings)
        column, up = columns_and_rows(pairs.cell)
        # Along the normal, of the earlier over the later.
        height = -pairs.gap / pairs.normal[:, 2]
        row = rows - 1 - up
        larger = ~(np.abs(gaps[row, column]) >= np.abs(height))
        gaps[row[larger], column[larger]] = height[larger]
    if np.isnan(gaps).all():
        return None
    north = float(origin[1] + rows * settings.cell_m)
    return Raster(gaps, float(origin[0]), north, settings.cell_m)
