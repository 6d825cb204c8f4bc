"""Grey values of photographs, and feature detection by OpenCV: evenly distributed corners and SIFT features."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxphoto.camera import Sensor
from jaxphoto.errors import InputError
from jaxphoto.io.photographs import photographs

_FLAGS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def read_grey(path: str | Path) -> UInt8[np.ndarray, "rows columns"]:
    """Read the grey values of a photograph, 0 to 255, as stored: the EXIF orientation is ignored.

    Colour, palette and CMYK images are converted to grey; transparency is ignored. Values of more than 8 bits are
    divided by the smallest power of two that makes the maximum less than 256.

    Raises InputError if the file is missing, corrupt or not an image, and for values other than nonnegative integers.
    """
    path = Path(path)
    # Check the size by Pillow first: OpenCV allocates memory for any size in a corrupt header.
    photographs([path])
    try:
        picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), _FLAGS)
    except (OSError, cv2.error):  # cv2.error: empty files and pictures that are too large
        picture = None
    if picture is None:
        raise InputError(f"{path}: OpenCV cannot read this picture, or it is truncated; give a TIFF, PNG or JPEG")
    if picture.dtype == np.uint8:
        return picture
    if picture.dtype.kind not in "iu" or picture.min() < 0:
        raise InputError(f"{path}: its grey values are {picture.dtype}; give an unsigned picture of 8 or 16 bits")
    return np.right_shift(picture, max(0, int(picture.max()).bit_length() - 8)).astype(np.uint8)


FEATURES = 5000
"""Default maximum number of features per photograph."""
OF_FEW = 10_000
"""Default maximum number of features per photograph for few photographs, limited by memory."""
LONGEST_PX = 2400
"""Default longer side (px) of a photograph for feature detection. Memory: 1 GB (3200: 1.7 GB)."""
# Minimum ratio of a corner's strength to the strongest corner's.
_WEAKEST = 0.01
# Half width (px) of the window for subpixel refinement of a corner (11 px in total).
_HALF_WINDOW = 5
_BORDER_PX = 8
_CELLS = 16
# A third of OpenCV's default: fields and walls have low contrast.
_CONTRAST = 0.0133
# Norm of a SIFT descriptor before rounding; nearly all components are then less than 256.
_LENGTH = 512
# Standard deviation (px) of a feature of width 0, and its increase per pixel of width.
_SIGMA_PX = 0.07
_SIGMA_OF_WIDTH = 0.025
METHOD = (1, _CONTRAST, _SIGMA_PX, _SIGMA_OF_WIDTH)
"""Cache key of features; increment the first element when the detection changes."""


class Features(NamedTuple):
    """Interest points of a photograph."""

    xy_mm: Float[np.ndarray, "n 2"]
    """Measured image coordinates, from the image centre, x right, y up."""
    strength: Float[np.ndarray, "n"]
    """Smaller eigenvalue of the gradient matrix (Shi and Tomasi, 1994), divided by the strongest corner's."""


class SiftFeatures(NamedTuple):
    """Features of a photograph with descriptors for matching."""

    xy_mm: Float[np.ndarray, "n 2"]
    """Measured image coordinates, from the image centre, x right, y up."""
    sigma_mm: Float[np.ndarray, "n"]
    """Standard deviation of each coordinate for similar views of a plane; see `sift_features`."""
    feature: Int[np.ndarray, "m"]
    """Feature index of each descriptor; a feature with several dominant directions has several descriptors."""
    descriptors: UInt8[np.ndarray, "m 128"]
    """Square roots of the SIFT histograms (RootSIFT), scaled to norm 512."""


def interest_points(photograph: Path, sensor: Sensor, count: int) -> Features:
    """Detect up to `count` corners of a photograph with subpixel accuracy, evenly distributed over the format.

    Uses Shi and Tomasi's good features to track. The strongest corner of each cell of a grid is selected, then the
    second, and so on. Raises InputError for a file that is not an image or not of the sensor's size, and for a
    photograph without corners.
    """
    picture = _read(photograph, sensor)
    quality = cv2.cornerMinEigenVal(picture, 3)
    apart = max(3, int(0.5 * np.sqrt(sensor.width_px * sensor.height_px / max(count, 1))))
    # Detect ten times as many candidates at half the distance of an even distribution.
    candidates = cv2.goodFeaturesToTrack(picture, 10 * count, _WEAKEST, min(apart, 20))
    if candidates is None:
        raise InputError(f"{photograph}: no interest point found; the picture is blank or out of focus")
    corners = candidates.reshape(-1, 2)
    border = np.minimum(corners, [sensor.width_px - 1, sensor.height_px - 1] - corners).min(axis=1)
    corners = corners[border >= _BORDER_PX]
    strength = quality[corners[:, 1].astype(int), corners[:, 0].astype(int)]
    chosen = _spread(corners, strength, sensor, count)
    corners, strength = corners[chosen], strength[chosen]
    if not len(corners):
        raise InputError(f"{photograph}: interest points found only at the border; the picture is nearly blank")
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    fine = cv2.cornerSubPix(picture, corners.reshape(-1, 1, 2).copy(), (_HALF_WINDOW,) * 2, (-1, -1), until)
    fine = fine.reshape(-1, 2).astype(float)
    # Reject corners that moved more than the window: they converged to a different corner.
    stayed = np.abs(fine - corners).max(axis=1) <= _HALF_WINDOW
    # OpenCV's origin is the centre of the upper left pixel, (0.5, 0.5) in our convention.
    return Features(sensor.mm_from_px(fine[stayed] + 0.5), (strength[stayed] / quality.max()).astype(float))


def sift_features(
    photograph: Path, sensor: Sensor, count: int = FEATURES, longest_px: int = LONGEST_PX
) -> SiftFeatures:
    """Detect up to `count` SIFT features of a photograph. The features with the largest s sqrt(contrast) are selected.

    s is the width of a feature in pixels (the scale of SIFT). Selection by contrast alone would prefer leaves and
    gravel, which do not match. Wide features match more often, but wide features of low contrast are less accurate than
    specified here.

    Photographs with a longer side above `longest_px` are reduced first. The standard deviation of a feature is

        sigma = sqrt(0.07^2 + (0.025 s)^2) pixels,

    determined from views of textures under known homographies (tests/photos/test_matching.py). Larger differences
    between views increase it by a common factor, which `match_photographs` estimates. A blank or defocused photograph
    has no features.

    Raises InputError for a file that is not an image, or not of the sensor's size. Sources: Lowe (2004), Distinctive
    image features from scale-invariant keypoints; Arandjelovic and Zisserman (2012), Three things everyone should know
    to improve object retrieval.
    """
    picture = _read(photograph, sensor)
    shrunk = min(1.0, longest_px / max(picture.shape))
    if shrunk < 1:
        size = (round(sensor.width_px * shrunk), round(sensor.height_px * shrunk))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    # Precise upscaling avoids a shift of all features by a quarter of a pixel.
    sift = cv2.SIFT_create(  # type: ignore[attr-defined]
        0, contrastThreshold=_CONTRAST, enable_precise_upscale=True
    )
    scale = np.array([sensor.width_px, sensor.height_px]) / picture.shape[::-1]
    # Compute descriptors of the selected features only: descriptors of all features take twice as long as a second
    # pyramid.
    keys = sift.detect(picture, None)
    worth = np.array([key.size * np.sqrt(key.response) for key in keys])
    chosen = [keys[k] for k in np.sort(np.argsort(-worth, kind="stable")[:count])]
    chosen, described = sift.compute(picture, chosen)
    if described is None:
        return SiftFeatures(np.zeros((0, 2)), np.zeros(0), np.zeros(0, int), np.zeros((0, 128), np.uint8))
    circles = np.array([(*key.pt, key.size) for key in chosen])
    places, feature = np.unique(circles, axis=0, return_inverse=True)
    # OpenCV's keypoint size is the diameter, twice the width.
    sigma_px = np.hypot(_SIGMA_PX, _SIGMA_OF_WIDTH * places[:, 2] / 2) * scale.mean()
    roots = np.sqrt(described / np.maximum(described.sum(axis=1, keepdims=True), 1e-9))
    return SiftFeatures(
        sensor.mm_from_px((places[:, :2] + 0.5) * scale),
        sigma_px * sensor.pixel_mm,
        feature.reshape(-1),
        np.minimum(np.round(_LENGTH * roots), 255).astype(np.uint8),
    )


def _read(photograph: Path, sensor: Sensor) -> np.ndarray:
    """Read the grey values of a photograph. Raise InputError unless it has the sensor's size."""
    picture = read_grey(photograph)
    height, width = picture.shape
    if (width, height) != (sensor.width_px, sensor.height_px):
        raise InputError(
            f"{photograph}: the picture has {width} x {height} pixels, the camera {sensor.width_px} x "
            f"{sensor.height_px}; give the original picture, or its camera"
        )
    return picture


def _spread(corners: np.ndarray, strength: np.ndarray, sensor: Sensor, count: int) -> Int[np.ndarray, "n"]:
    """Select the strongest corner of each grid cell, then the second strongest, and so on, up to `count`."""
    across = max(1, min(_CELLS, int(np.sqrt(count / 2))))
    side = max(sensor.width_px, sensor.height_px) / across
    cell = np.floor(corners / side).astype(int) @ [1, across + 1]
    order = np.lexsort((-strength, cell))
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(begins, np.diff(np.append(begins, len(order))))
    return order[np.lexsort((-strength[order], rank))][:count]
