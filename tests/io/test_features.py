"""Features of photographs: where they are to a part of a pixel, how they spread, which are the same, errors."""

import cv2
import numpy as np
import pytest

from jaxphoto.camera import Sensor
from jaxphoto.errors import InputError
from jaxphoto.io.features import interest_points, tie_features

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


def test_the_same_points_in_three_photographs(tmp_path):
    """Views of a plane under known projective maps: every row must be where its map puts the point."""
    ground = texture(np.random.default_rng(2))
    maps, photographs = [], []
    for k in range(3):
        a = np.deg2rad(4.0 * k)
        turned = np.array(
            [[np.cos(a), -np.sin(a), -60 - 45.3 * k], [np.sin(a), np.cos(a), -90 + 3.7 * k], [2e-5 * k, 0, 1]]
        )
        view = cv2.warpPerspective(ground, turned, (640, 480), flags=cv2.INTER_CUBIC)
        path = tmp_path / f"{k}.png"
        cv2.imwrite(str(path), view)
        maps.append(turned)
        photographs.append(path)
    found = tie_features(photographs, SENSOR, least_photographs=3)
    counts = np.bincount(found.point)
    assert len(counts) > 60 and (counts == 3).all()
    pixels = SENSOR.px_from_mm(found.xy_mm) - 0.5
    on_ground = np.zeros((len(pixels), 2))
    for k, turned in enumerate(maps):
        rows = found.photograph == k
        homogeneous = np.column_stack([pixels[rows], np.ones(rows.sum())]) @ np.linalg.inv(turned).T
        on_ground[rows] = homogeneous[:, :2] / homogeneous[:, 2:]
    off = on_ground.reshape(-1, 3, 2) - on_ground.reshape(-1, 3, 2).mean(axis=1, keepdims=True)
    assert np.median(np.linalg.norm(off, axis=2)) < 0.3
    assert np.mean(np.linalg.norm(off, axis=2).max(axis=1) > 1.5) < 0.05
    again = tie_features(photographs, SENSOR, least_photographs=3)
    np.testing.assert_array_equal(again.xy_mm, found.xy_mm)
    assert (np.bincount(tie_features(photographs, SENSOR).point) >= 2).all()


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
    for k in range(2):
        cv2.imwrite(
            str(tmp_path / f"{k}.png"), np.clip(picture + rng.normal(size=picture.shape), 0, 255).astype(np.uint8)
        )
    found = tie_features([tmp_path / "0.png", tmp_path / "1.png"], SENSOR)
    pixels = SENSOR.px_from_mm(found.xy_mm)
    off = pixels[:, None] - places
    nearest = np.argmin(np.sum(off**2, axis=2), axis=1)
    off = off[np.arange(len(off)), nearest]
    off = off[np.linalg.norm(off, axis=1) < 1]
    assert len(off) > 40
    assert np.abs(off.mean(axis=0)).max() < 0.05


def test_what_cannot_be_measured_is_told_in_a_sentence(tmp_path):
    with pytest.raises(InputError, match="there is no such photograph"):
        interest_points(tmp_path / "none.tif", SENSOR, 10)
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(InputError, match="this is no picture that OpenCV can read"):
        interest_points(tmp_path / "text.png", SENSOR, 10)
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((480, 640), 90, np.uint8))
    with pytest.raises(InputError, match="no interest point was found"):
        interest_points(tmp_path / "blank.png", SENSOR, 10)
    with pytest.raises(InputError, match="the picture has 640 x 480 pixels, the camera 320 x 240"):
        interest_points(tmp_path / "blank.png", Sensor(320, 240, 0.006), 10)
    rng = np.random.default_rng(4)
    for name in ("one", "other"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), texture(rng)[:480, :640])
    with pytest.raises(InputError, match="have no point in common"):
        tie_features([tmp_path / "one.png", tmp_path / "other.png"], SENSOR)
