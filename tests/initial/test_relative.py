"""Relative orientation against the truth: exact, within its covariance, with false matches, and where it is open."""

import numpy as np
import pytest
from scipy.stats import kstest

from jaxphoto.errors import BlockError
from jaxphoto.initial import relative_orientation, relative_orientations
from jaxphoto.initial.coplanarity import RayPairs, essential, fit, misclosures, moved, tangent_plane
from jaxphoto.initial.five_point import five_point_essentials, orientations
from jaxphoto.initial.homography import homographies, homography_orientations, transfer_errors
from tests.checked_types import unchecked
from tests.formulas import turns
from tests.initial.image_pairs import normalised, pair_scene, rays_of, rotation_error

SIGMA = 5e-4


def error_of(found, scene):
    turn = rotation_error(found.camera_2_from_camera_1, scene.rotation)
    return np.concatenate([turn, -tangent_plane(found.base).T @ scene.base])


@pytest.mark.parametrize("base", [[1, 0, 0], [0.3, -1, 0.2], [0, 0, -1]], ids=["aside", "oblique", "forward"])
@pytest.mark.parametrize("n", [8, 40])
def test_exact_rays_give_the_exact_orientation(base, n):
    scene = pair_scene(n, seed=n, base=base)
    found = relative_orientation(scene.rays_1, scene.rays_2, 1e-5)
    np.testing.assert_allclose(found.camera_2_from_camera_1, scene.rotation, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.base, scene.base, rtol=0, atol=1e-9)
    assert found.agrees.all()


def test_one_of_the_five_point_solutions_is_the_truth():
    for seed in range(50):
        scene = pair_scene(5, seed)
        found = five_point_essentials(scene.rays_1[None], scene.rays_2[None])
        truth = essential(scene.rotation, scene.base)
        apart = [min(np.abs(e - truth).max(), np.abs(e + truth).max()) for e in found]
        assert min(apart) < 1e-6
        # What every one of them must be: two equal singular values and a zero, and the five conditions met.
        np.testing.assert_allclose(np.linalg.svd(found)[1], np.tile([1.0, 1, 0], (len(found), 1)), rtol=0, atol=1e-6)
        np.testing.assert_allclose(np.einsum("ni,sij,nj->sn", scene.rays_2, found, scene.rays_1), 0, atol=1e-9)


def test_four_orientations_of_an_essential_matrix():
    scene = pair_scene(20, 3)
    matrix = essential(scene.rotation, scene.base)
    rotations, bases = orientations(matrix[None])
    np.testing.assert_allclose(np.linalg.det(rotations[0]), 1)
    for rotation, base in zip(rotations[0], bases[0], strict=True):
        same = np.abs(essential(rotation, base) - matrix).max(), np.abs(essential(rotation, base) + matrix).max()
        assert min(same) < 1e-12
    apart = [
        np.abs(r - scene.rotation).max() + np.abs(b - scene.base).max()
        for r, b in zip(rotations[0], bases[0], strict=True)
    ]
    assert np.sort(apart)[0] < 1e-9 < 0.1 < np.sort(apart)[1]


def test_least_squares_is_the_least():
    scene = pair_scene(30, 4, sigma=SIGMA)
    pairs = RayPairs.of(scene.rays_1, scene.rays_2, SIGMA)
    found = fit(scene.rotation[None], scene.base[None], pairs, np.ones((1, 30), bool))
    (value,), (slope,), (normal,) = found.values, found.slopes, found.normals
    np.testing.assert_allclose(slope.T @ value / np.sqrt(np.diagonal(normal)), 0, atol=1e-5)

    def misclosures_at(*step):
        return misclosures(essential(*moved(found.rotations, found.bases, np.array([step]))), pairs)[0]

    np.testing.assert_allclose(value, misclosures_at(0, 0, 0, 0, 0), atol=1e-9)
    assert value @ value < np.sum(misclosures(essential(scene.rotation, scene.base)[None], pairs) ** 2)
    np.testing.assert_allclose(normal, slope.T @ slope, rtol=1e-12)
    for k, step in enumerate(1e-6 * np.eye(5)):
        difference = (misclosures_at(*step) - misclosures_at(*-step)) / 2e-6
        np.testing.assert_allclose(slope[:, k], difference, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize(("false", "flat", "n", "count"), [(0.3, False, 60, 120), (0.3, True, 60, 60)])
def test_errors_are_those_that_the_covariance_says(false, flat, n, count):
    squares, variance_factors = [], []
    for seed in range(count):
        scene = pair_scene(n, seed, SIGMA, false, flat)
        all_that_fit = relative_orientations(scene.rays_1, scene.rays_2, SIGMA)
        # A flat scene may leave two: then the truth is one of them.
        squares.append(min(normalised(error_of(found, scene), found.covariance) for found in all_that_fit))
        variance_factors.append(all_that_fit[0].sigma0 ** 2)
    assert kstest(squares, "chi2", (5,)).pvalue > 1e-3
    # Now and then a false match within 3.3 sigma of its epipolar line takes part, and nobody can know.
    assert np.mean(np.array(squares) > 25) <= 0.015
    assert abs(np.mean(variance_factors) - 1) < 0.05


@pytest.mark.parametrize("false", [0.3, 0.5])
def test_false_matches_change_nothing(false):
    for seed in range(5):
        scene = pair_scene(400, seed, SIGMA, false)
        found = relative_orientation(scene.rays_1, scene.rays_2, SIGMA)
        true = slice(scene.false, None)
        without = relative_orientation(scene.rays_1[true], scene.rays_2[true], SIGMA)
        moved = rotation_error(found.camera_2_from_camera_1, without.camera_2_from_camera_1)
        moved = np.concatenate([moved, tangent_plane(found.base).T @ -without.base])
        assert np.all(np.abs(moved) < 3 * np.sqrt(np.diagonal(found.covariance)))
        assert found.agrees[: scene.false].mean() < 0.03
        assert found.agrees[true].mean() > 0.98


def test_forward_motion_with_points_at_the_epipole():
    squares = []
    for seed in range(60):
        scene = pair_scene(40, seed, SIGMA, base=[0, 0, -1], turn=0.01)
        near = rays_of(scene.base[:2] + 5 * SIGMA * np.random.default_rng(seed).normal(size=(2, 2)))
        rays_1 = np.concatenate([scene.rays_1, near])
        in_2 = rays_of((near @ scene.rotation.T)[:, :2] / -(near @ scene.rotation.T)[:, 2:])
        found = relative_orientation(rays_1, np.concatenate([scene.rays_2, in_2]), SIGMA)
        squares.append(normalised(error_of(found, scene), found.covariance))
    assert kstest(squares, "chi2", (5,)).pvalue > 1e-3
    assert np.max(squares) < 30


def test_few_points():
    scene = pair_scene(4, 0)
    with pytest.raises(BlockError, match=r"4 points in common.* needs 5"):
        relative_orientation(scene.rays_1, scene.rays_2, SIGMA)


@pytest.mark.parametrize("n", [5, 6, 7, 8])
def test_all_orientations_of_exact_minimal_points(n):
    for seed in range(10):
        scene = pair_scene(n, seed)
        found = relative_orientations(scene.rays_1, scene.rays_2, 1e-7, robust=False)
        apart = [np.abs(f.camera_2_from_camera_1 - scene.rotation).max() for f in found]
        assert min(apart) < 1e-8
        assert n == 5 or len(found) <= 2


def test_points_on_a_critical_surface():
    """Where x_2' F x_1 = 0 holds for another essential matrix F, too: a quadric through both projection centres."""
    told = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        scene = pair_scene(5, seed, base=[1, 0.2, 0.1])
        other = essential(turns(0.3 * rng.normal(size=3))[0] @ scene.rotation, scene.base[[1, 2, 0]])
        directions = np.column_stack([rng.uniform(-0.6, 0.6, (4000, 2)), -np.ones(4000)])
        in_2 = directions @ scene.rotation.T
        base_2 = scene.rotation @ scene.base
        depth = (directions @ other.T @ base_2) / np.einsum("ni,ij,nj->n", in_2, other, directions)
        seen_2 = depth[:, None] * in_2 - base_2
        good = (depth > 2) & (depth < 15) & (seen_2[:, 2] < -0.5) & (np.abs(seen_2[:, :2]).max(1) < -1.5 * seen_2[:, 2])
        points, seen_2 = (directions * depth[:, None])[good][:40], seen_2[good][:40]
        if len(points) < 40:
            continue
        noisy = (rays_of(p[:, :2] / -p[:, 2:] + SIGMA * rng.normal(size=(40, 2))) for p in (points, seen_2))
        told += 1
        try:
            found = relative_orientations(*noisy, SIGMA)
        except BlockError as reason:
            assert "determine their relative orientation" in str(reason)
            continue
        assert min(normalised(error_of(f, scene), f.covariance) for f in found) < 30
    assert told >= 3


def test_rays_that_are_no_numbers_or_in_no_order():
    scene = pair_scene(20, 0)
    spoilt = scene.rays_2.copy()
    spoilt[3] = np.nan
    with pytest.raises(BlockError, match="1 of the 20 rays of the two images are NaN"):
        relative_orientation(scene.rays_1, spoilt, SIGMA)
    with pytest.raises(ValueError, match="got 20 and 19"), unchecked():
        relative_orientation(scene.rays_1, scene.rays_2[:19], SIGMA)
    with pytest.raises(ValueError, match=r"sigma_rad, .* must be positive, got 0"):
        relative_orientation(scene.rays_1, scene.rays_2, 0.0)


def test_covariance_that_does_not_tell_the_errors():
    # A small flat figure from afar, with a short base: what is known of the orientation lies on a curve.
    refused = 0
    for seed in range(6):
        scene = pair_scene(15, seed, 10 * SIGMA, flat=True, base=[1, 0, 0], length=1.0)
        with pytest.raises(BlockError, match=r"determine their relative orientation|base of|fit their|random matches"):
            relative_orientation(scene.rays_1, scene.rays_2, 10 * SIGMA)
        refused += 1
    assert refused == 6


def test_images_from_one_place():
    scene = pair_scene(100, 0, SIGMA, length=0.0)
    with pytest.raises(BlockError, match="the base of images a and b is zero"):
        relative_orientation(scene.rays_1, scene.rays_2, SIGMA, images="images a and b")
    # A far scene is no better, and false matches do not hide it.
    false = pair_scene(300, 1, SIGMA, length=1e-3, false=0.3)
    with pytest.raises(BlockError, match="base of"):
        relative_orientation(false.rays_1, false.rays_2, SIGMA)


def test_points_on_a_line():
    along = np.linspace(-1, 1, 30)[:, None] * [2.0, 1.0, 0.5] - [0, 0, 6]
    rotation = turns([[0.05, 0.1, -0.2]])[0]
    rng = np.random.default_rng(0)
    for sigma in (0.0, SIGMA):
        in_2 = (along - [1.0, 0, 0]) @ rotation.T
        one, two = (rays_of(p[:, :2] / -p[:, 2:] + sigma * rng.normal(size=(30, 2))) for p in (along, in_2))
        with pytest.raises(BlockError, match="line"):
            relative_orientation(one, two, SIGMA)


def test_matches_that_are_all_false():
    for seed in range(5):
        xy = np.random.default_rng(seed).uniform(-0.6, 0.6, (2, 60, 2))
        with pytest.raises(BlockError, match=r"random matches|base of|equally well"):
            relative_orientation(rays_of(xy[0]), rays_of(xy[1]), SIGMA)


def test_homography_of_a_plane_and_its_two_orientations():
    for seed in range(20):
        scene = pair_scene(20, seed, flat=True)
        (matrix,) = homographies(scene.rays_1[None, :4], scene.rays_2[None, :4])
        pairs = RayPairs.of(scene.rays_1, scene.rays_2, 1e-6)
        assert np.max(transfer_errors(matrix[None], pairs)) < 1e-3
        found = homography_orientations(matrix, scene.rays_1)
        apart = [np.abs(r - scene.rotation).max() + np.abs(b - scene.base).max() for r, b in found]
        assert np.sort(apart)[0] < 1e-6 < 0.01 < np.sort(apart)[1]
        # Both meet the coplanarity condition of every point of the plane.
        for rotation, base in found:
            matrix = essential(rotation, base)
            np.testing.assert_allclose(np.einsum("ni,ij,nj->n", scene.rays_2, matrix, scene.rays_1), 0, atol=1e-6)
    turned = homographies(scene.rays_1[None], scene.rays_1[None] @ scene.rotation.T)[0]
    np.testing.assert_allclose(turned, scene.rotation, atol=1e-7)
    assert homography_orientations(turned, scene.rays_1) == []


def test_both_orientations_of_a_flat_scene_are_told():
    told = 0
    for seed in range(40):
        scene = pair_scene(60, seed, SIGMA, flat=True)
        found = relative_orientations(scene.rays_1, scene.rays_2, SIGMA)
        apart = [normalised(error_of(f, scene), f.covariance) for f in found]
        assert min(apart) < 40, "the truth is not among them"
        if len(found) > 1:
            told += 1
            with pytest.raises(BlockError, match="fit their 60 common points equally well"):
                relative_orientation(scene.rays_1, scene.rays_2, SIGMA)
    assert told >= 3


def test_the_order_of_the_images_does_not_matter():
    scene = pair_scene(50, 7, SIGMA)
    found = relative_orientation(scene.rays_1, scene.rays_2, SIGMA)
    backwards = relative_orientation(scene.rays_2, scene.rays_1, SIGMA)
    assert np.all(np.abs(rotation_error(backwards.camera_2_from_camera_1, found.camera_2_from_camera_1.T)) < 2e-4)
    np.testing.assert_allclose(backwards.base, -found.camera_2_from_camera_1 @ found.base, atol=5e-3)
