"""A thousand resections of any geometry: their errors are those that the covariance says, and exact ones are exact."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import kstest

from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.initial.quaternion_resection import resect_by_quaternions
from jaxphoto.initial.resection import resect
from tests.formulas import camera_from_object
from tests.initial.image_pairs import normalised, rotation_error
from tests.initial.random_scenes import SIGMA_MM, image_scene

# A study of a thousand cases: minutes.
pytestmark = pytest.mark.slow

N = 1000


class Errors(NamedTuple):
    squares: np.ndarray
    """Normalised by the covariance of `resect_by_quaternions`."""
    squares_of_robust: np.ndarray
    """The same of `resect`."""
    variance_factors: np.ndarray
    redundancies: np.ndarray
    kinds: np.ndarray
    refused: list[str]


def error(position, matrix, scene):
    return np.concatenate([np.asarray(position) - scene.position, rotation_error(np.asarray(matrix), scene.matrix)])


@pytest.fixture(scope="module")
def errors():
    rows, refused = [], []
    for seed in range(N):
        scene = image_scene(seed)
        camera = InteriorOrientation(scene.c_mm)
        try:
            found = resect_by_quaternions(camera, scene.xy, scene.points, SIGMA_MM)
        except BlockError as reason:
            refused.append(str(reason))
            continue
        robust = resect(camera, scene.xy, scene.points)
        of_robust = error(robust.position, robust.camera_from_object, scene)
        rows.append(
            (
                normalised(error(found.position, found.camera_from_object, scene), found.covariance),
                normalised(of_robust, found.covariance),
                found.sigma0**2,
                2 * len(scene.points) - 6,
                scene.kind,
            )
        )
    return Errors(*(np.array(column) for column in zip(*rows, strict=True)), refused)


def test_errors_are_those_that_the_covariance_says(errors):
    n = len(errors.squares)
    assert kstest(errors.squares, "chi2", (6,)).pvalue > 1e-3
    assert abs(np.mean(errors.squares) - 6) < 4 * np.sqrt(12 / n)
    weights = errors.redundancies
    factor = np.sum(weights * errors.variance_factors) / np.sum(weights)
    assert abs(factor - 1) < 4 * np.sqrt(2 / np.sum(weights))


@pytest.mark.parametrize("kind", ["flat vertical", "flat convergent", "hilly vertical", "hilly convergent", "space"])
def test_errors_of_every_kind(errors, kind):
    squares = errors.squares[errors.kinds == kind]
    assert len(squares) > 150
    assert kstest(squares, "chi2", (6,)).pvalue > 1e-3


def test_few_are_refused_and_each_for_a_reason(errors):
    assert len(errors.refused) <= 0.02 * N
    assert all("equally well" in reason or "leave its orientation undetermined" in reason for reason in errors.refused)


def test_robust_weights_cost_little(errors):
    # Cauchy's weights take some of the accuracy, and leave no wrong orientation among them.
    assert np.mean(errors.squares_of_robust) < 7
    assert np.max(errors.squares_of_robust) < 50


UNUSUAL = [(0, 0, 0), (0, 0, np.pi), (np.pi / 2, 0, 0), (np.pi / 2, 0, np.pi), (0, np.pi / 2, 0.3), (np.pi, 0, 1.0)]


def test_exact_images_give_the_exact_orientation():
    worst = 0.0
    for seed in range(100):
        scene = image_scene(seed, sigma=0.0)
        matrix = camera_from_object(*UNUSUAL[seed]) if seed < len(UNUSUAL) else scene.matrix
        points = scene.position + (scene.points - scene.position) @ scene.matrix.T @ matrix
        camera = InteriorOrientation(scene.c_mm)
        for found in (resect_by_quaternions(camera, scene.xy, points, 1e-6), resect(camera, scene.xy, points)):
            moved_by = np.linalg.norm(np.asarray(found.position) - scene.position) / 1000
            worst = max(worst, moved_by, np.max(np.abs(np.asarray(found.camera_from_object) - matrix)))
    assert worst < 1e-9
