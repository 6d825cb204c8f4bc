"""Grey values of photographs, and features found by OpenCV: evenly spread corners, and SIFT features."""

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
    """Read the grey values of a photograph, 0 to 255, as stored: the EXIF orientation does not rotate it.

    Colours, palettes and CMYK become grey; transparency is ignored. Values of more than 8 bits are divided by the power
    of two that brings the brightest below 256.

    Raises InputError for a file that is missing, corrupt or not a picture, and for values other than integers from 0.
    """
    path = Path(path)
    # Pillow checks first: OpenCV allocates whatever a corrupt file declares.
    photographs([path])
    try:
        picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), _FLAGS)
    except (OSError, cv2.error):  # cv2.error: empty files and pictures that are too large
        picture = None
    if picture is None:
        raise InputError(f"{path}: this is no picture that OpenCV can read, or it is cut off; give a TIFF, PNG or JPEG")
    if picture.dtype == np.uint8:
        return picture
    if picture.dtype.kind not in "iu" or picture.min() < 0:
        raise InputError(f"{path}: its grey values are {picture.dtype}; give a picture of 8 or 16 bits, from 0 up")
    return np.right_shift(picture, max(0, int(picture.max()).bit_length() - 8)).astype(np.uint8)


FEATURES = 5000
"""Default number of features of a photograph."""
OF_FEW = 10_000
"""Default number of features if there are few photographs: memory allows more."""
LONGEST_PX = 2400
"""Default longer side of a photograph for feature detection: takes 1 GB of memory (3200 takes 1.7 GB)."""
# Minimum strength of a corner over that of the strongest.
_WEAKEST = 0.01
# Half the window (11 px) of the subpixel fit of a corner.
_HALF_WINDOW = 5
_BORDER_PX = 8
_CELLS = 16
# A third of OpenCV's default: fields and walls have little contrast.
_CONTRAST = 0.0133
# Length of a SIFT descriptor before rounding; its elements are then below 256 with few exceptions.
_LENGTH = 512
# Standard deviation (px) of a feature of width 0, and its increase per pixel of width.
_SIGMA_PX = 0.07
_SIGMA_OF_WIDTH = 0.025
METHOD = (1, _CONTRAST, _SIGMA_PX, _SIGMA_OF_WIDTH)
"""Key of stored features; increment the number when the detection changes."""


class Features(NamedTuple):
    """Interest points of a photograph."""

    xy_mm: Float[np.ndarray, "n 2"]
    """Measured image coordinates, from the image centre, x right, y up."""
    strength: Float[np.ndarray, "n"]
    """Smaller eigenvalue of the gradient matrix (Shi and Tomasi, 1994), over that of the strongest corner."""


class SiftFeatures(NamedTuple):
    """Features of a photograph that can be matched."""

    xy_mm: Float[np.ndarray, "n 2"]
    """Measured image coordinates, from the image centre, x right, y up."""
    sigma_mm: Float[np.ndarray, "n"]
    """Standard deviation of either coordinate if the views of a plane differ little; see `sift_features`."""
    feature: Int[np.ndarray, "m"]
    """Index of the feature of each descriptor: a feature with several dominant directions has several descriptors."""
    descriptors: UInt8[np.ndarray, "m 128"]
    """Square roots of the SIFT histograms, of length 512 (RootSIFT)."""


def interest_points(photograph: Path, sensor: Sensor, count: int) -> Features:
    """Detect up to `count` corners of a photograph, spread evenly over the format, with subpixel accuracy.

    Shi and Tomasi's good features to track; the cells of a grid contribute their strongest in turn. Raises InputError
    for a file that is not a picture or not of the sensor's size, and for a photograph without corners.
    """
    picture = _read(photograph, sensor)
    quality = cv2.cornerMinEigenVal(picture, 3)
    apart = max(3, int(0.5 * np.sqrt(sensor.width_px * sensor.height_px / max(count, 1))))
    # Ten times as many candidates, at half the distance of an even spread.
    candidates = cv2.goodFeaturesToTrack(picture, 10 * count, _WEAKEST, min(apart, 20))
    if candidates is None:
        raise InputError(f"{photograph}: no interest point was found; the picture is blank or out of focus")
    corners = candidates.reshape(-1, 2)
    border = np.minimum(corners, [sensor.width_px - 1, sensor.height_px - 1] - corners).min(axis=1)
    corners = corners[border >= _BORDER_PX]
    strength = quality[corners[:, 1].astype(int), corners[:, 0].astype(int)]
    chosen = _spread(corners, strength, sensor, count)
    corners, strength = corners[chosen], strength[chosen]
    if not len(corners):
        raise InputError(f"{photograph}: no interest point was found but at the border; the picture is nearly blank")
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
    fine = cv2.cornerSubPix(picture, corners.reshape(-1, 1, 2).copy(), (_HALF_WINDOW,) * 2, (-1, -1), until)
    fine = fine.reshape(-1, 2).astype(float)
    # A corner that moved away is another one.
    stayed = np.abs(fine - corners).max(axis=1) <= _HALF_WINDOW
    # OpenCV's origin is the centre of the upper-left pixel, which is (0.5, 0.5) here.
    return Features(sensor.mm_from_px(fine[stayed] + 0.5), (strength[stayed] / quality.max()).astype(float))


def sift_features(
    photograph: Path, sensor: Sensor, count: int = FEATURES, longest_px: int = LONGEST_PX
) -> SiftFeatures:
    """Detect up to `count` SIFT features of a photograph: those of the largest s sqrt(contrast), s their width.

    By contrast alone leaves and gravel would dominate, which do not match; wide features match more often, but wide and
    faint ones are less accurate than stated here.

    A photograph whose longer side exceeds `longest_px` is reduced first. The standard deviation of a blob s pixels wide
    (the scale of SIFT) is

        sigma = sqrt(0.07^2 + (0.025 s)^2) pixels,

    determined from views of textures under known homographies (tests/photos/test_matching.py). It is larger by one
    factor if views differ more, which `match_photographs` estimates. A blank or defocused photograph has no features.

    Raises InputError for a file that is not a picture, or not of the sensor's size. Sources: Lowe (2004), Distinctive
    image features from scale-invariant keypoints; Arandjelovic and Zisserman (2012), Three things everyone should know
    to improve object retrieval.
    """
    picture = _read(photograph, sensor)
    shrunk = min(1.0, longest_px / max(picture.shape))
    if shrunk < 1:
        size = (round(sensor.width_px * shrunk), round(sensor.height_px * shrunk))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    # Without precise upscaling all features are shifted by a quarter of a pixel.
    sift = cv2.SIFT_create(  # type: ignore[attr-defined]
        0, contrastThreshold=_CONTRAST, enable_precise_upscale=True
    )
    scale = np.array([sensor.width_px, sensor.height_px]) / picture.shape[::-1]
    # Descriptors of the selected features only: the descriptors of all take twice as long as another pyramid.
    keys = sift.detect(picture, None)
    worth = np.array([key.size * np.sqrt(key.response) for key in keys])
    chosen = [keys[k] for k in np.sort(np.argsort(-worth, kind="stable")[:count])]
    chosen, described = sift.compute(picture, chosen)
    if described is None:
        return SiftFeatures(np.zeros((0, 2)), np.zeros(0), np.zeros(0, int), np.zeros((0, 128), np.uint8))
    circles = np.array([(*key.pt, key.size) for key in chosen])
    places, feature = np.unique(circles, axis=0, return_inverse=True)
    # OpenCV's size is the diameter, twice the width.
    sigma_px = np.hypot(_SIGMA_PX, _SIGMA_OF_WIDTH * places[:, 2] / 2) * scale.mean()
    roots = np.sqrt(described / np.maximum(described.sum(axis=1, keepdims=True), 1e-9))
    return SiftFeatures(
        sensor.mm_from_px((places[:, :2] + 0.5) * scale),
        sigma_px * sensor.pixel_mm,
        feature.reshape(-1),
        np.minimum(np.round(_LENGTH * roots), 255).astype(np.uint8),
    )


def _read(photograph: Path, sensor: Sensor) -> np.ndarray:
    """Read the grey values of a photograph of the sensor's size."""
    picture = read_grey(photograph)
    height, width = picture.shape
    if (width, height) != (sensor.width_px, sensor.height_px):
        raise InputError(
            f"{photograph}: the picture has {width} x {height} pixels, the camera {sensor.width_px} x "
            f"{sensor.height_px}; give the picture as it was taken, or the camera that took it"
        )
    return picture


def _spread(corners: np.ndarray, strength: np.ndarray, sensor: Sensor, count: int) -> Int[np.ndarray, "n"]:
    """Select the strongest of each cell of a grid, then the second of each, until there are enough."""
    across = max(1, min(_CELLS, int(np.sqrt(count / 2))))
    side = max(sensor.width_px, sensor.height_px) / across
    cell = np.floor(corners / side).astype(int) @ [1, across + 1]
    order = np.lexsort((-strength, cell))
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(begins, np.diff(np.append(begins, len(order))))
    return order[np.lexsort((-strength[order], rank))][:count]
