"""ArUco boards, and ChArUco boards (chessboards with a marker in each white square). Boards may be partly visible."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.extras.photos.targets.chessboard import grid_points
from jaxphoto.extras.photos.targets.patches import TargetPlaces, fit_crossings, fit_square_corners
from jaxphoto.extras.photos.targets.pattern import FoundBoard, Pattern
from jaxphoto.procedures.calibration import Board

DICTIONARIES: tuple[str, ...] = tuple(
    sorted(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_") and name.isupper())
)
"""Names of OpenCV's marker dictionaries without the prefix DICT_."""
# Ratio of the window radius to the width of the cells at a corner.
_PART = 0.8


class ArucoGrid(Pattern):
    """Grid of `columns` x `rows` markers, numbered by rows from 0; the targets are the marker corners."""

    def __init__(self, columns: int, rows: int, marker_m: float, gap_m: float, dictionary: str) -> None:
        self._dictionary = _dictionary(dictionary, columns * rows)
        self.columns, self.rows, self.marker_m, self.gap_m = columns, rows, marker_m, gap_m
        corners = np.array([[0, 0], [1, 0], [1, -1], [0, -1]]) * marker_m
        row, column = np.divmod(np.arange(rows * columns), columns)
        first = np.stack([column, -row], axis=1) * (marker_m + gap_m)
        xy = (first[:, None] + corners).reshape(-1, 2)
        ids = tuple(f"m{m}c{c}" for m in range(rows * columns) for c in (1, 2, 3, 4))
        self.board = Board("ArUco markers", ids, np.column_stack([xy, np.zeros(len(xy))]), np.zeros(len(xy)))

    def find(self, picture: np.ndarray) -> FoundBoard | None:
        """Detect the corners of all visible markers of the board; None if there are none."""
        markers = found_markers(picture, self._dictionary, self.gap_m / self.marker_m)
        valid = (markers.number < self.columns * self.rows) & (np.bincount(markers.number)[markers.number] == 1)
        if not valid.any():
            return None
        point = (4 * markers.number[valid][:, None] + np.arange(4)).ravel()
        return FoundBoard(point, TargetPlaces(*(v[np.repeat(valid, 4)] for v in markers.corners)))

    def reflectance(self, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the reflectance of black-framed markers on white."""
        pitch = self.marker_m + self.gap_m
        column, row = np.floor(xy_m[:, 0] / pitch).astype(int), np.floor(-xy_m[:, 1] / pitch).astype(int)
        inside = (column >= 0) & (row >= 0) & (column < self.columns) & (row < self.rows)
        u, v = xy_m[:, 0] - column * pitch, -xy_m[:, 1] - row * pitch
        number = np.where(inside, row * self.columns + column, 0)
        return _marker_reflectance(self._dictionary, number, u / self.marker_m, v / self.marker_m, inside)


class FoundMarkers(NamedTuple):
    """Markers in a picture."""

    number: Int[np.ndarray, "n"]
    corners: TargetPlaces
    """Four corners per marker."""


def found_markers(picture: np.ndarray, dictionary, margin: float) -> FoundMarkers:
    """Detect all markers of a dictionary; `margin` is the width of the bright border (unit: marker side)."""
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
    if ids is None:
        return FoundMarkers(np.zeros(0, int), TargetPlaces(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool)))
    near = np.array(corners, float).reshape(-1, 4, 2)
    sides = np.roll(near, -1, axis=1) - near
    length = np.linalg.norm(sides, axis=2, keepdims=True)
    along = sides / length
    edges = np.stack([along, -np.roll(along, 1, axis=1)], axis=2)
    width = np.minimum(1 / (dictionary.markerSize + 2), margin) * length.min(axis=(1, 2))
    places = fit_square_corners(picture, near.reshape(-1, 2), edges.reshape(-1, 2, 2), np.repeat(_PART * width, 4))
    return FoundMarkers(np.asarray(ids).ravel().astype(int), places)


class CharucoBoard(Pattern):
    """Board of `columns` x `rows` squares with markers in the white ones; the targets are the inner corners."""

    def __init__(self, columns: int, rows: int, square_m: float, marker_m: float, dictionary: str) -> None:
        if marker_m >= square_m:
            raise ValueError("the marker is not smaller than the square")
        self._dictionary = _dictionary(dictionary, columns * rows // 2)
        self.columns, self.rows, self.square_m, self.marker_m = columns, rows, square_m, marker_m
        self._drawn = cv2.aruco.CharucoBoard((columns, rows), square_m, marker_m, self._dictionary)
        ids, xyz = grid_points(columns - 1, rows - 1, square_m)
        self.board = Board("ChArUco", ids, xyz + np.array([square_m, -square_m, 0.0]), np.zeros(len(ids)))

    def find(self, picture: np.ndarray) -> FoundBoard | None:
        """Detect the visible inner corners; None if fewer than four, or all in one row or column."""
        corners, ids, *_ = cv2.aruco.CharucoDetector(self._drawn).detectBoard(picture)
        if ids is None or len(ids) < 4:
            return None
        near, point = np.asarray(corners, float).reshape(-1, 2), np.asarray(ids).ravel()
        plane = self.board.xyz_m[point, :2]
        if np.ptp(plane, axis=0).min() == 0:
            return None  # collinear corners determine no homography
        homography, _ = cv2.findHomography(plane, near)
        if homography is None:
            return None
        ends = plane[:, None] + np.array([[0, 0], [1, 0], [0, -1]]) * self.square_m
        projected = cv2.perspectiveTransform(ends.reshape(1, -1, 2), homography).reshape(-1, 3, 2)
        sides = projected[:, 1:] - projected[:, :1]
        length = np.linalg.norm(sides, axis=2, keepdims=True)
        # The distance to the nearest marker is its margin along the diagonal.
        margin = (1 - self.marker_m / self.square_m) / 2 * np.sqrt(2)
        reach = _PART * margin * length.min(axis=(1, 2))
        return FoundBoard(point, fit_crossings(picture, near, sides / length, reach))

    def reflectance(self, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the reflectance of squares, black in the upper left, with markers in the white ones."""
        column, row = (
            np.floor(xy_m[:, 0] / self.square_m).astype(int),
            np.floor(-xy_m[:, 1] / self.square_m).astype(int),
        )
        inside = (column >= 0) & (row >= 0) & (column < self.columns) & (row < self.rows)
        white = (column + row) % 2 == 1
        number = np.where(inside & white, (row * self.columns + column) // 2, 0)
        margin = (self.square_m - self.marker_m) / 2
        u, v = xy_m[:, 0] - column * self.square_m - margin, -xy_m[:, 1] - row * self.square_m - margin
        marked = _marker_reflectance(self._dictionary, number, u / self.marker_m, v / self.marker_m, inside & white)
        return np.where(inside & ~white, 0.0, marked)


def _dictionary(name: str, needed: int):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
    if needed > len(dictionary.bytesList):
        raise ValueError(f"the board needs {needed} markers, but dictionary {name} has {len(dictionary.bytesList)}")
    return dictionary


def _marker_reflectance(dictionary, number, u, v, inside) -> Float[np.ndarray, "n"]:
    """Return the reflectance of marker `number` at (u, v) from its upper left corner (unit: side); 1 outside."""
    cells = dictionary.markerSize + 2
    drawn = np.stack([cv2.aruco.generateImageMarker(dictionary, k, cells) > 0 for k in range(number.max() + 1)])
    inside = inside & (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    column, row = (np.clip((w * cells).astype(int), 0, cells - 1) for w in (u, v))
    return np.where(inside, drawn[number, row, column], 1.0)
