"""Features of photographs: where they are to a part of a pixel, how they spread, which are the same, errors."""

import cv2
import numpy as np
import pytest

from jaxphoto.camera import Sensor
from jaxphoto.errors import InputError
from jaxphoto.extras.photos.features import interest_points, sift_features

SENSOR = Sensor(640, 480, 0.006)
FINE = 8


def chessboard(path, angle_deg, shift_px, square_px=37.0):
    """A chessboard, each pixel the mean over its area; the true corners in mm."""
    column, row = (np.arange(n * FINE) / FINE + 0.5 / FINE for n in (SENSOR.width_px, SENSOR.height_px))
    turn = np.deg2rad(angle_deg)
    along = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) / square_px
    x, y = (along[k, 0] * (column - shift_px[0]) + along[k, 1] * (row[:, None] - shift_px[1]) for k in (0, 1))
    white = (np.floor(x) + np.floor(y)) % 2
    grey = white.reshape(SENSOR.height_px, FINE, SENSOR.width_px, FINE).mean(axis=(1, 3))
    cv2.imwrite(str(path), np.round(40 + 160 * grey).astype(np.uint8))
    corners = np.stack(np.meshgrid(np.arange(-20, 40), np.arange(-20, 40)), axis=-1).reshape(-1, 2)
    pixels = corners @ np.linalg.inv(along).T + shift_px
    return SENSOR.mm_from_px(pixels)


def texture(rng, size=900):
    """Blotches of many sizes."""
    sum_ = np.zeros((size, size))
    for width in (2, 4, 8, 16):
        sum_ += width * cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), width)
    return ((sum_ - sum_.min()) / np.ptp(sum_) * 255).astype(np.uint8)


@pytest.mark.parametrize(("angle_deg", "shift_px"), [(10.0, (11.3, 7.8)), (33.0, (20.05, 14.6))])
def test_corners_are_found_where_they_are(tmp_path, angle_deg, shift_px):
    true = chessboard(tmp_path / "board.png", angle_deg, shift_px)
    found = interest_points(tmp_path / "board.png", SENSOR, 120)
    assert 80 < len(found.xy_mm) <= 120
    off = found.xy_mm[:, None] - true
    nearest = np.argmin(np.sum(off**2, axis=2), axis=1)
    off = off[np.arange(len(off)), nearest] / SENSOR.pixel_mm
    assert np.abs(off).max() < 0.3
    # Half a pixel of another convention would show here.
    assert np.abs(off.mean(axis=0)).max() < 0.02
    assert (found.strength > 0).all() and found.strength.max() <= 1


def test_points_spread_over_the_format_although_texture_does_not(tmp_path):
    rng = np.random.default_rng(1)
    picture = texture(rng)[: SENSOR.height_px, : SENSOR.width_px].astype(float)
    picture[:, 320:] = 128 + 0.2 * (picture[:, 320:] - 128)
    cv2.imwrite(str(tmp_path / "half.png"), picture.astype(np.uint8))
    xy = interest_points(tmp_path / "half.png", SENSOR, 200).xy_mm
    assert len(xy) > 150
    assert 0.3 < np.mean(xy[:, 0] > 0) < 0.7
    assert np.abs(xy).max(axis=0) == pytest.approx([SENSOR.width_mm / 2, SENSOR.height_mm / 2], rel=0.1)


def test_features_of_blobs_have_no_offset(tmp_path):
    """Bright spots at known places: SIFT as OpenCV has it by default would be off by a quarter of a pixel."""
    rng = np.random.default_rng(3)
    column, row = np.meshgrid(np.arange(640) + 0.5, np.arange(480) + 0.5)
    places = np.stack(np.meshgrid(np.arange(60, 600, 60.0), np.arange(60, 440, 60.0)), axis=-1).reshape(-1, 2)
    places += rng.uniform(-12, 12, places.shape)
    width = rng.uniform(2.5, 5, len(places))
    picture = np.full((480, 640), 60.0)
    for (x, y), s in zip(places, width, strict=True):
        picture += 150 * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * s**2))
    cv2.imwrite(str(tmp_path / "blobs.png"), np.clip(picture + rng.normal(size=picture.shape), 0, 255).astype(np.uint8))
    found = sift_features(tmp_path / "blobs.png", SENSOR)
    pixels = SENSOR.px_from_mm(found.xy_mm)
    off = pixels[:, None] - places
    nearest = np.argmin(np.sum(off**2, axis=2), axis=1)
    off = off[np.arange(len(off)), nearest]
    close = np.linalg.norm(off, axis=1) < 1
    # Some stand so close that they are one blob.
    assert len(np.unique(nearest[close])) > 0.85 * len(places)
    assert np.abs(off[close].mean(axis=0)).max() < 0.05
    # A wide spot is told less well.
    assert np.corrcoef(width[nearest[close]], found.sigma_mm[close])[0, 1] > 0.8


def test_each_place_of_a_large_photograph_is_one_feature(tmp_path):
    """Made smaller before it is searched, its features lie where those of the whole lie, and are told less well."""
    cv2.imwrite(str(tmp_path / "p.png"), texture(np.random.default_rng(5))[:480, :640])
    whole = sift_features(tmp_path / "p.png", SENSOR, count=800)
    small = sift_features(tmp_path / "p.png", SENSOR, count=800, longest_px=427)
    for found in (whole, small):
        assert len(np.unique(found.xy_mm, axis=0)) == len(found.xy_mm)
        assert set(found.feature) == set(range(len(found.xy_mm)))
        norm = np.linalg.norm(found.descriptors.astype(float), axis=1)
        assert np.abs(norm - 512).max() < 40
    off = whole.xy_mm[:, None] - small.xy_mm
    nearest = np.argmin(np.sum(off**2, axis=2), axis=1)
    off = off[np.arange(len(off)), nearest] / SENSOR.pixel_mm
    close = np.linalg.norm(off, axis=1) < 0.75
    assert close.sum() > 150
    assert np.abs(off[close].mean(axis=0)).max() < 0.05
    assert np.median(small.sigma_mm) > 1.2 * np.median(whole.sigma_mm)


def test_what_cannot_be_measured_is_told_in_a_sentence(tmp_path):
    with pytest.raises(InputError, match="there is no such photograph"):
        interest_points(tmp_path / "none.tif", SENSOR, 10)
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(InputError, match="this is no picture that can be read"):
        interest_points(tmp_path / "text.png", SENSOR, 10)
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((480, 640), 90, np.uint8))
    with pytest.raises(InputError, match="no interest point found"):
        interest_points(tmp_path / "blank.png", SENSOR, 10)
    with pytest.raises(InputError, match="the picture has 640 x 480 pixels, the camera 320 x 240"):
        interest_points(tmp_path / "blank.png", Sensor(320, 240, 0.006), 10)
    with pytest.raises(InputError, match="the picture has 640 x 480 pixels, the camera 320 x 240"):
        sift_features(tmp_path / "blank.png", Sensor(320, 240, 0.006))


def test_a_blank_photograph_has_no_features(tmp_path):
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((480, 640), 90, np.uint8))
    found = sift_features(tmp_path / "blank.png", SENSOR)
    assert [len(part) for part in found] == [0, 0, 0, 0]
    assert found.descriptors.shape == (0, 128)
