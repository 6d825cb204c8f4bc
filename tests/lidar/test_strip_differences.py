"""The map of the gaps between strips: their size and sign where they are, nothing where there is no plane of two."""

import numpy as np

from jaxphoto.cloud import Cloud
from jaxphoto.lidar.raster import strip_differences
from jaxphoto.lidar.strip_planes import CellTally, StripSettings

RNG = np.random.default_rng(4)
SETTINGS = StripSettings(cell_m=2.0, roughness_m=0.05)


def strip(west, east, height, rough=0.01, n=20_000):
    """Returns of a slope of 1 in 5 from X = west to east, Y from 100 to 120 m."""
    x, y = RNG.uniform(west, east, n), RNG.uniform(100.0, 120.0, n)
    return np.column_stack([x, y, 0.2 * x + height + RNG.normal(0, rough, n)])


def cells_of_strips(*strips):
    tally = CellTally(SETTINGS)
    for name, xyz in zip("abc", strips, strict=False):
        for part in np.array_split(xyz, 3):
            tally.add(name, part)
    return tally.strips.values()


def test_gaps_are_where_strips_overlap_with_their_sign():
    found = strip_differences(cells_of_strips(strip(0.0, 30.0, 0.0), strip(20.0, 50.0, 0.12)), SETTINGS)
    assert found.west == 0.0 and found.cell_m == 2.0
    x, y, gap = found.centres().T
    there = np.isfinite(gap)
    assert there[(x > 20) & (x < 30) & (y > 100) & (y < 120)].all() and not there[(x < 20) | (x > 30)].any()
    np.testing.assert_allclose(gap[there], 0.12, atol=0.02)


def test_a_cloud_has_the_gaps_of_its_cells():
    parts = strip(0.0, 30.0, 0.0), strip(20.0, 50.0, 0.12)
    cloud = Cloud(np.concatenate(parts), strip=np.repeat([0, 1], 20_000), strips=("a", "b"))
    found, expected = (strip_differences(of, SETTINGS) for of in (cloud, cells_of_strips(*parts)))
    np.testing.assert_allclose(found.heights, expected.heights, atol=1e-12)


def test_of_three_strips_the_largest_gap_counts_and_rough_ground_has_none():
    parts = (strip(0.0, 30.0, 0.0), strip(0.0, 30.0, -0.2), strip(0.0, 30.0, 0.05))
    found = strip_differences(cells_of_strips(*parts), SETTINGS)
    gap = found.heights[np.isfinite(found.heights)]
    np.testing.assert_allclose(gap, 0.25, atol=0.03)
    assert strip_differences(cells_of_strips(parts[0], strip(0.0, 30.0, 0.1, rough=0.5)), SETTINGS) is None
    assert strip_differences(cells_of_strips(parts[0], strip(60.0, 90.0, 0.1)), SETTINGS) is None
