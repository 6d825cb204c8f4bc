"""Features of photographs: interest points of one, and the same points in several, found by OpenCV."""

import itertools
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from jaxphoto.camera import Sensor
from jaxphoto.errors import InputError

# Of a corner's strength over that of the strongest, as OpenCV counts it.
_WEAKEST = 0.01
# Half a window of 11 pixels, in which a corner is found to a part of a pixel.
_HALF_WINDOW = 5
_BORDER_PX = 8
_CELLS = 16
# Lowe's: how much nearer the best match must be than the second best.
_RATIO = 0.8
# Off the epipolar line at most.
_EPIPOLAR_PX = 2.0
_LEAST_MATCHES = 16


class Features(NamedTuple):
    """Interest points of a photograph."""

    xy_mm: Float[np.ndarray, "n 2"]
    """Measured image coordinates, from the image centre, x right, y up (docs/conventions.md)."""
    strength: Float[np.ndarray, "n"]
    """Smaller eigenvalue of the gradients around it (Shi and Tomasi, 1994), over that of the strongest."""


class TieFeatures(NamedTuple):
    """Points seen in several photographs, one row for each measurement, sorted by point."""

    photograph: Int[np.ndarray, "rows"]
    """Index of the photograph, in the order given."""
    point: Int[np.ndarray, "rows"]
    xy_mm: Float[np.ndarray, "rows 2"]


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
    return Features(_mm(fine[stayed], sensor), (strength[stayed] / quality.max()).astype(float))


def tie_features(photographs: list[Path], sensor: Sensor, count: int = 5000, least_photographs: int = 2) -> TieFeatures:
    """Points that overlapping photographs of one camera show in common: pairs, triplets and more.

    SIFT features (up to `count` a photograph) of each two photographs are matched both ways by Lowe's ratio test, those
    off the epipolar lines of the fundamental matrix (RANSAC) are left out, and what matches hangs together is a point.
    One that would lie at two places of a photograph is left out, and so is one in fewer than `least_photographs`.
    Raises InputError as `interest_points`, and where no two photographs have enough in common.
    """
    # Without the last argument all features are a quarter of a pixel off, to the right and down.
    sift = cv2.SIFT_create(count, enable_precise_upscale=True)  # type: ignore[attr-defined]
    places, descriptors = [], []
    for path in photographs:
        keys, described = sift.detectAndCompute(_read(path, sensor), None)
        if described is None or len(keys) < 2:
            raise InputError(f"{path}: no interest point was found; the picture is blank or out of focus")
        places.append(np.array([key.pt for key in keys]))
        descriptors.append(described)
    number = np.array([len(p) for p in places])
    first = np.cumsum(number) - number
    matches = [np.zeros((0, 2), int)]
    for one, other in itertools.combinations(range(len(photographs)), 2):
        pairs = _matched(places[one], places[other], descriptors[one], descriptors[other])
        matches.append(pairs + first[[one, other]])
    match = np.concatenate(matches)
    graph = csr_matrix((np.ones(len(match)), match.T), (number.sum(),) * 2)
    _, feature = connected_components(graph, directed=False)
    photograph = np.repeat(np.arange(len(photographs)), number)
    rows = _common(feature, photograph, least_photographs)
    if not len(rows):
        raise InputError(
            f"the {len(photographs)} photographs have no point in common; give such as overlap, in the same size"
        )
    _, point = np.unique(feature[rows], return_inverse=True)
    xy_mm = _mm(np.concatenate(places)[rows], sensor)
    order = np.lexsort((photograph[rows], point))
    return TieFeatures(photograph[rows][order], point[order], xy_mm[order])


def _read(photograph: Path, sensor: Sensor) -> np.ndarray:
    """The grey values of a photograph, turned as its sensor is: no note of the camera about it counts."""
    if not Path(photograph).is_file():
        raise InputError(f"{photograph}: there is no such photograph")
    picture = cv2.imread(str(photograph), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if picture is None:
        raise InputError(f"{photograph}: this is no picture that OpenCV can read; give a TIFF, PNG or JPEG")
    height, width = picture.shape
    if (width, height) != (sensor.width_px, sensor.height_px):
        raise InputError(
            f"{photograph}: the picture has {width} x {height} pixels, the camera {sensor.width_px} x "
            f"{sensor.height_px}; give the picture as it was taken, or the camera that took it"
        )
    return picture


def _mm(pixels: np.ndarray, sensor: Sensor) -> Float[np.ndarray, "n 2"]:
    """OpenCV counts from the centre of the upper left pixel, which is at (0.5, 0.5) (docs/conventions.md)."""
    return sensor.mm_from_px(pixels + 0.5)


def _spread(corners: np.ndarray, strength: np.ndarray, sensor: Sensor, count: int) -> Int[np.ndarray, "n"]:
    """Of each cell of a grid the strongest, then the second of each, until there are enough."""
    across = max(1, min(_CELLS, int(np.sqrt(count / 2))))
    side = max(sensor.width_px, sensor.height_px) / across
    cell = np.floor(corners / side).astype(int) @ [1, across + 1]
    order = np.lexsort((-strength, cell))
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(begins, np.diff(np.append(begins, len(order))))
    return order[np.lexsort((-strength[order], rank))][:count]


def _matched(one: np.ndarray, other: np.ndarray, described: Any, others: Any) -> Int[np.ndarray, "pairs 2"]:
    """Features of two photographs that are each other's best and lie on each other's epipolar lines."""
    ways = []
    for a, b in ((described, others), (others, described)):
        best = [pair for pair in cv2.BFMatcher(cv2.NORM_L2).knnMatch(a, b, k=2) if len(pair) == 2]
        ways.append({m.queryIdx: m.trainIdx for m, second in best if m.distance < _RATIO * second.distance})
    pairs = np.array([(a, b) for a, b in ways[0].items() if ways[1].get(b) == a]).reshape(-1, 2)
    if len(pairs) < _LEAST_MATCHES:
        return pairs[:0]
    cv2.setRNGSeed(0)
    _, good = cv2.findFundamentalMat(one[pairs[:, 0]], other[pairs[:, 1]], cv2.FM_RANSAC, _EPIPOLAR_PX, 0.999)
    if good is None or good.sum() < _LEAST_MATCHES:
        return pairs[:0]
    return pairs[good.ravel() > 0]


def _common(feature: np.ndarray, photograph: np.ndarray, least: int) -> Int[np.ndarray, "rows"]:
    """Features of points that are in `least` photographs at least and once in each."""
    _, point, times = np.unique(feature, return_inverse=True, return_counts=True)
    pairs = np.stack([point, photograph])
    _, where, often = np.unique(pairs, axis=1, return_index=True, return_counts=True)
    twice = np.zeros(len(times), bool)
    twice[point[where[often > 1]]] = True
    return np.flatnonzero((times[point] >= least) & ~twice[point])
