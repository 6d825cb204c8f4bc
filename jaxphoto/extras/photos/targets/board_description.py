"""One-line descriptions of calibration boards, as on the command line.

chessboard:8x6:square_mm=30            inner corners: columns x rows
circles:4x11:spacing_mm=20:diameter_mm=15
charuco:7x5:square_mm=30:marker_mm=22:dictionary=4X4_50
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError
from jaxphoto.extras.photos.targets.circles import CircleGrid
from jaxphoto.extras.photos.targets.patches import fit_crossings
from jaxphoto.extras.photos.targets.pattern import FoundBoard, Pattern
from jaxphoto.io.text_tables import is_number
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


SYNTAX = {
    "chessboard": "chessboard:8x6:square_mm=30",
    "circles": "circles:4x11:spacing_mm=20:diameter_mm=15",
    "charuco": "charuco:7x5:square_mm=30:marker_mm=22:dictionary=4X4_50",
}
"""Syntax by kind of board."""

_MADE: dict[str, tuple[Callable[..., Pattern], tuple[str, ...], int]] = {
    "chessboard": (Chessboard, ("square_mm",), 3),
    "circles": (CircleGrid, ("spacing_mm", "diameter_mm"), 2),
    "charuco": (CharucoBoard, ("square_mm", "marker_mm", "dictionary"), 2),
}


def read_board(description: str) -> Pattern:
    """Create a board from a one-line description (mm). Raise InputError, with the syntax, for an invalid one."""
    kind, _, rest = description.partition(":")
    if kind not in SYNTAX:
        raise InputError(f"--board {description}: unknown board {kind!r}; write one of {', '.join(SYNTAX.values())}")
    size, *settings = rest.split(":")
    make, names, least = _MADE[kind]
    counts = size.lower().split("x")
    if len(counts) != 2 or not all(n.isdecimal() and least <= int(n) <= 500 for n in counts):
        raise _bad(description, kind, f"{size!r} is not columns x rows, {least} to 500 each")
    texts: dict[str, str] = {}
    for setting in settings:
        name, sign, value = setting.partition("=")
        if not sign or name not in names or name in texts:
            raise _bad(description, kind, f"{setting!r} is not one of {', '.join(f'{n}=...' for n in names)}")
        texts[name] = value
    if missing := [name for name in names if name not in texts]:
        raise _bad(description, kind, f"{missing[0]} is missing")
    values = {name.removesuffix("_mm"): _value(description, kind, name, text) for name, text in texts.items()}
    try:
        return make(*map(int, counts), **{f"{k}_m" if k != "dictionary" else k: v for k, v in values.items()})
    except ValueError as error:
        raise _bad(description, kind, str(error)) from None


def _value(description: str, kind: str, name: str, text: str) -> float | str:
    if name == "dictionary":
        if text.upper() not in DICTIONARIES:
            raise _bad(description, kind, f"unknown dictionary {text!r} (use one of {', '.join(DICTIONARIES)})")
        return text.upper()
    if not is_number(text) or not 0 < float(text) < 1e6:
        raise _bad(description, kind, f"{name} is {text!r}, not a positive number of millimetres")
    return float(text) / 1000


def _bad(description: str, kind: str, message: str) -> InputError:
    return InputError(f"--board {description}: {message}; write it like {SYNTAX[kind]}")
