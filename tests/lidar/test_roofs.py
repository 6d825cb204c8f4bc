"""Roofs: segmentation into faces, planes, outlines, centroids and ridges of known truth."""

import numpy as np
import pytest
from scipy.stats import chi2

from jaxphoto.errors import InputError
from jaxphoto.lidar.planes import planar_patches, roof_centroid

SIGMA_XY, SIGMA_Z = 0.5, 0.15
WIDTH, LENGTH, EAVES = 12.0, 16.0, 6.0
ORIGIN = np.array([500.0, -300.0, 90.0])


def scanned(rng, pitch_deg, density=2.0, half=15.0):
    """A house with a ridge along Y on level ground, and which face each point is of: 0 ground, 1 east, 2 west."""
    xy = rng.uniform(-half, half, (int(density * (2 * half) ** 2), 2))
    inside = (np.abs(xy[:, 0]) < WIDTH / 2) & (np.abs(xy[:, 1]) < LENGTH / 2)
    z = np.where(inside, EAVES + np.tan(np.deg2rad(pitch_deg)) * (WIDTH / 2 - np.abs(xy[:, 0])), 0.0)
    points = np.column_stack([xy, z]) + rng.normal(size=(len(xy), 3)) * [SIGMA_XY, SIGMA_XY, SIGMA_Z]
    return points + ORIGIN, np.where(inside, np.where(xy[:, 0] > 0, 1, 2), 0)


@pytest.mark.parametrize("pitch_deg", [15, 30, 45])
def test_the_two_faces_of_a_gable_roof_and_the_ground_are_told_apart(pitch_deg):
    rng = np.random.default_rng(1)
    up = np.deg2rad(pitch_deg)
    squares = []
    for _ in range(8):
        points, face = scanned(rng, pitch_deg)
        patches = planar_patches(points, SIGMA_XY, SIGMA_Z)
        assert len(patches) == 3
        assert [len(p.index) for p in patches] == sorted((len(p.index) for p in patches), reverse=True)
        ground, *faces = patches
        assert np.mean(face[ground.index] == 0) > 0.97
        assert abs(ground.plane.normal[2]) > 0.9999
        for found in faces:
            east = np.sign(found.plane.normal[0])
            assert np.mean(face[found.index] == (1 if east > 0 else 2)) > 0.85
            normal = np.array([east * np.sin(up), 0, np.cos(up)])
            eaves = ORIGIN + np.array([east * WIDTH / 2, 0, EAVES])
            error = np.append(found.plane.normal - normal, normal @ (found.plane.centroid - eaves))
            values, vectors = np.linalg.eigh(found.plane.covariance)
            squares.append(np.sum((vectors[:, 1:].T @ error) ** 2 / values[1:]))
    # Points near the ridge may be of either face: planes are a little less good than of points known to be theirs.
    assert np.mean(squares) / 3 < 2.0
    assert np.mean(np.array(squares) < chi2.ppf(0.99, 3)) > 0.85


def test_outline_is_about_the_face_and_on_its_plane():
    points, _ = scanned(np.random.default_rng(2), 30)
    for face in planar_patches(points, SIGMA_XY, SIGMA_Z)[1:]:
        np.testing.assert_allclose((face.outline - face.plane.centroid) @ face.plane.normal, 0, atol=1e-9)
        x, y = (face.outline[:, :2] - ORIGIN[:2]).T
        area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2
        assert 0.8 < area / (WIDTH / 2 * LENGTH) < 1.4


def test_centroid_and_its_covariance():
    rng = np.random.default_rng(3)
    slope = np.tan(np.deg2rad(30))
    squares = []
    for _ in range(500):
        xy = rng.uniform(-0.5, 0.5, (60, 2)) * [WIDTH / 2, LENGTH]
        points = np.column_stack([xy, slope * xy[:, 0]]) + rng.normal(size=(60, 3)) * [SIGMA_XY, SIGMA_XY, SIGMA_Z]
        centroid, covariance = roof_centroid(points + ORIGIN)
        error = centroid - ORIGIN
        squares.append(error @ np.linalg.solve(covariance, error))
    assert 0.85 < np.mean(squares) / 3 < 1.25
    assert 0.02 < np.mean(np.array(squares) > chi2.ppf(0.95, 3)) < 0.09


def test_trees_are_no_patches_and_few_points_are_told():
    rng = np.random.default_rng(5)
    tree = rng.normal(size=(300, 3)) * [2.5, 2.5, 3.0]
    assert planar_patches(tree, SIGMA_XY, SIGMA_Z) == []
    with pytest.raises(InputError, match="10 laser points, but a planar patch needs 20"):
        planar_patches(tree[:10], SIGMA_XY, SIGMA_Z)
    with pytest.raises(InputError, match="needs 4 laser points, got 2"):
        roof_centroid(tree[:2])
