"""Planes of strips: correspondence, variances, accumulation by cell, points on planes."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import InputError
from jaxphoto.cloud import Cloud
from jaxphoto.lidar.strip_planes import (
    StripSettings,
    cells_of,
    columns_and_rows,
    corresponding,
    fitting,
    moderated_variances,
    on_planes,
    planes_of,
    returns_about,
    strip_differences,
)
from tests.lidar.clouds import SURFACES, ground

SETTINGS = StripSettings(cell_m=4.0, roughness_m=0.05)
SHIFT = np.array([0.05, -0.08, 0.12])


def patches_of(xyz: np.ndarray, settings: StripSettings = SETTINGS):
    cells = cells_of(xyz, settings)
    return planes_of(xyz, xyz, np.zeros(len(xyz)), cells, settings)


@pytest.mark.parametrize("name", ["plane", "slope 20 deg", "gable"])
def test_gaps_along_normals_scatter_by_their_sigma(name):
    """A strip that is shifted lies off by the shift along each plane's normal."""
    one, other = (ground(SURFACES[name], 4.0, 0.02, 0.02, 120.0, seed) for seed in (1, 2))
    pairs = corresponding(patches_of(one + SHIFT), patches_of(other), SETTINGS)
    assert len(pairs.gap) > 300
    w = (pairs.gap - pairs.normal @ SHIFT) / pairs.sigma
    fits = fitting(w, np.ones(len(w)), 4.0)
    assert fits.mean() > 0.95
    n = fits.sum()
    assert abs(w[fits].mean()) < 4 / np.sqrt(n)
    assert w[fits].std() == pytest.approx(1.0, abs=0.12)


def test_rough_ground_and_half_empty_cells_are_no_planes():
    rng = np.random.default_rng(3)
    trees = ground(lambda x, y: rng.uniform(0, 10, len(x)), 4.0, 0.02, 0.02, 40.0)
    assert len(patches_of(trees).cell) == 0
    flat = ground(SURFACES["plane"], 4.0, 0.02, 0.02, 40.0)
    assert len(patches_of(flat[flat[:, 0] % 4 < 0.5]).cell) == 0
    assert len(patches_of(flat).cell) > 90


def test_planes_that_differ_in_slope_do_not_correspond():
    one, other = (ground(SURFACES[name], 4.0, 0.02, 0.02, 40.0) for name in ("plane", "slope 20 deg"))
    assert len(corresponding(patches_of(one), patches_of(other), SETTINGS).gap) == 0


def test_blunders_do_not_fit():
    gap, sigma = np.random.default_rng(4).normal(0.3, 0.01, 200), np.full(200, 0.01)
    gap[:20] += 0.4
    fits = fitting(gap, sigma, 4.0)
    assert not fits[:20].any() and fits[20:].mean() > 0.98


def test_settings_that_cannot_be():
    with pytest.raises(InputError, match="cell_m is 0: give a positive number"):
        dataclasses.replace(SETTINGS, cell_m=0.0)
    with pytest.raises(InputError, match="returns must be at least 4"):
        dataclasses.replace(SETTINGS, returns=3)


THREE_M = StripSettings(cell_m=3.0)


def test_columns_and_rows_of_cells_on_all_sides_of_the_origin():
    x, y = (v.ravel() for v in np.meshgrid([-7.0, -0.1, 0.0, 2.9, 3.0, 9.5], [-3.0, -0.1, 0.1, 5.0]))
    columns, rows = columns_and_rows(cells_of(np.column_stack([x, y, x]), THREE_M))
    np.testing.assert_array_equal(columns, np.floor(x / 3))
    np.testing.assert_array_equal(rows, np.floor(y / 3))


@pytest.mark.parametrize(("prior", "off"), [(1e9, 0.01), (30.0, 0.05), (8.0, 0.1)])
def test_the_expected_variance_given_what_was_measured(prior, off):
    """Of true variances drawn from the model: right on average for those that look small as for those that do not."""
    rng, n = np.random.default_rng(0), 20_000
    freedom = rng.integers(7, 15, n)
    true = 9e-4 * prior / rng.chisquare(prior, n)
    measured = true * rng.chisquare(freedom) / freedom
    found = moderated_variances(measured, freedom)
    order = np.argsort(found)
    for part in np.array_split(order, 4):
        # 1 / true is what weights should be; its expectation given the measurement is that of a chi squared one.
        assert np.mean(found[part] / true[part]) == pytest.approx(1.0, abs=off)
    assert np.mean(measured / true) == pytest.approx(1.0, abs=0.02)
    assert np.mean((found - true) ** 2) < np.mean((measured - true) ** 2)


def test_variances_that_scatter_by_chance_alone_become_one():
    rng, freedom = np.random.default_rng(2), np.full(500, 10)
    found = moderated_variances(4.0 * rng.chisquare(50.0, 500) / 50.0, freedom)
    assert np.ptp(found) == 0.0 and found[0] == pytest.approx(4.0, rel=0.1)


def test_one_alone_stays():
    np.testing.assert_array_equal(moderated_variances(np.array([2.0]), np.array([7])), [2.0])


EIGHT_RETURNS = StripSettings(cell_m=4.0, returns=8)


def test_returns_in_the_window_of_each_point():
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 50, (4000, 3))
    # Also beyond the strip, and at the edge of a cell.
    points = np.vstack([rng.uniform(-3, 53, (40, 3)), [[8.0, 12.0, 0.0]]])
    index, point = returns_about(xyz, points, EIGHT_RETURNS)
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
    index, point = returns_about(xyz, points, EIGHT_RETURNS)
    found = on_planes(planes_of(xyz[index], xyz[index], np.zeros(len(index)), point, EIGHT_RETURNS), points)
    assert len(found.point) == 60
    off = found.gap - np.linspace(-1, 1, 60)[found.point]
    assert 0.7 < np.sqrt(np.mean((off / found.sigma) ** 2)) < 1.3
    np.testing.assert_allclose(np.linalg.norm(points[found.point] - found.foot, axis=1), np.abs(found.gap), atol=1e-12)


RNG = np.random.default_rng(4)
TWO_M = StripSettings(cell_m=2.0, roughness_m=0.05)


def strip(west, east, height, rough=0.01, n=20_000):
    """Returns of a slope of 1 in 5 from X = west to east, Y from 100 to 120 m."""
    x, y = RNG.uniform(west, east, n), RNG.uniform(100.0, 120.0, n)
    return np.column_stack([x, y, 0.2 * x + height + RNG.normal(0, rough, n)])


def cloud_of(*strips):
    strip = np.repeat(np.arange(len(strips)), [len(xyz) for xyz in strips])
    return Cloud(np.concatenate(strips), strip=strip, strips=tuple("abc"[: len(strips)]))


def test_gaps_are_where_strips_overlap_with_their_sign():
    found = strip_differences(cloud_of(strip(0.0, 30.0, 0.0), strip(20.0, 50.0, 0.12)), TWO_M)
    assert found.west == 0.0 and found.cell_m == 2.0
    row, column = np.indices(found.heights.shape).reshape(2, -1)
    x, y, gap = found.west + 2 * column + 1, found.north - 2 * row - 1, found.heights.ravel()
    there = np.isfinite(gap)
    assert there[(x > 20) & (x < 30) & (y > 100) & (y < 120)].all() and not there[(x < 20) | (x > 30)].any()
    np.testing.assert_allclose(gap[there], 0.12, atol=0.02)


def test_of_three_strips_the_largest_gap_counts_and_rough_ground_has_none():
    parts = (strip(0.0, 30.0, 0.0), strip(0.0, 30.0, -0.2), strip(0.0, 30.0, 0.05))
    found = strip_differences(cloud_of(*parts), TWO_M)
    gap = found.heights[np.isfinite(found.heights)]
    np.testing.assert_allclose(gap, 0.25, atol=0.03)
    assert strip_differences(cloud_of(parts[0], strip(0.0, 30.0, 0.1, rough=0.5)), TWO_M) is None
    assert strip_differences(cloud_of(parts[0], strip(60.0, 90.0, 0.1)), TWO_M) is None
