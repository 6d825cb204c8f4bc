"""ChArUco boards: chessboards with a marker in each white square, which may be partly visible."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from jaxphoto.extras.photos.targets.patches import fit_crossings
from jaxphoto.extras.photos.targets.pattern import FoundBoard, Pattern
from jaxphoto.procedures.calibration import Board

_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
# Ratio of the window radius to the distance of the nearest other edge.
_PART = 0.6


class Chessboard(Pattern):
    """Chessboard with `columns` x `rows` inner corners, one fewer than squares in each direction."""

    def __init__(self, columns: int, rows: int, square_m: float) -> None:
        self.columns, self.rows, self.square_m = columns, rows, square_m
        self.board = Board("chessboard", *grid_points(columns, rows, square_m), np.zeros(columns * rows))

    def find(self, picture: np.ndarray) -> FoundBoard | None:
        """Detect all inner corners, row by row; None if OpenCV does not find all."""
        size = (self.columns, self.rows)
        seen, corners = cv2.findChessboardCorners(picture, size, None, _FLAGS)
        if not seen:
            seen, corners = cv2.findChessboardCornersSB(picture, size, None, cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not seen:
            return None
        near = facing(corners.reshape(self.rows, self.columns, 2).astype(float))
        edges, apart = _neighbours(near)
        return FoundBoard(np.arange(len(edges)), fit_crossings(picture, near.reshape(-1, 2), edges, _PART * apart))

    def reflectance(self, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the reflectance of squares, black in the upper left, with a white margin."""
        column, row = np.floor(xy_m[:, 0] / self.square_m) + 1, np.floor(-xy_m[:, 1] / self.square_m) + 1
        inside = (column >= 0) & (row >= 0) & (column <= self.columns) & (row <= self.rows)
        return np.where(inside, (column + row) % 2, 1.0)

    def hint(self, pictures: Sequence[np.ndarray]) -> str | None:
        """Describe the largest grid of corners in the images."""
        counts = []
        for picture in pictures:
            flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
            seen, _, kinds = cv2.findChessboardCornersSBWithMeta(picture, (3, 3), flags)
            counts += [sorted(kinds.shape[:2])] if seen else []
        if not counts:
            return None
        fewer, more = max(counts, key=np.prod)
        if (fewer, more) == (min(self.columns, self.rows), max(self.columns, self.rows)):
            return None
        hint = f"{more}x{fewer} corners found"
        return f"{hint}: give the inner corners, where four squares meet, or show the whole board"


def grid_points(columns: int, rows: int, apart_m: float) -> tuple[tuple[str, ...], Float[np.ndarray, "n 3"]]:
    """Return ids r1c1, r1c2, ... and coordinates of a grid: X right, Y up, origin at the upper left point."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    ids = tuple(f"r{r + 1}c{c + 1}" for r, c in zip(row.tolist(), column.tolist(), strict=True))
    return ids, np.stack([column * apart_m, -row * apart_m, 0.0 * row], axis=1)


def facing(grid: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns 2"]:
    """Reverse the rows of a grid if it is seen from behind."""
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    return grid if along[0] * down[1] - along[1] * down[0] > 0 else grid[::-1]


def _neighbours(
    grid: Float[np.ndarray, "rows columns 2"],
) -> tuple[Float[np.ndarray, "n 2 2"], Float[np.ndarray, "n"]]:
    """Return the directions of row and column at each corner, and the distance (px) to the nearest other edge."""
    along, down = np.gradient(grid, axis=1), np.gradient(grid, axis=0)
    area = np.abs(along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0])
    length = np.linalg.norm(along, axis=-1), np.linalg.norm(down, axis=-1)
    edges = np.stack([along / length[0][..., None], down / length[1][..., None]], axis=2)
    return edges.reshape(-1, 2, 2), (area / np.maximum(*length)).ravel()


DICTIONARIES: tuple[str, ...] = tuple(
    sorted(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_") and name.isupper())
)
"""Names of OpenCV's marker dictionaries without the prefix DICT_."""
# Ratio of the window radius to the width of the cells at a corner.
_MARKER_PART = 0.8


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
        reach = _MARKER_PART * margin * length.min(axis=(1, 2))
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
