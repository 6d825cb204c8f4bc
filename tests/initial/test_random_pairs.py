"""A thousand relative orientations of any geometry: errors as the covariance says, exact ones exact, and invariance."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from jaxphoto.errors import BlockError
from jaxphoto.initial import relative_orientation, relative_orientations
from jaxphoto.initial.coplanarity import tangent_plane
from jaxphoto.initial.relative import check_described
from tests.formulas import turns
from tests.initial.image_pairs import normalised, rotation_error
from tests.initial.random_scenes import SIGMA_RAD, random_pair

# A study of a thousand cases: minutes.
pytestmark = pytest.mark.slow

N = 1000


class Errors(NamedTuple):
    squares: np.ndarray
    kinds: np.ndarray
    refused: list[str]


def error_of(found, scene):
    turn = rotation_error(found.camera_2_from_camera_1, scene.rotation)
    return np.concatenate([turn, -tangent_plane(found.base).T @ scene.base])


@pytest.fixture(scope="module")
def errors():
    rows, refused = [], []
    for seed in range(N):
        kind, scene = random_pair(seed)
        try:
            all_that_fit = relative_orientations(scene.rays_1, scene.rays_2, SIGMA_RAD)
            for one in all_that_fit:
                check_described(one, "the two images")
        except BlockError as reason:
            refused.append(str(reason))
            continue
        # A flat scene may leave two: then the truth is one of them.
        rows.append((min(normalised(error_of(found, scene), found.covariance) for found in all_that_fit), kind))
    return Errors(*(np.array(column) for column in zip(*rows, strict=True)), refused)


def test_errors_are_those_that_the_covariance_says(errors):
    assert kstest(errors.squares, "chi2", (5,)).pvalue > 1e-3
    assert abs(np.mean(errors.squares) - 5) < 4 * np.sqrt(10 / len(errors.squares))
    assert np.max(errors.squares) < 40


@pytest.mark.parametrize("kind", ["space", "hilly", "flat", "forward"])
def test_errors_of_every_kind(errors, kind):
    squares = errors.squares[errors.kinds == kind]
    assert len(squares) > 150
    assert kstest(squares, "chi2", (5,)).pvalue > 1e-3


def test_few_are_refused_and_each_for_a_reason(errors):
    assert len(errors.refused) <= 0.05 * N
    assert all(
        "the base of" in reason or "determine their relative orientation to" in reason for reason in errors.refused
    )


def test_exact_rays_give_the_exact_orientation():
    for seed in range(200):
        _, scene = random_pair(5000 + seed, sigma=0.0)
        found = relative_orientations(scene.rays_1, scene.rays_2, 1e-6)
        worst = [
            max(np.abs(f.camera_2_from_camera_1 - scene.rotation).max(), np.abs(f.base - scene.base).max())
            for f in found
        ]
        assert min(worst) < 1e-9


angle = st.floats(-3, 3)
tilt = st.floats(-0.2, 0.2)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.integers(0, 1000), st.tuples(tilt, tilt, angle), st.tuples(tilt, tilt, angle))
def test_turning_either_camera_turns_the_result(seed, first, second):
    rng = np.random.default_rng(seed)
    turn_1, turn_2 = turns(np.array([0, 0, first[2]]))[0], turns(np.array([0, 0, second[2]]))[0]
    turn_1, turn_2 = turns(np.array([*first[:2], 0]))[0] @ turn_1, turns(np.array([*second[:2], 0]))[0] @ turn_2
    points = rng.uniform(-1, 1, (30, 3)) * [2, 2, 2] - [0, 0, 7.0]
    base = rng.normal(size=3)
    rays_1, rays_2 = (p / np.linalg.norm(p, axis=1, keepdims=True) for p in (points, points - base))
    found = relative_orientation(rays_1, rays_2, 1e-6)
    again = relative_orientation(rays_1 @ turn_1.T, rays_2 @ turn_2.T, 1e-6)
    expected = turn_2 @ found.camera_2_from_camera_1 @ turn_1.T
    np.testing.assert_allclose(again.camera_2_from_camera_1, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.base, turn_1 @ found.base, rtol=0, atol=1e-9)
