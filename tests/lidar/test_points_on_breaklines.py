"""Faces that meet in a breakline: where they are, and what they say of a point on it."""

import numpy as np
import pytest

from jaxphoto.lidar.strip_planes import PointsOnPlanes, StripSettings, faces_about, on_planes, planes_of
from tests.lidar.clouds import gable, ground

SETTINGS = StripSettings(cell_m=3.0, returns=10)
NOISE_M, SIDE = 0.02, 96.0


def turned(xyz: np.ndarray) -> np.ndarray:
    """By 30 degrees, so that no ridge lies along an axis."""
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    return np.column_stack([xyz[:, :2] @ np.array([[c, s], [-s, c]]), xyz[:, 2]])


def roofs(sign: float) -> np.ndarray:
    return turned(ground(lambda x, y: sign * gable(x, y), 8.0, NOISE_M, NOISE_M, SIDE))


def on_ridges(sign: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(8.0, SIDE, 16.0), np.arange(5.0, SIDE - 5, 7.0))
    return turned(np.column_stack([x.ravel(), y.ravel(), sign * gable(x.ravel(), y.ravel())]))


def over(xyz: np.ndarray, points: np.ndarray) -> PointsOnPlanes:
    index, face = faces_about(xyz, points, SETTINGS)
    patches = planes_of(xyz[index], xyz[index], np.zeros(len(index)), face, SETTINGS)
    return on_planes(patches, np.repeat(points, 2, axis=0))


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["ridge", "valley"])
def test_a_point_on_a_breakline_lies_on_both_faces(sign):
    xyz, points = roofs(sign), on_ridges(sign)
    found = over(xyz, points)
    assert len(found.point) == 2 * len(points) > 100
    w = found.gap / found.sigma
    # What is left of a standard deviation of 1 of some 150 that are known to their own noise, and no bias.
    assert 0.8 < np.sqrt(np.mean(w**2)) < 1.25 and abs(w.mean()) < 0.3
    # Across the ridge a point goes into one face and out of the other; along it nothing happens.
    across, along = turned(np.array([[0.2, 0.0, 0.0], [0.0, 0.2, 0.0]]))
    gap = {name: over(xyz, points + step).gap for name, step in (("across", across), ("along", along))}
    pairs = np.sort(gap["across"].reshape(-1, 2), axis=1)
    np.testing.assert_allclose(pairs.mean(axis=0), [-0.1, 0.1], atol=0.01)
    assert abs(gap["along"].mean()) < 0.01 and np.abs(gap["along"]).max() < 0.06


def test_where_no_two_faces_meet_there_is_none():
    xyz = roofs(1.0)
    on_face = on_ridges(1.0) + turned(np.array([[4.0, 0.0, -4 * np.tan(np.pi / 6)]]))
    outside = np.array([[-500.0, 0.0, 0.0]])
    index, face = faces_about(xyz, np.concatenate([on_face, outside]), SETTINGS)
    assert not len(index) and not len(face)
    # What sticks out of a roof is of no face.
    chimney = turned(np.random.default_rng(1).uniform([8.5, 46.0, 6.0], [9.2, 46.7, 7.0], (5, 3)))
    point = turned(np.array([[8.0, 47.0, gable(np.array(8.0), np.array(0.0))]]))
    index, _ = faces_about(np.concatenate([xyz, chimney]), point, SETTINGS)
    assert len(index) > 100 and index.max() < len(xyz)
