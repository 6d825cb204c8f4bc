"""Grey values of photographs, and SIFT features by OpenCV."""

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
    except (OSError, cv2.error):  # cv2.error: empty files and images that are too large
        picture = None
    if picture is None:
        raise InputError(f"{path}: OpenCV cannot read this image, or it is truncated; give a TIFF, PNG or JPEG")
    if picture.dtype == np.uint8:
        return picture
    if picture.dtype.kind not in "iu" or picture.min() < 0:
        raise InputError(f"{path}: its grey values are {picture.dtype}; give an unsigned image of 8 or 16 bits")
    return np.right_shift(picture, max(0, int(picture.max()).bit_length() - 8)).astype(np.uint8)


FEATURES = 5000
"""Default maximum number of features per photograph."""
OF_FEW = 10_000
"""Default maximum number of features per photograph for few photographs, limited by memory."""
LONGEST_PX = 2400
"""Default longer side (px) of a photograph for feature detection. Memory: 1 GB (3200: 1.7 GB)."""
# A third of OpenCV's default: fields and walls have low contrast.
_CONTRAST = 0.0133
# Norm of a SIFT descriptor before rounding; nearly all components are then less than 256.
_LENGTH = 512
# Standard deviation (px) of a feature of width 0, and its increase per pixel of width.
_SIGMA_PX = 0.07
_SIGMA_OF_WIDTH = 0.025


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
            f"{photograph}: the photograph has {width} x {height} pixels, the camera {sensor.width_px} x "
            f"{sensor.height_px}; give the original photograph, or its camera"
        )
    return picture
