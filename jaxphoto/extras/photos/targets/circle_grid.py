"""Asymmetric grids of circles: every second row is shifted by half the distance of the circles in it."""

import cv2
import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.extras.photos.targets.discs import Blobs, elliptic_blobs, fit_discs
from jaxphoto.extras.photos.targets.pattern import FoundBoard, Pattern
from jaxphoto.procedures.calibration import Board

# How far apart neighbouring spots are drawn, and the longest side of the drawing.
_APART_PX, _LONGEST_PX = 60, 6000
# Bits of a part of a pixel: on whole pixels some grids are no longer seen as one.
_SHIFT = 4
# Of the distance to a neighbour in a slanting line: by how much it may differ, and how many spots are looked at for it.
_OFF, _NEAREST = 0.35, 24


class CircleGrid(Pattern):
    """`columns` circles in each of `rows` rows that are `spacing_m` apart; in a row they are twice as far apart.

    Rows and columns are counted as OpenCV's asymmetric grid counts them (4x11 is the usual one).
    """

    def __init__(self, columns: int, rows: int, spacing_m: float, diameter_m: float) -> None:
        if rows < 3:
            raise ValueError("an asymmetric grid has 3 rows at least")
        if diameter_m >= np.sqrt(2) * spacing_m:
            raise ValueError("circles so large touch each other: the diameter is less than 1.41 times the spacing")
        self.columns, self.rows, self.radius_m, self._spacing_m = columns, rows, diameter_m / 2, spacing_m
        row, column = np.divmod(np.arange(rows * columns), columns)
        ids = tuple(f"r{r + 1}c{c + 1}" for r, c in zip(row.tolist(), column.tolist(), strict=True))
        xyz = np.stack([(2 * column + row % 2) * spacing_m, -row * spacing_m, 0.0 * row], axis=1)
        self.board = Board("asymmetric circles", ids, xyz, np.full(len(ids), diameter_m))

    def find(self, picture: np.ndarray) -> FoundBoard | None:
        """The circles of the grid, in rows; None where it is not found, and without those that have no clear edge."""
        blobs = elliptic_blobs(picture)
        for dark in (True, False):
            own = self._like_the_grid(blobs.take(blobs.dark == dark))
            if len(own.column_row) < len(self.board.points):
                continue
            drawn, scale, corner = _drawing(own.column_row)
            for sheet, times, shift in ((drawn, scale, corner), (picture, 1.0, np.zeros(2))):
                for how in (cv2.CALIB_CB_ASYMMETRIC_GRID, cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
                    seen, centres = cv2.findCirclesGrid(sheet, (self.columns, self.rows), flags=how)  # type: ignore[call-overload]
                    found = self._placed(picture, own, centres.reshape(-1, 2) / times + shift) if seen else None
                    if found is not None:
                        return found
        return None

    def reflectance(self, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Black circles on white."""
        return disc_reflectance(self.board, xy_m)

    def _like_the_grid(self, blobs: Blobs) -> Blobs:
        """The largest web of spots each as far from the next, in radii of both, as neighbours in a slanting line.

        Measured along the axes of the ellipses that does not depend on how the grid is seen. Letters, leaves and other
        round things go; among many of them the search for the grid would find none.
        """
        n = len(blobs.column_row)
        if n < 2:
            return blobs
        near = scipy.spatial.cKDTree(blobs.column_row).query(blobs.column_row, k=min(n, _NEAREST))[1][:, 1:]
        d = blobs.column_row[near] - blobs.column_row[:, None]
        apart = np.sqrt(2) * self._spacing_m / self.radius_m
        good = np.ones(near.shape, bool)
        for shape in (blobs.shape[:, None], blobs.shape[near]):
            good &= np.abs(np.sqrt(np.einsum("nki,nkij,nkj->nk", d, shape, d)) / apart - 1) < _OFF
        one, other = np.nonzero(good)
        web = scipy.sparse.csgraph.connected_components(
            scipy.sparse.coo_array((np.ones(len(one)), (one, near[one, other])), shape=(n, n))
        )[1]
        return blobs.take(web == np.bincount(web).argmax())

    def _placed(self, picture: np.ndarray, blobs: Blobs, centres: Float[np.ndarray, "n 2"]) -> FoundBoard | None:
        along, down = centres[self.columns - 1] - centres[0], centres[2 * self.columns] - centres[0]
        if along[0] * down[1] - along[1] * down[0] < 0:
            if self.rows % 2 == 0:
                return None  # seen as in a mirror, which such a grid cannot be
            centres = centres.reshape(self.rows, self.columns, 2)[::-1].reshape(-1, 2)
        which = scipy.spatial.cKDTree(blobs.column_row).query(centres)[1]
        d = centres - blobs.column_row[which]
        # What OpenCV counts as a circle may be no ellipse here: cut off, or in half a shadow.
        same = np.einsum("ni,nij,nj->n", d, blobs.shape[which], d) < 1
        return FoundBoard(np.flatnonzero(same), fit_discs(picture, blobs.take(which[same])))


def _drawing(places: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, float, Float[np.ndarray, "2"]]:
    """A clean picture of spots at `places`, its scale and the place of its corner: `drawn = (place - corner) * scale`.

    OpenCV's search for spots wants them evenly lit, of some size and apart.
    """
    distance = scipy.spatial.cKDTree(places).query(places, k=2)[0][:, 1]
    scale = _APART_PX / float(np.median(distance))
    scale = min(scale, _LONGEST_PX / float(np.ptp(places, axis=0).max()))
    corner = places.min(axis=0) - 2 * _APART_PX / scale
    spots = (places - corner) * scale
    drawn = np.full(np.ceil(spots.max(axis=0) + 2 * _APART_PX).astype(int)[::-1], 255, np.uint8)
    parts = 1 << _SHIFT
    for spot in np.rint(spots * parts).astype(int).tolist():
        cv2.circle(drawn, spot, _APART_PX // 4 * parts, 0, -1, shift=_SHIFT)
    return drawn, scale, corner


def disc_reflectance(board: Board, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Black where a place lies in one of the board's circles, white elsewhere."""
    black = np.zeros(len(xy_m), bool)
    for centre, diameter in zip(board.xyz_m[:, :2], board.diameter_m, strict=True):
        black |= np.sum((xy_m - centre) ** 2, axis=1) < (diameter / 2) ** 2
    return np.where(black, 0.0, 1.0)
