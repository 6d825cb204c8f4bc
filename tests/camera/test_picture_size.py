"""Image points of pictures of another size than that of the camera."""

import equinox as eqx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxphoto import adjust
from jaxphoto.camera import Sensor
from jaxphoto.camera.picture_size import size_mismatch
from tests.blocks import simulated

SENSOR = Sensor(4000, 3000, 0.0024)


def measured(width, height, n=400, seed=0):
    """Image points anywhere on a picture of this size, taken for one of SENSOR's (2 x n, mm)."""
    column_row = np.random.default_rng(seed).uniform(0.03, 0.97, (n, 2)) * [width, height]
    return SENSOR.mm_from_px(column_row).T


@given(st.floats(0.1, 0.7), st.integers(0, 50))
def test_pictures_of_another_size_are_found_with_their_factor(factor, seed):
    for f in (factor, 1 / factor):
        found = size_mismatch(SENSOR, measured(4000 * f, 3000 * f, seed=seed))
        assert found.resized
        assert float(found.text.split("pictures of ")[1].split()[0]) == pytest.approx(f, rel=0.1)


@given(st.integers(0, 200), st.integers(25, 500))
def test_points_of_the_whole_format_are_not_suspected(seed, n):
    assert size_mismatch(SENSOR, measured(4000, 3000, n, seed)) is None


def test_targets_in_the_middle_are_not_suspected():
    assert size_mismatch(SENSOR, measured(4000, 3000) * 0.4) is None


def test_turned_pictures_are_found():
    found = size_mismatch(SENSOR, measured(3000, 4000))
    assert found.resized and "90 degrees" in found.text


def test_points_on_one_side_are_no_resized_picture():
    found = size_mismatch(SENSOR, measured(4000, 3000) * [[0.5], [1.0]] + [[2.0], [0.0]])
    assert not found.resized


def test_few_points_are_not_judged():
    assert size_mismatch(SENSOR, measured(2000, 1500, n=10)) is None


def test_a_block_measured_at_half_size_is_no_success():
    """Its observations agree with each other: half the principal distance, and a principal point far off, fit them."""
    block = simulated("cross").block
    sensor, rows = block.sensors["one"], block.image_points
    corner = np.array([-sensor.width_mm, sensor.height_mm]) / 2
    half = eqx.tree_at(lambda b: b.image_points.xy, block, corner + (np.asarray(rows.xy) - corner) / 2)
    half = eqx.tree_at(lambda b: b.image_points.sigma, half, np.asarray(rows.sigma) / 2)
    verdict = adjust(half).verdict()
    assert {"picture_size", "principal_point_far", "c_far"} <= {f.code for f in verdict.findings}
    assert verdict.severity == "error"
    assert not {"picture_size", "principal_point_far", "c_far"} & {f.code for f in adjust(block).verdict().findings}
