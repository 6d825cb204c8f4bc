"""Ground coverage, format coverage, links between images and intersection angles, against direct computation."""

import itertools

import equinox as eqx
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial import Delaunay

from jaxphoto.report import Tables
from jaxphoto.report.plots import plot_overlap
from jaxphoto.statistics.block_geometry import (
    Coverage,
    coverage,
    format_coverage,
    image_links,
    intersection_angles,
)
from tests.blocks import adjusted


def test_the_area_of_a_map_of_one_row():
    result = Coverage(np.ones(1), np.ones(1), np.array([1.0, 3.0, 5.0]), np.zeros(1), np.array([[0, 2, 3]]), 2.0)
    assert result.area_m2(1) == 8.0 and result.area_m2(3) == 4.0


def test_cells_are_as_far_apart_as_they_are_wide():
    result = coverage(adjusted("cross"))
    np.testing.assert_allclose(np.diff(result.x), result.step_m)
    np.testing.assert_allclose(np.diff(result.y), result.step_m)
    assert result.area_m2(0) == pytest.approx(len(result.x) * len(result.y) * result.step_m**2)


def test_a_map_of_one_row_is_drawn_as_wide_as_its_cells():
    a = adjusted("cross")
    result = coverage(a)
    axes = Figure().subplots()
    tables = Tables(a)
    tables.coverage = result._replace(y=result.y[:1], seen_by=result.seen_by[:1])
    plot_overlap(tables, axes)
    left, right, bottom, top = axes.images[0].get_extent()
    assert top - bottom == pytest.approx(result.step_m) and right - left == pytest.approx(len(result.x) * result.step_m)


def test_the_part_of_the_format_is_that_of_random_places_inside():
    a = adjusted("cross")
    result, sensor = format_coverage(a, "one"), a.block.sensors["one"]
    xy, image = np.asarray(a.values.xy).T, a.structure.image
    places = np.random.default_rng(1).uniform(-0.5, 0.5, (20_000, 2)) * [sensor.width_mm, sensor.height_mm]
    assert result.whole == pytest.approx((Delaunay(xy).find_simplex(places) >= 0).mean(), abs=0.02)
    for k, part in zip(np.unique(image), result.images, strict=True):
        assert part == pytest.approx((Delaunay(xy[image == k]).find_simplex(places) >= 0).mean(), abs=0.02)
        assert part <= result.whole


def test_points_on_a_line_reach_nothing():
    a = adjusted("cross")
    flat = eqx.tree_at(lambda a: a.values.xy, a, np.asarray(a.values.xy) * [[1.0], [0.0]])
    result = format_coverage(flat, "one")
    assert result.whole == 0 and (result.images == 0).all()


@pytest.fixture(scope="module")
def block():
    """An adjustment, and the points measured by each of its images."""
    result = adjusted("cross")
    s, n = result.structure, len(result.block.images)
    return result, [set(s.point[s.image == k].tolist()) for k in range(n)]


def test_links_are_the_points_that_two_images_share(block):
    result, points = block
    links = image_links(result)
    common = {(i, j): n for i, j, n in zip(links.first, links.second, links.common, strict=True)}
    pairs = itertools.combinations(range(len(points)), 2)
    assert common == {(i, j): n for i, j in pairs if (n := len(points[i] & points[j]))}


def test_angles_are_the_largest_between_two_rays(block):
    result, points = block
    angle = intersection_angles(result)
    xyz, station = np.asarray(result.unknowns.points), np.asarray(result.unknowns.exterior.position)
    for p in range(0, len(xyz), 5):
        rays = [station[k] - xyz[p] for k in range(len(points)) if p in points[k]]
        pairs = itertools.combinations(rays, 2)
        largest = max((np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b) for a, b in pairs), default=np.nan)
        assert angle[p] == pytest.approx(largest, abs=1e-7, nan_ok=True)
