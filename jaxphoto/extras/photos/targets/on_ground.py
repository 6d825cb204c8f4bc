"""Ground targets in a window of a photograph: circles, numbered markers, and crosses of four squares.

    circle:diameter_mm=300              bright or dark, identified by size and shape
    aruco:dictionary=4X4_50             the last number in the point name is the marker number: GCP7 is marker 7
    cross:side_mm=600                   two black and two white squares around a common corner; total width

The size in the image is derived from the derivative of the projection, assuming a horizontal target.
"""

import abc
import re

import cv2
import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError
from jaxphoto.extras.photos.targets.circles import elliptic_blobs, fit_discs
from jaxphoto.extras.photos.targets.markers import DICTIONARIES, found_markers
from jaxphoto.extras.photos.targets.patches import TargetPlaces, fit_crossings
from jaxphoto.io.text_tables import is_number

SYNTAX = {
    "circle": "circle:diameter_mm=300",
    "aruco": "aruco:dictionary=4X4_50",
    "cross": "cross:side_mm=600",
}
# Maximum ratio of measured and expected size, or its inverse.
_LIKE = 1.5
# Minimum diameter or side (px) of a target that can be distinguished from noise.
_SMALLEST_PX = 5.0
# Cross: number of samples on a circle; ratio of its radius to the side; minimum autocorrelation after half a turn,
# maximum after a quarter turn.
_ANGLES, _OUT, _OPPOSITE, _BESIDE = 72, 0.3, 0.7, -0.5
_MOST = 6


class GroundTarget(abc.ABC):
    """Kind of ground target."""

    named = False
    """True if the target's appearance identifies its point."""
    side_m = 0.0

    @abc.abstractmethod
    def find(self, window: np.ndarray, point: str, px_per_m: Float[np.ndarray, "2 2"]) -> TargetPlaces:
        """Return candidates for the target of `point` in a window; the origin is the centre of the upper left pixel."""

    def reach_px(self, px_per_m: Float[np.ndarray, "2 2"]) -> float:
        """Return the half width (px) of a window that contains the target."""
        return 8.0 * self.side_m * float(np.linalg.norm(px_per_m, 2)) + 8.0


class Circle(GroundTarget):
    """Circle with diameter `diameter_m`."""

    def __init__(self, diameter_m: float) -> None:
        self.side_m = diameter_m

    def find(self, window: np.ndarray, point: str, px_per_m: Float[np.ndarray, "2 2"]) -> TargetPlaces:
        """Detect ellipses of the expected size."""
        should = np.linalg.svd(px_per_m, compute_uv=False) * self.side_m / 2
        if 2 * should[1] < _SMALLEST_PX:
            return _nothing()
        return _sound(fit_discs(window, elliptic_blobs(window, (should, _LIKE))))


class Marker(GroundTarget):
    """Marker from one of OpenCV's dictionaries."""

    named = True

    def __init__(self, dictionary: str) -> None:
        self.dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))

    def find(self, window: np.ndarray, point: str, px_per_m: Float[np.ndarray, "2 2"]) -> TargetPlaces:
        """Return the intersection of the diagonals of each marker with the number of the point."""
        digits = re.findall(r"\d+", point)
        markers = found_markers(window, self.dictionary, 1.0)
        matching = np.flatnonzero(markers.number == int(digits[-1][:9])) if digits else np.zeros(0, int)
        middle, sigma = [], []
        for k in matching:
            corners, each, good = (v[4 * k : 4 * k + 4] for v in markers.corners)
            a, c, b, d = corners[[0, 2, 1, 3]]
            across = np.column_stack([c - a, b - d])
            if good.all() and abs(np.linalg.det(across)) > 1:
                middle.append(a + (c - a) * np.linalg.solve(across, b - a)[0])
                sigma.append(np.sqrt(np.mean(each**2, axis=0)) / 2)
        return TargetPlaces(np.array(middle).reshape(-1, 2), np.array(sigma).reshape(-1, 2), np.ones(len(middle), bool))

    def reach_px(self, px_per_m: Float[np.ndarray, "2 2"]) -> float:
        """Return half the window width for a large marker: the marker size is unknown."""
        return 2.0 * float(np.linalg.norm(px_per_m, 2)) + 20.0


class Cross(GroundTarget):
    """Four squares around a common corner, with total width `side_m`."""

    def __init__(self, side_m: float) -> None:
        self.side_m = side_m

    def find(self, window: np.ndarray, point: str, px_per_m: Float[np.ndarray, "2 2"]) -> TargetPlaces:
        """Detect saddle points of the grey values with four edges around them."""
        side = float(np.sqrt(abs(np.linalg.det(px_per_m)))) * self.side_m
        if side < _SMALLEST_PX:
            return _nothing()
        grey = cv2.GaussianBlur(window.astype(np.float32), (0, 0), max(0.8, side / 10))
        xx, yy, xy = (cv2.Sobel(grey, cv2.CV_32F, *order, ksize=5) for order in ((2, 0), (0, 2), (1, 1)))
        saddle = xy * xy - xx * yy
        width = max(3, round(side / 3) | 1)
        peaks = (saddle == cv2.dilate(saddle, np.ones((width, width)))) & (saddle > 0.1 * saddle.max())
        row, column = np.nonzero(peaks)
        order = np.argsort(-saddle[row, column])[: 4 * _MOST]
        near, edges = [], []
        for k in order:
            place = np.array([column[k], row[k]], float)
            if (directions := _edges(grey, place, max(_OUT * side, 2.5))) is not None:
                near.append(place)
                edges.append(directions)
        if not near:
            return _nothing()
        near, edges = near[:_MOST], edges[:_MOST]
        reach = np.full(len(near), 0.42 * side)
        return _sound(fit_crossings(window, np.array(near), np.array(edges), reach))


def read_target(description: str) -> GroundTarget:
    """Create a target from a one-line description. Raise InputError, with the syntax, for an invalid description."""
    kind, _, rest = description.partition(":")
    name, _, value = rest.partition("=")
    if kind not in SYNTAX:
        raise InputError(f"--targets {description}: unknown target; write one of {', '.join(SYNTAX.values())}")
    if name != SYNTAX[kind].partition(":")[2].partition("=")[0]:
        raise InputError(f"--targets {description}: invalid setting {name!r}; write it like {SYNTAX[kind]}")
    if kind == "aruco":
        if value.upper() not in DICTIONARIES:
            there = ", ".join(DICTIONARIES)
            raise InputError(f"--targets {description}: unknown dictionary {value!r}; use one of {there}")
        return Marker(value.upper())
    if not is_number(value) or not 0 < float(value) < 1e5:
        raise InputError(f"--targets {description}: {name} is {value!r}, not a positive number of millimetres")
    return (Circle if kind == "circle" else Cross)(float(value) / 1000)


def _edges(grey: np.ndarray, place: np.ndarray, radius: float) -> Float[np.ndarray, "2 2"] | None:
    """Return the unit directions of the two edges that cross at `place`; None if there is no crossing."""
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    around = (place + radius * np.column_stack([np.cos(angle), np.sin(angle)])).astype(np.float32)
    high, wide = grey.shape
    if (around < 0).any() or (around > (wide - 1, high - 1)).any():
        return None
    value = cv2.remap(grey, around[:, None, 0], around[:, None, 1], cv2.INTER_LINEAR).ravel().astype(float)
    value -= (np.percentile(value, 90) + np.percentile(value, 10)) / 2
    size = float(value @ value)
    turned = [float(value @ np.roll(value, _ANGLES // part)) for part in (2, 4)]
    if size < 1e-6 or turned[0] < _OPPOSITE * size or turned[1] > _BESIDE * size:
        return None
    after = np.roll(value, -1)
    change = np.flatnonzero((value < 0) != (after < 0))
    if len(change) != 4:
        return None
    part = value[change] / (value[change] - after[change])
    at = angle[change] + part * 2 * np.pi / _ANGLES
    # Average opposite sign changes: they belong to the same edge.
    middle = (at[:2] + at[2:] - np.pi) / 2
    return np.column_stack([np.cos(middle), np.sin(middle)])


def _sound(places: TargetPlaces) -> TargetPlaces:
    return TargetPlaces(*(v[places.found] for v in places))


def _nothing() -> TargetPlaces:
    return TargetPlaces(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool))
