"""Features of photographs: where they are to a part of a pixel, how they spread, which are the same, errors."""

import cv2
import numpy as np
import pytest

from jaxphoto.camera import Sensor
from jaxphoto.errors import InputError
from jaxphoto.extras.photos.features import sift_features

SENSOR = Sensor(640, 480, 0.006)


def texture(rng, size=900):
    """Blotches of many sizes."""
    sum_ = np.zeros((size, size))
    for width in (2, 4, 8, 16):
        sum_ += width * cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), width)
    return ((sum_ - sum_.min()) / np.ptp(sum_) * 255).astype(np.uint8)


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
    with pytest.raises(InputError, match="photograph not found"):
        sift_features(tmp_path / "none.tif", SENSOR)
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(InputError, match="not a readable image"):
        sift_features(tmp_path / "text.png", SENSOR)
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((480, 640), 90, np.uint8))
    with pytest.raises(InputError, match="640 x 480 pixels, the camera 320 x 240"):
        sift_features(tmp_path / "blank.png", Sensor(320, 240, 0.006))


def test_a_blank_photograph_has_no_features(tmp_path):
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((480, 640), 90, np.uint8))
    found = sift_features(tmp_path / "blank.png", SENSOR)
    assert [len(part) for part in found] == [0, 0, 0, 0]
    assert found.descriptors.shape == (0, 128)
