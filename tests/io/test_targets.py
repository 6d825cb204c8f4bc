"""Targets of boards in rendered photographs whose truth is known: identity, place, standard deviation."""

import cv2
import numpy as np
import pytest

from jaxphoto import ExteriorOrientation, InputError, InteriorOrientation, Sensor, Smac
from jaxphoto.io.photographs import photographs
from jaxphoto.io.targets import find_targets, read_board, rendered
from jaxphoto.procedures.calibration.eccentricity import eccentricities
from jaxphoto.procedures.calibration.reprojection import projections

SENSOR = Sensor(480, 360, 0.008)
LENS = InteriorOrientation(3.2, 0.03, -0.02, Smac(k1=-0.02, k2=-0.001))
BOARDS = (
    "chessboard:8x5:square_mm=22",
    "circles:4x9:spacing_mm=18:diameter_mm=15",
    "charuco:6x5:square_mm=30:marker_mm=21:dictionary=4X4_50",
    "aruco:4x3:marker_mm=40:gap_mm=15:dictionary=4X4_50",
)
VIEWS = 3


def view(board, k: int) -> ExteriorOrientation:
    """A camera over the board, tilted by half a radian to one side or another, and turned about its axis."""
    middle = board.xyz_m.mean(axis=0)
    away = np.array([0.13 * np.cos(1.7 * k + 0.3), 0.13 * np.sin(1.7 * k + 0.3), 0.25])
    z = away / np.linalg.norm(away)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    c, s = np.cos(0.35 * k + 0.2), np.sin(0.35 * k + 0.2)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return ExteriorOrientation(middle + away, turn @ np.stack([x, np.cross(z, x), z]))  # type: ignore[arg-type]


def truth_px(board, exterior, points) -> np.ndarray:
    """What is measured of targets without noise: corners, and centroids of the images of circles."""
    n = len(points)
    place = np.tile(exterior.position, (n, 1)), np.tile(exterior.camera_from_object, (n, 1, 1)), board.xyz_m[points]
    xy = projections(LENS, *place)
    if board.diameter_m.any():
        xy = xy + eccentricities(LENS, *place, np.eye(3)[:, :2], board.diameter_m[points] / 2)
    return SENSOR.px_from_mm(xy)


def compared(pattern) -> tuple[np.ndarray, np.ndarray, int]:
    """Errors and sigmas (px) of all targets in several views, and how many were in view."""
    errors, sigmas, in_view = [], [], 0
    board = pattern.board
    for k in range(VIEWS):
        exterior = view(board, k)
        found = pattern.find(rendered(pattern, SENSOR, LENS, exterior, noise=4.0, seed=k))
        assert found is not None, k
        every = truth_px(board, exterior, np.arange(len(board.points)))
        in_view += int(((every > 5) & (every < [SENSOR.width_px - 5, SENSOR.height_px - 5])).all(axis=1).sum())
        good = found.places.found
        # A chessboard turned by half a turn may look the same: either labelling is right.
        tried = []
        for point in (found.point[good], len(board.points) - 1 - found.point[good]):
            tried.append(found.places.column_row[good] + 0.5 - every[point])
        errors.append(min(tried, key=lambda e: float(np.median(np.abs(e)))))
        sigmas.append(found.places.sigma_px[good])
    return np.concatenate(errors), np.concatenate(sigmas), in_view


@pytest.mark.parametrize("description", BOARDS, ids=lambda d: d.split(":")[0])
def test_errors_are_as_large_as_their_standard_deviations(description):
    errors, sigmas, in_view = compared(read_board(description))
    assert len(errors) > 0.8 * in_view
    assert np.abs(errors).max() < 0.5
    ratio = np.sqrt(np.mean((errors / sigmas) ** 2))
    # Of some 150 coordinates: 6 % of sampling; what the window, the lens and the rendering add makes it larger.
    assert 0.8 < ratio < 1.5, ratio
    assert np.sqrt(np.mean(errors**2)) < 0.1


@pytest.fixture
def circles_csv(tmp_path):
    """Thirty circles in no order that turns into itself."""
    rng = np.random.default_rng(3)
    lines = ["point,X_mm,Y_mm,Z_mm,diameter_mm"]
    for k in range(30):
        x, y = (np.array(divmod(k, 5)) * 30 + rng.uniform(-6, 6, 2)).round(2)
        lines.append(f"t{k},{x},{y},0,{14 if rng.random() < 0.8 else 10}")
    path = tmp_path / "field.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_single_targets_are_told_apart_and_placed(circles_csv):
    errors, sigmas, in_view = compared(read_board(f"targets:{circles_csv}"))
    assert len(errors) > 0.6 * in_view
    assert np.abs(errors).max() < 0.5
    assert 0.8 < np.sqrt(np.mean((errors / sigmas) ** 2)) < 1.5


def test_an_arrangement_that_turns_into_itself_is_refused(tmp_path):
    lines = ["point,X_mm,Y_mm,Z_mm,diameter_mm"]
    lines += [f"t{k},{30 * (k % 5)},{30 * (k // 5)},0,14" for k in range(25)]
    (tmp_path / "grid.csv").write_text("\n".join(lines) + "\n")
    pattern = read_board(f"targets:{tmp_path / 'grid.csv'}")
    assert pattern.find(rendered(pattern, SENSOR, LENS, view(pattern.board, 0), rays=8)) is None


@pytest.mark.parametrize(
    ("description", "words"),
    [
        ("chess:8x6", ["chess", "chessboard:8x6:square_mm=30"]),
        ("chessboard", ["columns x rows"]),
        ("chessboard:8x6", ["square_mm is missing"]),
        ("chessboard:8by6:square_mm=30", ["8by6", "columns x rows"]),
        ("chessboard:8x6:square_mm=-3", ["square_mm is '-3'", "positive"]),
        ("chessboard:8x6:square_mm=nan", ["square_mm is 'nan'"]),
        ("chessboard:8x6:size=3", ["'size=3'", "square_mm=..."]),
        ("circles:4x11:spacing_mm=20:diameter_mm=40", ["touch"]),
        ("circles:4x2:spacing_mm=20:diameter_mm=15", ["3 rows"]),
        ("charuco:7x5:square_mm=30:marker_mm=40:dictionary=4X4_50", ["not smaller"]),
        ("charuco:7x5:square_mm=30:marker_mm=20:dictionary=9X9", ["9X9", "4X4_50"]),
        ("aruco:9x9:marker_mm=30:gap_mm=5:dictionary=4X4_50", ["81 markers"]),
        ("targets:", ["file", "targets:FILE.csv"]),
        ("targets:nowhere.csv", ["nowhere.csv"]),
    ],
)
def test_a_wrong_description_is_one_sentence_with_the_syntax(description, words):
    with pytest.raises(InputError) as error:
        read_board(description)
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_no_board_anywhere_suggests_the_other_count(tmp_path):
    pattern = read_board("chessboard:8x5:square_mm=22")
    cv2.imwrite(str(tmp_path / "a.png"), rendered(pattern, SENSOR, LENS, view(pattern.board, 0), rays=4))
    taken = photographs([tmp_path / "a.png"])
    with pytest.raises(InputError, match="8x5 corners are found"):
        find_targets(taken, read_board("chessboard:9x6:square_mm=22"))


def test_the_board_is_seen_from_its_front():
    """Z of the board points to the camera, whichever corner OpenCV begins with."""
    pattern = read_board("chessboard:8x5:square_mm=22")
    found = pattern.find(rendered(pattern, SENSOR, LENS, view(pattern.board, 1), rays=4))
    first, along, down = found.places.column_row[[0, 7, 32]]
    (a, b), (c, d) = along - first, down - first
    assert a * d - b * c > 0  # columns to the right, rows downwards, clockwise in a picture whose rows run down
