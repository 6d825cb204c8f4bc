"""ChArUco boards: chessboards with a marker in each white square, which may be partly visible."""

import cv2
import numpy as np
from jaxtyping import Float

from jaxphoto.extras.photos.targets.chessboard import grid_points
from jaxphoto.extras.photos.targets.patches import fit_crossings
from jaxphoto.extras.photos.targets.pattern import FoundBoard, Pattern
from jaxphoto.procedures.calibration import Board

DICTIONARIES: tuple[str, ...] = tuple(
    sorted(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_") and name.isupper())
)
"""Names of OpenCV's marker dictionaries without the prefix DICT_."""
# Ratio of the window radius to the width of the cells at a corner.
_PART = 0.8


class CharucoBoard(Pattern):
    """Board of `columns` x `rows` squares with markers in the white ones; the targets are the inner corners."""

    def __init__(self, columns: int, rows: int, square_m: float, marker_m: float, dictionary: str) -> None:
        if marker_m >= square_m:
            raise ValueError("the marker is not smaller than the square")
        self._dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
        if (needed := columns * rows // 2) > len(self._dictionary.bytesList):
            raise ValueError(
                f"the board needs {needed} markers, but dictionary {dictionary} has {len(self._dictionary.bytesList)}"
            )
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


def _marker_reflectance(dictionary, number, u, v, inside) -> Float[np.ndarray, "n"]:
    """Return the reflectance of marker `number` at (u, v) from its upper left corner (unit: side); 1 outside."""
    cells = dictionary.markerSize + 2
    drawn = np.stack([cv2.aruco.generateImageMarker(dictionary, k, cells) > 0 for k in range(number.max() + 1)])
    inside = inside & (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
    column, row = (np.clip((w * cells).astype(int), 0, cells - 1) for w in (u, v))
    return np.where(inside, drawn[number, row, column], 1.0)
