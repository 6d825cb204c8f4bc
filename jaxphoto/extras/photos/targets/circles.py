"""Circular targets: centres by least squares, and asymmetric grids.

    grey = m + g . d + a (1 - erf(e / s)) / 2,   rho = |L' d|,   e = rho (rho - 1) / |L L' d|,   d = pixel - centre

e is the first-order distance from the ellipse rho = 1. The ten unknowns (centre, three elements of L, ln s, a, m, g)
are estimated by `patches`. The centre of the ellipse is not the image of the circle's centre: see `eccentricity` in
`jaxphoto.procedures.calibration.target_calibration`.
"""

from typing import NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from jaxphoto.extras.photos.targets.patches import Patches, TargetPlaces, fit_patches, fits
from jaxphoto.extras.photos.targets.pattern import FoundBoard, Pattern
from jaxphoto.procedures.calibration import Board

# Half width (px) of the ring about the edge; maximum number of pixels per target.
_RING, _MOST = 4.0, 1024
_BLUR = 1.0
# Maximum relative difference of the area from the ellipse of equal moments; minimum area (px); maximum ratio of axes.
_SHAPE, _MIN_AREA, _ELONGATION = 0.06, 20, 6.0
# Maximum shift of a fitted centre as a fraction of the smaller half axis.
_MOVED = 0.5


class Blobs(NamedTuple):
    """Elliptic spots, dark or bright; the origin is the centre of the upper left pixel."""

    column_row: Float[np.ndarray, "n 2"]
    shape: Float[np.ndarray, "n 2 2"]
    """Matrix Q of the ellipse d' Q d = 1."""
    dark: Bool[np.ndarray, "n"]
    """True if the spot is darker than its surroundings."""

    def take(self, chosen: np.ndarray) -> "Blobs":
        """Select spots by index or mask."""
        return Blobs(self.column_row[chosen], self.shape[chosen], self.dark[chosen])


def elliptic_blobs(picture: np.ndarray) -> Blobs:
    """Detect elliptic spots in an image by adaptive thresholds with several window sizes. Spots at the border are
    rejected.

    Of several spots with the same centre the most elliptic one is retained.
    """
    smooth = cv2.GaussianBlur(picture, (3, 3), 0)
    height, width = picture.shape
    kept: list[tuple[np.ndarray, np.ndarray, float]] = []
    for part in (8, 24):
        window = max(15, (min(height, width) // part) | 1)
        for above in (7, -7):
            mask = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, window, above)
            kept += _components(mask)
    kept.sort(key=lambda blob: blob[2])
    centres, shapes = np.zeros((len(kept), 2)), np.zeros((len(kept), 2, 2))
    n = 0
    for centre, shape, _ in kept:
        d = centre - centres[:n]
        if not (np.einsum("ni,nij,nj->n", d, shapes[:n], d) < 0.25).any():
            centres[n], shapes[n] = centre, shape
            n += 1
    darks = [_is_dark(smooth, centre, shape) for centre, shape in zip(centres[:n], shapes[:n], strict=True)]
    return Blobs(centres[:n], shapes[:n], np.array(darks, bool))


def _is_dark(picture: np.ndarray, centre: np.ndarray, shape: np.ndarray) -> bool:
    """Return True if a spot is darker at 0.5 than at 1.5 times its radius."""
    angle = np.arange(16) * np.pi / 8
    to_edge = np.linalg.inv(np.linalg.cholesky(shape)).T @ np.stack([np.cos(angle), np.sin(angle)])
    high, wide = picture.shape
    grey = []
    for part in (0.5, 1.5):
        column, row = np.rint(centre[:, None] + part * to_edge).astype(int)
        grey.append(picture[np.clip(row, 0, high - 1), np.clip(column, 0, wide - 1)].mean())
    return bool(grey[0] < grey[1])


def _components(mask: np.ndarray):
    """Yield centre, Q and misfit of each elliptic connected component of a mask."""
    height, width = mask.shape
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        if len(contour) < 12:
            continue
        left, top, wide, high = cv2.boundingRect(contour)
        if left <= 1 or top <= 1 or left + wide >= width - 1 or top + high >= height - 1 or wide * high < _MIN_AREA:
            continue
        m = cv2.moments(contour)
        if m["m00"] < _MIN_AREA:
            continue
        centre = np.array([m["m10"], m["m01"]]) / m["m00"]
        covariance = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / m["m00"]
        determinant = np.linalg.det(covariance)
        if determinant <= 0 or np.linalg.cond(covariance) > _ELONGATION**2:
            continue
        misfit = abs(4 * np.pi * np.sqrt(determinant) / m["m00"] - 1)
        shape = np.linalg.inv(4 * covariance)
        d = contour.reshape(-1, 2) - centre
        edge = np.abs(np.sqrt(np.einsum("ni,ij,nj->n", d, shape, d)) - 1)
        if misfit < _SHAPE and np.mean(edge) < 2.5 * _SHAPE:
            yield centre, shape, misfit


def fit_discs(picture: np.ndarray, blobs: Blobs) -> TargetPlaces:
    """Measure ellipse centres and their standard deviations, starting from `blobs`."""
    n = len(blobs.column_row)
    if not n:
        return TargetPlaces(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool))
    patches = _rings(picture, blobs)
    _, grey, used = patches
    lower = np.linalg.cholesky(blobs.shape)
    contrast = np.where(blobs.dark, -1.0, 1.0) * _spread(grey, used)
    mean = np.array([np.median(g[u]) for g, u in zip(grey, used, strict=True)]) - contrast / 2
    edge = lower[:, 0, 0], lower[:, 1, 0], lower[:, 1, 1]
    none = np.zeros(n)
    start = np.column_stack([none, none, *edge, np.full(n, np.log(_BLUR)), contrast, mean, none, none])
    fit = fit_patches(_discs, start, patches)
    sigma = np.sqrt(np.einsum("pkk->pk", fit.covariance)[:, :2])
    smaller = 1 / np.sqrt(np.linalg.eigvalsh(blobs.shape)[:, 1])
    moved = np.linalg.norm(fit.parameters[:, :2], axis=1)
    good = fit.fitted & (np.abs(fit.parameters[:, 6]) > 3 * fit.noise) & (sigma < 0.5).all(axis=1)
    good &= moved < np.maximum(_MOVED * smaller, 1.0)
    return TargetPlaces(blobs.column_row + np.where(good[:, None], fit.parameters[:, :2], 0.0), sigma, good)


def _spread(grey, used) -> Float[np.ndarray, "n"]:
    """Return the range of the grey values in each patch (10 % to 90 % quantile)."""
    return np.array([np.subtract(*np.percentile(g[u], [90, 10])) for g, u in zip(grey, used, strict=True)])


def _rings(picture: np.ndarray, blobs: Blobs) -> Patches:
    """Return the pixels near the edge of each ellipse; large ellipses are subsampled."""
    height, width = picture.shape
    places, greys = [], []
    for centre, shape in zip(blobs.column_row, blobs.shape, strict=True):
        reach = np.sqrt(np.diag(np.linalg.inv(shape))) + _RING
        low = np.maximum(np.floor(centre - reach).astype(int), 0)
        high = np.minimum(np.ceil(centre + reach).astype(int) + 1, (width, height))
        whole = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), axis=-1).reshape(-1, 2)
        d = whole - centre
        rho = np.sqrt(np.einsum("ni,ij,nj->n", d, shape, d))
        distance = rho * (rho - 1) / np.maximum(np.linalg.norm(d @ shape, axis=1), 1e-12)
        near = np.flatnonzero(np.abs(distance) < _RING)
        near = near[:: max(1, -(-len(near) // _MOST))]
        places.append(d[near])
        greys.append(picture[whole[near, 1], whole[near, 0]].astype(float))
    longest = max(map(len, places))
    pixels, grey = np.zeros((len(places), longest, 2)), np.zeros((len(places), longest))
    used = np.zeros((len(places), longest), bool)
    for k, (place, values) in enumerate(zip(places, greys, strict=True)):
        pixels[k, : len(place)], grey[k, : len(place)], used[k, : len(place)] = place, values, True
    return Patches(pixels, grey, used)


def _disc(parameters, pixel):
    column, row, l1, l2, l3, blur, contrast, mean, in_column, in_row = parameters
    x, y = pixel[0] - column, pixel[1] - row
    u, v = l1 * x + l2 * y, l3 * y
    # Q d = L (L' d). Adding 1e-12 makes the derivative finite at the centre.
    rho = jnp.sqrt(u * u + v * v + 1e-12)
    slope = jnp.sqrt((l1 * u) ** 2 + (l2 * u + l3 * v) ** 2 + 1e-12)
    distance = rho * (rho - 1) / slope
    width = jnp.sqrt(2 / 12 + jnp.exp(2 * blur))
    return mean + in_column * x + in_row * y + contrast * (1 - jax.scipy.special.erf(distance / width)) / 2


@eqx.filter_jit
def _discs(start: Float[Array, "n 10"], pixels: Float[Array, "n m 2"], grey, used):
    return fits(_disc, start, pixels, grey, used)


# Distance (px) of neighbouring spots in the drawing; maximum side length (px) of the drawing.
_APART_PX, _LONGEST_PX = 60, 6000
# Number of fractional bits of drawn coordinates: with integer coordinates some grids are not detected.
_SHIFT = 4
# Maximum relative difference of the distance of diagonal neighbours; number of neighbours tested per spot.
_OFF_SPACING, _NEAREST = 0.35, 24


class CircleGrid(Pattern):
    """Asymmetric grid of `rows` rows with `columns` circles; rows are `spacing_m` apart, circles in a row twice that.

    Rows and columns are counted as in OpenCV's asymmetric grid (usually 4x11).
    """

    def __init__(self, columns: int, rows: int, spacing_m: float, diameter_m: float) -> None:
        if rows < 3:
            raise ValueError("an asymmetric grid has at least 3 rows")
        if diameter_m >= np.sqrt(2) * spacing_m:
            raise ValueError("the circles touch; the diameter must be less than 1.41 times the spacing")
        self.columns, self.rows, self.radius_m, self._spacing_m = columns, rows, diameter_m / 2, spacing_m
        row, column = np.divmod(np.arange(rows * columns), columns)
        ids = tuple(f"r{r + 1}c{c + 1}" for r, c in zip(row.tolist(), column.tolist(), strict=True))
        xyz = np.stack([(2 * column + row % 2) * spacing_m, -row * spacing_m, 0.0 * row], axis=1)
        self.board = Board("asymmetric circles", ids, xyz, np.full(len(ids), diameter_m))

    def find(self, picture: np.ndarray) -> FoundBoard | None:
        """Detect the circles, row by row; None if the grid is not found. Circles without a clear edge are omitted."""
        blobs = elliptic_blobs(picture)
        for dark in (True, False):
            candidates = self._like_the_grid(blobs.take(blobs.dark == dark))
            if len(candidates.column_row) < len(self.board.points):
                continue
            drawn, scale, corner = _drawing(candidates.column_row)
            for sheet, times, shift in ((drawn, scale, corner), (picture, 1.0, np.zeros(2))):
                for how in (cv2.CALIB_CB_ASYMMETRIC_GRID, cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
                    seen, centres = cv2.findCirclesGrid(sheet, (self.columns, self.rows), flags=how)  # type: ignore[call-overload]
                    grid = self._placed(picture, candidates, centres.reshape(-1, 2) / times + shift) if seen else None
                    if grid is not None:
                        return grid
        return None

    def reflectance(self, xy_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Return the reflectance of black circles on white."""
        black = np.zeros(len(xy_m), bool)
        for centre in self.board.xyz_m[:, :2]:
            black |= np.sum((xy_m - centre) ** 2, axis=1) < self.radius_m**2
        return np.where(black, 0.0, 1.0)

    def _like_the_grid(self, blobs: Blobs) -> Blobs:
        """Select the largest connected set of spots whose distances, in radii, match diagonal neighbours of the grid.

        Distances in units of the ellipses are independent of the view. OpenCV's grid search fails if many other round
        objects are included.
        """
        n = len(blobs.column_row)
        if n < 2:
            return blobs
        near = scipy.spatial.cKDTree(blobs.column_row).query(blobs.column_row, k=min(n, _NEAREST))[1][:, 1:]
        d = blobs.column_row[near] - blobs.column_row[:, None]
        apart = np.sqrt(2) * self._spacing_m / self.radius_m
        good = np.ones(near.shape, bool)
        for shape in (blobs.shape[:, None], blobs.shape[near]):
            good &= np.abs(np.sqrt(np.einsum("nki,nkij,nkj->nk", d, shape, d)) / apart - 1) < _OFF_SPACING
        one, other = np.nonzero(good)
        web = scipy.sparse.csgraph.connected_components(
            scipy.sparse.coo_array((np.ones(len(one)), (one, near[one, other])), shape=(n, n))
        )[1]
        return blobs.take(web == np.bincount(web).argmax())

    def _placed(self, picture: np.ndarray, blobs: Blobs, centres: Float[np.ndarray, "n 2"]) -> FoundBoard | None:
        along, down = centres[self.columns - 1] - centres[0], centres[2 * self.columns] - centres[0]
        if along[0] * down[1] - along[1] * down[0] < 0:
            if self.rows % 2 == 0:
                return None  # a mirror image is impossible
            centres = centres.reshape(self.rows, self.columns, 2)[::-1].reshape(-1, 2)
        which = scipy.spatial.cKDTree(blobs.column_row).query(centres)[1]
        d = centres - blobs.column_row[which]
        # Reject centres outside their ellipse: the circle is occluded or half in shadow.
        same = np.einsum("ni,nij,nj->n", d, blobs.shape[which], d) < 1
        return FoundBoard(np.flatnonzero(same), fit_discs(picture, blobs.take(which[same])))


def _drawing(places: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, float, Float[np.ndarray, "2"]]:
    """Draw spots at `places`; return the image, scale and corner: `drawn = (place - corner) * scale`.

    OpenCV's grid search requires evenly lit, separated spots of sufficient size.
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
