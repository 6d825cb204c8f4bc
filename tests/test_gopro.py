"""A real camera, calibrated with a real board: 37 photographs of a chessboard by a GoPro (paper 002's case)."""

import cv2
import jax
import numpy as np
import pytest

from jaxphoto import Outcome
from jaxphoto.camera import rebalance
from jaxphoto.extras.photos.targets import find_targets, read_board
from jaxphoto.io.photographs import photographs, sensor_and_interior
from jaxphoto.procedures.calibration import calibrate, interior_covariance
from jaxphoto.stability import analyse, image_grid

# Quick: the targets of rendered photographs (photos/test_targets.py) and mrcal's board.
pytestmark = pytest.mark.slow
PATTERN = read_board("chessboard:8x6:square_mm=30")


@pytest.fixture(scope="module")
def seen(data_dir):
    """The corners of all photographs, and the camera that EXIF tells of."""
    folder = data_dir / "gopro_chessboard" / "calibration_wide"
    if not folder.is_dir():
        pytest.skip(f"no photographs in {folder}")
    taken = photographs(sorted(folder.glob("*.jpg")))
    return find_targets(taken, PATTERN).detections, sensor_and_interior(taken)


@pytest.fixture(scope="module")
def calibrated(seen):
    """A calibration with some of the photographs, each made once."""
    detections, start = seen
    made = {}

    def of(chosen=slice(None), r0_mm=0.0, board_sigma_m=None):
        key = str((chosen, r0_mm, board_sigma_m))
        if key not in made:
            made[key] = calibrate(
                PATTERN.board,
                detections[chosen],
                start.sensor,
                start.interior,
                r0_mm=r0_mm,
                board_sigma_m=board_sigma_m,
            )
            assert made[key].adjusted.outcome is Outcome.CONVERGED
            assert made[key].settled
        return made[key]

    return of


HALVES = (slice(0, None, 2), slice(1, None, 2))


def test_fits_better_than_opencv_on_the_same_corners(seen, calibrated):
    """SMAC with K1-K3, P1, P2 against OpenCV's k1-k3, p1, p2 with one focal length: c and xp, yp in both."""
    sensor, done = seen[1].sensor, calibrated()
    rows = done.measured
    assert len(rows.images) >= 34
    plane, image = [], []
    for k in range(len(rows.images)):
        own = rows.image == k
        plane.append((PATTERN.board.xyz_m[rows.point[own]] * [1, -1, 1]).astype(np.float32))
        image.append((sensor.px_from_mm(rows.xy_mm[own]) - 0.5).astype(np.float32))
    size = sensor.width_px, sensor.height_px
    guess = np.array([[600.0, 0, size[0] / 2], [0, 600.0, size[1] / 2], [0, 0, 1]])
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_USE_INTRINSIC_GUESS
    theirs = cv2.calibrateCamera(plane, image, size, guess, None, flags=flags)[0]
    assert done.rms_px <= theirs


def test_any_balance_radius_gives_the_same_bundle(seen, calibrated):
    zero, three = calibrated(), calibrated(r0_mm=3.0)
    assert float(three.interior.distortion.r0) == 3.0
    grid = image_grid(seen[1].sensor, 21, 17)
    ideal = [np.asarray(jax.vmap(done.interior.ideal_from_measured)(grid)) for done in (zero, three)]
    c = [float(done.interior.c) for done in (zero, three)]
    assert c[1] < 0.8 * c[0]
    assert np.abs(ideal[0] / c[0] - ideal[1] / c[1]).max() < 1e-9
    assert np.abs(ideal[0] - ideal[1] * (c[0] / c[1])).max() < 1e-9  # mm
    one, other = zero.adjusted.unknowns, three.adjusted.unknowns
    assert np.abs(np.asarray(one.exterior.position) - np.asarray(other.exterior.position)).max() < 1e-9
    turned = np.asarray(one.exterior.camera_from_object) - np.asarray(other.exterior.camera_from_object)
    assert np.abs(turned).max() < 1e-9
    assert (zero.measured.images, zero.removed) == (three.measured.images, three.removed)
    assert float(zero.adjusted.sigma0) == pytest.approx(float(three.adjusted.sigma0), rel=1e-9)


def test_any_balance_radius_gives_the_same_board(calibrated):
    """The same where the points of the board are estimated, too."""
    zero, three = (calibrated(board_sigma_m=1e-3, r0_mm=r0) for r0 in (0.0, 3.0))
    off = np.asarray(zero.adjusted.unknowns.points) - np.asarray(three.adjusted.unknowns.points)
    assert np.abs(off).max() < 1e-9
    assert zero.rms_px == pytest.approx(three.rms_px, rel=1e-9)


def test_stability_between_halves(seen, calibrated):
    """As Table 7 of paper 002, with R0 = 0 and R0 = 3: the same bundles, so offsets in the measured image are equal."""
    sensor = seen[1].sensor
    halves = [calibrated(half) for half in HALVES]
    covariances = tuple(interior_covariance(half.adjusted) for half in halves)
    grid = image_grid(sensor)
    found = analyse(*(half.interior for half in halves), grid, covariances)  # type: ignore[misc]
    balanced = analyse(*(rebalance(half.interior, 3.0) for half in halves), grid)  # type: ignore[misc]
    for method in found:
        at_zero, at_three = found[method].offsets, balanced[method].offsets
        assert float(at_zero.rmse_mm) > float(at_three.rmse_mm)
        # The principal points of the two halves differ, and R0 is a circle about each.
        assert float(at_three.rmse_measured_mm) == pytest.approx(float(at_zero.rmse_measured_mm), rel=1e-6)
    # As fixed targets a board that is not flat makes another c of other photographs, which over a plane is a height.
    assert float(found["spr"].offsets.rmse_measured_mm) < 0.5 * sensor.pixel_mm
    assert float(found["zrot"].offsets.rmse_measured_mm) < 3 * sensor.pixel_mm
    assert found["spr"].uncertainty.p_value > 0.05
    assert not found["rot"].similar(sensor.pixel_mm)


def test_halves_agree_on_the_shape_of_the_board(calibrated):
    """With 1 mm for the board's points the residuals fall to a third, and each half finds the same bent sheet."""
    halves = [calibrated(half, board_sigma_m=1e-3) for half in HALVES]
    for half, fixed in zip(halves, map(calibrated, HALVES), strict=True):
        assert half.rms_px < 0.4 * fixed.rms_px
    shapes = [1e3 * (np.asarray(h.adjusted.unknowns.points) - PATTERN.board.xyz_m)[:, 2] for h in halves]
    assert np.ptp(shapes[0]) > 0.5
    assert np.sqrt(np.mean((shapes[0] - shapes[1]) ** 2)) < 0.1  # mm
    c, variance = zip(*((float(h.interior.c), interior_covariance(h.adjusted)[0, 0]) for h in halves), strict=True)
    assert abs(c[0] - c[1]) < 3 * np.sqrt(sum(variance))
