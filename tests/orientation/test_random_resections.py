"""A thousand resections of any geometry: their errors are those that the covariance says, and exact ones are exact."""

from typing import NamedTuple

import jax
import numpy as np
import pytest
from scipy.stats import kstest

from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation, project_ideal
from jaxphoto.errors import BlockError
from jaxphoto.orientation import resect, resect_by_quaternions
from jaxphoto.orientation.resection_steps import linearised, moved
from tests.formulas import camera_from_object, collinearity, random_rotations
from tests.orientation.image_pairs import normalised, rotation_error
from tests.orientation.random_scenes import SIGMA_MM, image_scene

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
    assert all("equally well" in reason or "leave its orientation open" in reason for reason in errors.refused)


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


def test_derivatives_equal_differences_and_those_of_the_collinearity_equations():
    rng = np.random.default_rng(0)
    positions, matrices = rng.normal(size=(3, 3)), random_rotations(rng, 3)
    distances = np.array([2.0, 3, 5])
    points = np.concatenate([rng.normal(size=(7, 3)) - 8 * m[2] + p for p, m in zip(positions, matrices, strict=True)])
    u, slope, in_front = linearised(points, positions, matrices, distances)
    for k in range(6):
        step = np.zeros((3, 6))
        step[:, k] = 1e-6
        there, back = (
            linearised(points, *moved(positions, matrices, distances, s), distances)[0] for s in (step, -step)
        )
        np.testing.assert_allclose(slope[..., k], (there - back) / 2e-6, rtol=1e-6, atol=1e-6 * np.abs(slope).max())
    one = ExteriorOrientation(positions[0], matrices[0])
    by_jax = jax.jacobian(
        lambda position: project_ideal(InteriorOrientation(1.0), ExteriorOrientation(position, matrices[0]), points[0])
    )
    np.testing.assert_allclose(slope[0, 0, :, :3], distances[0] * by_jax(positions[0]), rtol=1e-12)
    np.testing.assert_allclose(u[0, 0], collinearity(1.0, one.omega_phi_kappa, positions[0], points[0]), rtol=1e-12)
    assert in_front[0, :7].all()
