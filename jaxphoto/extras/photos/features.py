"""The grey values of a photograph, whatever kind of picture its file holds.

Features of one photograph, found by OpenCV: corners that spread evenly, and SIFT features that can be matched.
"""

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
    """The grey values of a photograph, 0 to 255, as they lie in the file: no note of the camera about turning counts.

    Colours, palettes and CMYK become grey; transparency is not looked at. Values of more than 8 bits are divided by the
    power of two with which the brightest still fits: what 12 bits of 16 hold keeps its contrast.
    Raises InputError for a file that is missing, is no picture or is cut off, for one that is far too small for the
    size it says, and for values that are no whole numbers from 0.
    """
    path = Path(path)
    # Pillow's judgement first: OpenCV takes room for whatever a damaged file says.
    photographs([path])
    try:
        picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), _FLAGS)
    except (OSError, cv2.error):  # OpenCV's where the file is empty or the picture too large
        picture = None
    if picture is None:
        raise InputError(f"{path}: this is no picture that OpenCV can read, or it is cut off; give a TIFF, PNG or JPEG")
    if picture.dtype == np.uint8:
        return picture
    if picture.dtype.kind not in "iu" or picture.min() < 0:
        raise InputError(f"{path}: its grey values are {picture.dtype}; give a picture of 8 or 16 bits, from 0 up")
    return np.right_shift(picture, max(0, int(picture.max()).bit_length() - 8)).astype(np.uint8)


FEATURES = 5000
"""Of a photograph, where nothing else is said."""
OF_FEW = 10_000
"""The same where photographs are few: then features take little memory, and the more of them, the better a network."""
LONGEST_PX = 2400
"""Longer side of a photograph as its features are looked for, unless said: that takes 1 GB of memory, 3200 1.7."""
# Of a corner's strength over that of the strongest, as OpenCV counts it.
_WEAKEST = 0.01
# Half a window of 11 pixels, in which a corner is found to a part of a pixel.
_HALF_WINDOW = 5
_BORDER_PX = 8
_CELLS = 16
# A third of what OpenCV asks: fields and walls have little contrast, and faint features are as right as others.
_CONTRAST = 0.0133
# A SIFT descriptor has this length before it is rounded; its parts are then below 256 but for odd ones.
_LENGTH = 512
# Of a feature whose blob is a point, and what each pixel of its width adds.
_SIGMA_PX = 0.07
_SIGMA_OF_WIDTH = 0.025
METHOD = (1, _CONTRAST, _SIGMA_PX, _SIGMA_OF_WIDTH)
"""What features depend on beside photograph and options; the number changes with the way they are found."""


class Features(NamedTuple):
    """Interest points of a photograph."""

    xy_mm: Float[np.ndarray, "n 2"]
    """Measured image coordinates, from the image centre, x right, y up (docs/conventions.md)."""
    strength: Float[np.ndarray, "n"]
    """Smaller eigenvalue of the gradients around it (Shi and Tomasi, 1994), over that of the strongest."""


class SiftFeatures(NamedTuple):
    """Places of a photograph that can be known again in another one."""

    xy_mm: Float[np.ndarray, "n 2"]
    """Measured image coordinates, from the image centre, x right, y up (docs/conventions.md)."""
    sigma_mm: Float[np.ndarray, "n"]
    """Standard deviation of either coordinate where views of a plane differ little; see `sift_features`."""
    feature: Int[np.ndarray, "m"]
    """Which of the n places a descriptor is of: one with several prevailing directions has several descriptors."""
    descriptors: UInt8[np.ndarray, "m 128"]
    """What the surroundings look like: the square roots of SIFT's histogram, of length 512 (RootSIFT)."""


def interest_points(photograph: Path, sensor: Sensor, count: int) -> Features:
    """Up to `count` corners of a photograph, spread evenly over the format, to a part of a pixel.

    They are Shi and Tomasi's good features to track; each cell of a grid gives its strongest in turn, so that no rich
    texture takes them all. Raises InputError for a file that is no picture, for one of another size than the sensor's,
    and for a photograph that shows nothing to measure.
    """
    picture = _read(photograph, sensor)
    quality = cv2.cornerMinEigenVal(picture, 3)
    apart = max(3, int(0.5 * np.sqrt(sensor.width_px * sensor.height_px / max(count, 1))))
    # Ten times as many, of which those that lie well are chosen; half as far apart as an even spread of them allows.
    found = cv2.goodFeaturesToTrack(picture, 10 * count, _WEAKEST, min(apart, 20))
    if found is None:
        raise InputError(f"{photograph}: no interest point was found; the picture is blank or out of focus")
    corners = found.reshape(-1, 2)
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
    # One that ran away is another's corner.
    stayed = np.abs(fine - corners).max(axis=1) <= _HALF_WINDOW
    # OpenCV counts from the centre of the upper left pixel, which is at (0.5, 0.5) (docs/conventions.md).
    return Features(sensor.mm_from_px(fine[stayed] + 0.5), (strength[stayed] / quality.max()).astype(float))


def sift_features(
    photograph: Path, sensor: Sensor, count: int = FEATURES, longest_px: int = LONGEST_PX
) -> SiftFeatures:
    """Up to `count` SIFT features of a photograph, to a part of a pixel: those of the largest s sqrt(contrast).

    By contrast alone leaves and gravel would take them all, which no other photograph shows again; what is larger
    (s, its width) is seen from elsewhere, too, but large and faint things are not found as well as stated here.

    A photograph whose longer side is above `longest_px` is made smaller first, as its features else need gigabytes of
    memory. The standard deviation of a blob s pixels wide (the scale of SIFT) is

        sigma = sqrt(0.07^2 + (0.025 s)^2) pixels,

    found from views of textures under known projective maps (tests/photos/test_matching.py). Where the
    views differ more, all are larger alike: `match_photographs` says how much. A photograph that is blank or out of
    focus has none.

    Raises InputError for a file that is no picture, and for one of another size than the sensor's.
    Sources: Lowe (2004), Distinctive image features from scale-invariant keypoints; Arandjelovic and Zisserman (2012),
    Three things everyone should know to improve object retrieval.
    """
    picture = _read(photograph, sensor)
    shrunk = min(1.0, longest_px / max(picture.shape))
    if shrunk < 1:
        size = (round(sensor.width_px * shrunk), round(sensor.height_px * shrunk))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    # Without the last argument all features are a quarter of a pixel off, to the right and down.
    sift = cv2.SIFT_create(  # type: ignore[attr-defined]
        0, contrastThreshold=_CONTRAST, enable_precise_upscale=True
    )
    scale = np.array([sensor.width_px, sensor.height_px]) / picture.shape[::-1]
    # Only those chosen are described: to describe all takes twice as long as making the pyramid again.
    keys = sift.detect(picture, None)
    worth = np.array([key.size * np.sqrt(key.response) for key in keys])
    chosen = [keys[k] for k in np.sort(np.argsort(-worth, kind="stable")[:count])]
    chosen, described = sift.compute(picture, chosen)
    if described is None:
        return SiftFeatures(np.zeros((0, 2)), np.zeros(0), np.zeros(0, int), np.zeros((0, 128), np.uint8))
    found = np.array([(*key.pt, key.size) for key in chosen])
    places, feature = np.unique(found, axis=0, return_inverse=True)
    # OpenCV gives the diameter, two widths.
    sigma_px = np.hypot(_SIGMA_PX, _SIGMA_OF_WIDTH * places[:, 2] / 2) * scale.mean()
    roots = np.sqrt(described / np.maximum(described.sum(axis=1, keepdims=True), 1e-9))
    return SiftFeatures(
        sensor.mm_from_px((places[:, :2] + 0.5) * scale),
        sigma_px * sensor.pixel_mm,
        feature.reshape(-1),
        np.minimum(np.round(_LENGTH * roots), 255).astype(np.uint8),
    )


def _read(photograph: Path, sensor: Sensor) -> np.ndarray:
    """The grey values of a photograph of the sensor's size."""
    picture = read_grey(photograph)
    height, width = picture.shape
    if (width, height) != (sensor.width_px, sensor.height_px):
        raise InputError(
            f"{photograph}: the picture has {width} x {height} pixels, the camera {sensor.width_px} x "
            f"{sensor.height_px}; give the picture as it was taken, or the camera that took it"
        )
    return picture


def _spread(corners: np.ndarray, strength: np.ndarray, sensor: Sensor, count: int) -> Int[np.ndarray, "n"]:
    """Of each cell of a grid the strongest, then the second of each, until there are enough."""
    across = max(1, min(_CELLS, int(np.sqrt(count / 2))))
    side = max(sensor.width_px, sensor.height_px) / across
    cell = np.floor(corners / side).astype(int) @ [1, across + 1]
    order = np.lexsort((-strength, cell))
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(begins, np.diff(np.append(begins, len(order))))
    return order[np.lexsort((-strength[order], rank))][:count]
