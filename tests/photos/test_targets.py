"""Targets of boards in rendered photographs whose truth is known: identity, place, standard deviation."""

import cv2
import numpy as np
import pytest

from jaxphoto import ExteriorOrientation, InputError, InteriorOrientation, Sensor, Smac
from jaxphoto.extras.photos.rendered_photographs import board_view
from jaxphoto.extras.photos.targets import find_targets, read_board, rendered
from jaxphoto.extras.photos.targets.circles import elliptic_blobs, fit_discs
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.io.photographs import photographs
from jaxphoto.procedures.calibration.start import projections
from jaxphoto.procedures.calibration.target_calibration import eccentricities

SENSOR = Sensor(480, 360, 0.008)
LENS = InteriorOrientation(3.2, 0.03, -0.02, Smac(k1=-0.02, k2=-0.001))
BOARDS = (
    "chessboard:8x5:square_mm=22",
    "circles:4x9:spacing_mm=18:diameter_mm=15",
    "charuco:6x5:square_mm=30:marker_mm=21:dictionary=4X4_50",
)
VIEWS = 3


def truth_px(board, exterior, points) -> np.ndarray:
    """What is measured of targets without noise: corners, and centres of the ellipses that circles are seen as."""
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
        exterior = board_view(board, k)
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


def test_a_grid_of_circles_is_found_among_other_round_things():
    pattern = read_board("circles:4x9:spacing_mm=18:diameter_mm=15")
    exterior = board_view(pattern.board, 1)
    picture = rendered(pattern, SENSOR, LENS, exterior, noise=3.0, rays=13)
    truth = truth_px(pattern.board, exterior, np.arange(36))
    rng, n = np.random.default_rng(0), 0
    while n < 80:
        centre = rng.uniform((8, 8), (472, 352))
        if np.linalg.norm(truth - centre, axis=1).min() > 30:
            cv2.circle(
                picture, np.rint(centre).astype(int).tolist(), int(rng.integers(3, 9)), int(rng.choice([20, 235])), -1
            )
            n += 1
    found = pattern.find(picture)
    assert found is not None
    good = found.places.found
    assert good.sum() >= 34
    off = [found.places.column_row[good] + 0.5 - truth[p] for p in (found.point[good], 35 - found.point[good])]
    assert min(np.abs(e).max() for e in off) < 0.2


@pytest.mark.parametrize(("slant", "radius_m"), [(0.5, 0.012), (1.0, 0.012), (1.2, 0.012), (1.0, 0.025)])
def test_what_is_measured_of_a_steep_circle_is_what_is_corrected(slant, radius_m):
    """A disc drawn by 20 x 20 rays a pixel: the fitted centre less the image of the true one is the eccentricity."""
    sensor = Sensor(640, 480, 0.0085)
    lens = InteriorOrientation(3.2, 0.03, -0.02, Smac(k1=-0.025, k2=-0.001))
    centre = np.array([0.03, -0.04, 0.0])
    away = np.array([np.sin(slant), 0.0, np.cos(slant)])
    x = np.cross([0.0, 1.0, 0.0], away) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], away))
    position, turn = 0.22 * away, np.stack([x, np.cross(away, x), away])
    place = position[None], turn[None], centre[None]
    image = sensor.px_from_mm(projections(lens, *place))[0]
    reach = np.arange(-70, 71)
    pixel = np.floor(image) + np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 1, 2)
    part = (np.stack(np.meshgrid(np.arange(20), np.arange(20)), axis=-1).reshape(1, -1, 2) + 0.5) / 20
    ideal = ideal_coordinates(lens, sensor.mm_from_px((pixel + part).reshape(-1, 2)))
    ray = np.column_stack([ideal, np.full(len(ideal), -float(lens.c))]) @ turn
    hit = position[:2] - position[2] / ray[:, 2:] * ray[:, :2]
    black = (np.linalg.norm(hit - centre[:2], axis=1) < radius_m).reshape(len(reach), len(reach), -1).mean(axis=2)
    picture = cv2.GaussianBlur(220 - 180 * black, (0, 0), 0.7)
    blobs = elliptic_blobs(np.rint(picture).astype(np.uint8))
    nearest = np.argmin(np.linalg.norm(blobs.column_row - 70, axis=1))
    fit = fit_discs(picture, blobs.take(np.array([nearest])))
    assert fit.found.all()
    measured = fit.column_row[0] + np.floor(image) - 70 + 0.5 - image
    told = eccentricities(lens, *place, np.eye(3)[:, :2], np.array([radius_m]))[0] / sensor.pixel_mm * (1, -1)
    assert np.linalg.norm(told) > 0.1
    assert np.abs(measured - told).max() < 0.02


def test_one_row_of_corners_between_markers_is_no_view_of_the_board():
    pattern = read_board("charuco:6x5:square_mm=30:marker_mm=21:dictionary=4X4_50")
    above = ExteriorOrientation(pattern.board.xyz_m.mean(axis=0) + np.array([0, 0, 0.2]), np.eye(3))  # type: ignore[arg-type]
    picture = rendered(pattern, SENSOR, LENS, above, rays=13)
    assert pattern.find(picture) is not None
    rows = truth_px(pattern.board, above, np.array([10, 15]))[:, 1]
    picture[: int(rows.mean()) - 8 - int(np.diff(rows)[0])] = 140
    assert pattern.find(picture) is None


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
        ("charuco:13x13:square_mm=30:marker_mm=20:dictionary=4X4_50", ["84 markers"]),
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
    cv2.imwrite(str(tmp_path / "a.png"), rendered(pattern, SENSOR, LENS, board_view(pattern.board, 0), rays=4))
    taken = photographs([tmp_path / "a.png"])
    with pytest.raises(InputError, match="8x5 corners found"):
        find_targets(taken, read_board("chessboard:9x6:square_mm=22"))


def test_the_board_is_seen_from_its_front():
    """Z of the board points to the camera, whichever corner OpenCV begins with."""
    pattern = read_board("chessboard:8x5:square_mm=22")
    found = pattern.find(rendered(pattern, SENSOR, LENS, board_view(pattern.board, 1), rays=4))
    first, along, down = found.places.column_row[[0, 7, 32]]
    (a, b), (c, d) = along - first, down - first
    assert a * d - b * c > 0  # columns to the right, rows downwards, clockwise in a picture whose rows run down
