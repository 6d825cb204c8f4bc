"""The ground has the shape its recipe says."""

import numpy as np

from jaxphoto.io import recipe_from
from jaxphoto.simulation import ROLLING, RandomWaves, Terrain
from tests.simulation.small import changed

XY = np.random.default_rng(8).uniform(-4000, 4000, (20000, 2))


def terrain(**section) -> Terrain:
    return recipe_from(changed({"terrain": section})).terrain


def test_rolling_country_is_the_formula_of_the_twins():
    expected = 14 * np.sin(XY[:, 0] / 420) + 10 * np.cos(XY[:, 1] / 310)
    np.testing.assert_allclose(ROLLING.height(XY), expected, atol=1e-9)
    rough = ROLLING.place(XY, np.random.default_rng(1))
    np.testing.assert_array_equal(rough[:, :2], XY)
    off = rough[:, 2] - expected
    assert -6 <= off.min() < -5.99 and 5.99 < off.max() <= 6
    assert abs(off.std() - 6 / np.sqrt(3)) < 0.05


def test_plane_and_waves_of_a_recipe():
    plane = terrain(kind="plane", height_m=50.0, slope_east_percent=2.0, slope_north_percent=-1.0)
    np.testing.assert_allclose(plane.height(XY), 50 + 0.02 * XY[:, 0] - 0.01 * XY[:, 1], atol=1e-9)
    wave = {"amplitude_m": 3.0, "length_m": 500.0, "heading_deg": 0.0, "phase_deg": 30.0}
    waves = terrain(kind="waves", waves=[wave, wave])
    np.testing.assert_allclose(waves.height(XY), 6 * np.sin(2 * np.pi * XY[:, 1] / 500 + np.pi / 6), atol=1e-9)
    assert not terrain(kind="flat").height(XY).any()


def test_random_waves_have_their_height_and_follow_their_seed():
    ground = terrain(kind="random", count=40, rms_m=25.0, length_m=300.0)
    assert ground.random == RandomWaves(40, 25.0, 300.0)
    one, other = (ground.drawn(np.random.default_rng(k)).height(XY) for k in (1, 2))
    assert abs(one.std() - 25) < 2.5
    assert np.abs(one - other).max() > 10
    kept = terrain(kind="random", count=40, rms_m=25.0, length_m=300.0, seed=4)
    one, other = (kept.drawn(np.random.default_rng(k)).height(XY) for k in (1, 2))
    np.testing.assert_array_equal(one, other)
