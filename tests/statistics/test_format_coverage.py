"""What image points reach of a format, against points scattered over it."""

import equinox as eqx
import numpy as np
import pytest
from scipy.spatial import Delaunay

from jaxphoto.statistics.block_geometry import format_coverage
from tests.blocks import adjusted


def test_the_part_of_the_format_is_that_of_random_places_inside():
    a = adjusted("cross")
    found, sensor = format_coverage(a, "one"), a.block.sensors["one"]
    xy, image = np.asarray(a.values.xy).T, a.structure.image
    places = np.random.default_rng(1).uniform(-0.5, 0.5, (20_000, 2)) * [sensor.width_mm, sensor.height_mm]
    assert found.whole == pytest.approx((Delaunay(xy).find_simplex(places) >= 0).mean(), abs=0.02)
    for k, part in zip(np.unique(image), found.images, strict=True):
        assert part == pytest.approx((Delaunay(xy[image == k]).find_simplex(places) >= 0).mean(), abs=0.02)
        assert part <= found.whole


def test_points_on_a_line_reach_nothing():
    a = adjusted("cross")
    flat = eqx.tree_at(lambda a: a.values.xy, a, np.asarray(a.values.xy) * [[1.0], [0.0]])
    found = format_coverage(flat, "one")
    assert found.whole == 0 and (found.images == 0).all()
