"""Chessboards: inner corners detected by OpenCV and measured by least squares."""

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
