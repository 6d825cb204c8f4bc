"""Targets on the ground in windows of photographs: the place to a part of a pixel, nothing where there is none."""

import cv2
import numpy as np
import pytest

from jaxphoto.errors import InputError
from jaxphoto.extras.photos.targets.on_ground import read_target

# Pixels a metre: seen at a slant, turned.
ACROSS = np.array([[31.0, 9.0], [-7.0, 36.0]])
TRUE = np.array([61.37, 57.82])


def circle(x, y):
    return np.where(np.hypot(x, y) < 0.3, 230.0, 90.0)


def cross(x, y):
    inside = (np.abs(x) < 0.4) & (np.abs(y) < 0.4)
    return np.where(inside, np.where(x * y > 0, 25.0, 235.0), 120.0)


def marker(number):
    drawn = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), number, 6)
    padded = np.pad(drawn, 1, constant_values=255).astype(float)

    def grey(x, y):
        # Rows run down, y up; 1.6 m with the margin.
        column, row = (np.floor(v / 0.2).astype(int) + 4 for v in (x, -y))
        inside = (column >= 0) & (row >= 0) & (column < 8) & (row < 8)
        return np.where(inside, padded[np.clip(row, 0, 7), np.clip(column, 0, 7)], 120.0)

    return grey


def window(grey, size=120, noise=2.0, seed=0):
    """A picture of what lies at metres about `TRUE` (as OpenCV counts): rows down, y up."""
    rng = np.random.default_rng(seed)
    step = (np.arange(9) + 0.5) / 9 - 0.5
    pixel = np.arange(size)
    column, row = np.meshgrid((pixel[:, None] + step).ravel(), (pixel[:, None] + step).ravel())
    d = np.stack([column - TRUE[0], row - TRUE[1]], axis=-1)
    metres = d @ np.linalg.inv(ACROSS * [[1], [-1]]).T
    fine = grey(metres[..., 0], metres[..., 1]).reshape(size, 9, size, 9).mean(axis=(1, 3))
    picture = cv2.GaussianBlur(fine, (0, 0), 0.7) + noise * rng.normal(size=(size, size))
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("description", "grey", "limit"),
    [
        ("circle:diameter_mm=600", circle, 0.05),
        ("cross:side_mm=800", cross, 0.05),
        ("aruco:dictionary=4X4_50", marker(7), 0.1),
    ],
    ids=["circle", "cross", "aruco"],
)
def test_a_target_is_found_where_it_is(description, grey, limit):
    target = read_target(description)
    found = target.find(window(grey), "GCP7", ACROSS * [[1], [-1]])
    assert found.found.sum() == 1
    off = found.column_row[0] - TRUE
    assert np.abs(off).max() < limit and (np.abs(off) < 5 * found.sigma_px[0] + 0.02).all()


@pytest.mark.parametrize("description", ["circle:diameter_mm=600", "cross:side_mm=800", "aruco:dictionary=4X4_50"])
def test_nothing_is_found_where_nothing_is(description):
    target = read_target(description)
    empty = window(lambda x, y: 120.0 + 20 * np.sin(3 * x) * np.cos(2 * y))
    assert not target.find(empty, "GCP7", ACROSS).found.any()


def test_another_size_or_number_is_another_target():
    assert not read_target("circle:diameter_mm=1500").find(window(circle), "a", ACROSS).found.any()
    assert not read_target("aruco:dictionary=4X4_50").find(window(marker(8)), "GCP7", ACROSS).found.any()
    assert not read_target("aruco:dictionary=4X4_50").find(window(marker(8)), "no number", ACROSS).found.any()


@pytest.mark.parametrize(
    ("description", "words"),
    [
        ("disc", "write one of circle:diameter_mm=300"),
        ("circle", "write it like circle:diameter_mm=300"),
        ("circle:diameter_mm=-3", "diameter_mm is '-3', not a positive"),
        ("aruco:dictionary=9X9", "unknown dictionary '9X9'"),
    ],
)
def test_a_wrong_description_is_said_with_the_syntax(description, words):
    with pytest.raises(InputError, match=words.replace(":", ".")):
        read_target(description)
