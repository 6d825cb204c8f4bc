"""Common points of images, the links that hold a block together, and the angles of rays, against plain counting."""

import itertools

import numpy as np
import pytest

from jaxphoto.statistics.block_geometry import image_links, intersection_angles, weak_links
from tests.blocks import adjusted


@pytest.fixture(scope="module")
def block():
    """An adjustment, and the points that each of its images measured."""
    found = adjusted("cross")
    s, n = found.structure, len(found.block.images)
    return found, [set(s.point[s.image == k].tolist()) for k in range(n)]


def test_links_are_the_points_that_two_images_share(block):
    found, points = block
    links = image_links(found)
    told = {(i, j): n for i, j, n in zip(links.first, links.second, links.common, strict=True)}
    pairs = itertools.combinations(range(len(points)), 2)
    assert told == {(i, j): n for i, j in pairs if (n := len(points[i] & points[j]))}


def test_no_other_pair_across_a_weak_link_is_stronger(block):
    found, points = block
    links, n = image_links(found), len(points)
    weak = weak_links(found, links, n)
    assert len(weak) == n - 1 and [w.common for w in weak] == sorted(w.common for w in weak)
    for w in weak:
        one = set(w.side.tolist())
        other = set(range(n)) - one
        assert len(one) <= len(other) and (w.first in one) != (w.second in one)
        strongest = max(len(points[i] & points[j]) for i in one for j in other)
        assert w.common == len(points[w.first] & points[w.second]) == strongest
        assert w.across == len(set().union(*(points[k] for k in one)) & set().union(*(points[k] for k in other)))
    assert weak_links(found, links, 2)[1].common == weak[1].common


def test_angles_are_the_largest_between_two_rays(block):
    found, points = block
    angle = intersection_angles(found)
    xyz, station = np.asarray(found.unknowns.points), np.asarray(found.unknowns.exterior.position)
    for p in range(0, len(xyz), 5):
        rays = [station[k] - xyz[p] for k in range(len(points)) if p in points[k]]
        pairs = itertools.combinations(rays, 2)
        largest = max((np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b) for a, b in pairs), default=np.nan)
        assert angle[p] == pytest.approx(largest, abs=1e-7, nan_ok=True)
