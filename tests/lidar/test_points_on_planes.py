"""Planes about points: of the returns in a window of a cell, and how far points are from them."""

import numpy as np

from jaxphoto.lidar.strip_planes import StripSettings, on_planes, planes_of, returns_about

SETTINGS = StripSettings(cell_m=4.0, returns=8)


def test_returns_in_the_window_of_each_point():
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 50, (4000, 3))
    # Also beyond the strip, and at the edge of a cell.
    points = np.vstack([rng.uniform(-3, 53, (40, 3)), [[8.0, 12.0, 0.0]]])
    index, point = returns_about(xyz, points, SETTINGS)
    inside = (np.abs(xyz[None, :, :2] - points[:, None, :2]) < 2.0).all(axis=2)
    assert len(index) == inside.sum()
    assert inside[point, index].all()
    assert len(np.unique(point * len(xyz) + index)) == len(index)


def test_points_above_a_slope():
    rng, slope = np.random.default_rng(1), np.array([0.3, -0.2])
    xy = rng.uniform(0, 50, (8000, 2))
    xyz = np.column_stack([xy, xy @ slope + 0.02 * rng.normal(size=len(xy))])
    normal = np.append(-slope, 1) / np.sqrt(1 + slope @ slope)
    ground = np.column_stack([(at := rng.uniform(5, 45, (60, 2))), at @ slope])
    points = ground + np.linspace(-1, 1, 60)[:, None] * normal
    index, point = returns_about(xyz, points, SETTINGS)
    found = on_planes(planes_of(xyz[index], xyz[index], np.zeros(len(index)), point, SETTINGS), points)
    assert len(found.point) == 60
    off = found.gap - np.linspace(-1, 1, 60)[found.point]
    assert 0.7 < np.sqrt(np.mean((off / found.sigma) ** 2)) < 1.3
    np.testing.assert_allclose(np.linalg.norm(points[found.point] - found.foot, axis=1), np.abs(found.gap), atol=1e-12)
