"""Planes of two strips are found where both have them, and nowhere else; their gaps are as good as said."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import InputError
from jaxphoto.lidar.strip_planes import StripSettings, cells_of, corresponding, fitting, planes_of
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
    with pytest.raises(InputError, match="a plane needs 4 returns"):
        dataclasses.replace(SETTINGS, returns=3)
