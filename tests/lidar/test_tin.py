"""The triangle found among the nearest points is that of the whole triangulation."""

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from jaxphoto.cloud import Cloud
from jaxphoto.lidar import HeightFlag, HeightSettings, heights_at
from tests.lidar.clouds import places_over, read_autzen


@pytest.mark.slow
def test_tin_of_real_cloud_is_that_of_the_whole_triangulation(data_dir: Path) -> None:
    autzen = read_autzen(data_dir)
    places = places_over(autzen)
    found = heights_at(Cloud(autzen), places, "tin", HeightSettings(sigma_z_m=0.05, sigma_xy_m=0.05))
    # About their middle: unreduced map coordinates cost SciPy's triangulation its last digits.
    middle = autzen[:, :2].mean(axis=0)
    expected = LinearNDInterpolator(autzen[:, :2] - middle, autzen[:, 2])(places - middle)
    told = np.isfinite(found.z)
    assert told.sum() > 3000
    np.testing.assert_allclose(found.z[told], expected[told], rtol=0, atol=1e-9)


def test_tin_inside_the_hull_and_none_outside() -> None:
    rng = np.random.default_rng(1)
    xyz = np.column_stack([rng.uniform(0, 50, (300, 2)), rng.normal(size=300)])
    places = rng.uniform(-5, 55, (400, 2))
    found = heights_at(Cloud(xyz), places, "tin", HeightSettings(sigma_xy_m=0.05, refuse=HeightFlag.OK))
    expected = LinearNDInterpolator(xyz[:, :2], xyz[:, 2])(places)
    # All points are looked at here, so that slivers along the hull are found as well.
    np.testing.assert_allclose(found.z, expected, rtol=0, atol=1e-9)
    outside = np.isnan(expected)
    assert outside.sum() > 50
    assert found.flagged(HeightFlag.EDGE)[outside].all()
