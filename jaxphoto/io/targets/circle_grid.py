"""Asymmetric grids of circles: every second row is shifted by half the distance of the circles in it."""

import cv2
import numpy as np
from jaxtyping import Float

from jaxphoto.io.targets.discs import Blobs, elliptic_blobs, fit_discs
from jaxphoto.io.targets.pattern import Found, Pattern
from jaxphoto.procedures.calibration import Board

# How far apart neighbouring spots are drawn.
_APART_PX = 40


class CircleGrid(Pattern):
    """`columns` circles in each of `rows` rows that are `spacing_m` apart; in a row they are twice as far apart.

    Rows and columns are counted as OpenCV's asymmetric grid counts them (4x11 is the usual one).
    """

    def __init__(self, columns: int, rows: int, spacing_m: float, diameter_m: float) -> None:
        if rows < 3:
            raise ValueError("an asymmetric grid has 3 rows at least")
        if diameter_m >= np.sqrt(2) * spacing_m:
            raise ValueError("circles so large touch each other: the diameter is less than 1.41 times the spacing")
        self.columns, self.rows, self.radius_m = columns, rows, diameter_m / 2
        row, column = np.divmod(np.arange(rows * columns), columns)
        ids = tuple(f"r{r + 1}c{c + 1}" for r, c in zip(row.tolist(), column.tolist(), strict=True))
        xyz = np.stack([(2 * column + row % 2) * spacing_m, -row * spacing_m, 0.0 * row], axis=1)
        self.board = Board("asymmetric circles", ids, xyz, np.full(len(ids), diameter_m))

    def find(self, picture: np.ndarray) -> Found | None:
        """All circles of the grid, in rows; None where they are not all found."""
        blobs = elliptic_blobs(picture)
        for dark in (True, False):
            own = np.flatnonzero(blobs.dark == dark)
            if len(own) < len(self.board.points):
                continue
            drawn, scale, corner = _drawing(blobs.column_row[own])
            for sheet, times, shift in ((picture, 1.0, np.zeros(2)), (drawn, scale, corner)):
                for how in (cv2.CALIB_CB_ASYMMETRIC_GRID, cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
                    seen, centres = cv2.findCirclesGrid(sheet, (self.columns, self.rows), flags=how)  # type: ignore[call-overload]
                    if seen:
                        return self._placed(picture, blobs, own, centres.reshape(-1, 2) / times + shift)
        return None

    def reflectance(self, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Black circles on white."""
        return disc_reflectance(self.board, xy_m)

    def _placed(self, picture, blobs, own, centres) -> Found | None:
        along, down = centres[self.columns - 1] - centres[0], centres[2 * self.columns] - centres[0]
        if along[0] * down[1] - along[1] * down[0] < 0:
            if self.rows % 2 == 0:
                return None  # seen as in a mirror, which such a grid cannot be
            centres = centres.reshape(self.rows, self.columns, 2)[::-1].reshape(-1, 2)
        which = own[np.argmin(np.linalg.norm(blobs.column_row[own] - centres[:, None], axis=2), axis=1)]
        chosen = Blobs(blobs.column_row[which], blobs.shape[which], blobs.dark[which])
        return Found(np.arange(len(which)), fit_discs(picture, chosen))


def _drawing(places: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, float, Float[np.ndarray, "2"]]:
    """A clean picture of spots at `places`, its scale and the place of its corner: `drawn = (place - corner) * scale`.

    OpenCV's search for spots wants them evenly lit and of some size.
    """
    distance = np.linalg.norm(places[:, None] - places, axis=2) + 1e9 * np.eye(len(places))
    scale = float(_APART_PX / np.median(distance.min(axis=1)))
    corner = places.min(axis=0) - _APART_PX / scale
    spots = (places - corner) * scale
    drawn = np.full(np.ceil(spots.max(axis=0) + _APART_PX).astype(int)[::-1], 255, np.uint8)
    for spot in np.rint(spots).astype(int).tolist():
        cv2.circle(drawn, spot, _APART_PX // 4, 0, -1)
    return drawn, scale, corner


def disc_reflectance(board: Board, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Black where a place lies in one of the board's circles, white elsewhere."""
    black = np.zeros(len(xy_m), bool)
    for centre, diameter in zip(board.xyz_m[:, :2], board.diameter_m, strict=True):
        black |= np.sum((xy_m - centre) ** 2, axis=1) < (diameter / 2) ** 2
    return np.where(black, 0.0, 1.0)
