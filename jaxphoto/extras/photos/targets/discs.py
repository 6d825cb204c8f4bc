"""Centres of circles to a part of a pixel: an ellipse fitted to the grey values about its edge by least squares.

    grey = m + g . d + a (1 - erf(e / s)) / 2,   rho = |L' d|,   e = rho (rho - 1) / |L L' d|,   d = pixel - centre

e is the distance from the ellipse rho = 1 to first order. The ten unknowns (centre, the three of L, ln s, a, m, g) are
fitted by `patches`. The centre is that of the ellipse, which is not the image of the circle's centre: see
`jaxphoto.procedures.calibration.eccentricity`.
"""

from typing import NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.extras.photos.targets.corners import TargetPlaces, linearised
from jaxphoto.extras.photos.targets.patches import Patches, fit_patches

# Pixels on both sides of the edge that are looked at, and how many of one target at most.
_RING, _MOST = 4.0, 1024
_BLUR = 1.0
# Area of an ellipse over that of the ellipse with its moments: by how much a blob may differ, its smallest size in
# pixels and how long it may be.
_SHAPE, _LEAST_AREA, _ELONGATION = 0.06, 20, 6.0
# Of its own smaller half axis: how far a fitted centre may be from that of the blob.
_MOVED = 0.5


class Blobs(NamedTuple):
    """Dark or bright spots that have the shape of an ellipse, as OpenCV counts pixels."""

    column_row: Float[np.ndarray, "n 2"]
    shape: Float[np.ndarray, "n 2 2"]
    """Q of the ellipse d' Q d = 1."""
    dark: Bool[np.ndarray, "n"]
    """Whether it is darker than what is around it."""

    def take(self, chosen: np.ndarray) -> "Blobs":
        """The spots that `chosen` (an index or a mask) names."""
        return Blobs(self.column_row[chosen], self.shape[chosen], self.dark[chosen])


def elliptic_blobs(picture: np.ndarray, half_axes: tuple[np.ndarray, float] | None = None) -> Blobs:
    """All elliptic spots of a picture, by adaptive thresholds of several widths; none touches the border.

    Of several about one place the one that is most like an ellipse; of those alone whose `half_axes` (the greater
    first, px) are these up to a factor, where they are given: a bright disc on a dark one is not lost beside it.
    """
    smooth = cv2.GaussianBlur(picture, (3, 3), 0)
    height, width = picture.shape
    kept: list[tuple[np.ndarray, np.ndarray, float]] = []
    for part in (8, 24):
        window = max(15, (min(height, width) // part) | 1)
        for above in (7, -7):
            mask = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY, window, above)
            kept += [blob for blob in _components(mask) if half_axes is None or _of_size(blob[1], *half_axes)]
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


def _of_size(shape: np.ndarray, half_axes: np.ndarray, factor: float) -> bool:
    return bool((np.abs(np.log(half_axes / (1 / np.sqrt(np.linalg.eigvalsh(shape))))) < np.log(factor)).all())


def _is_dark(picture: np.ndarray, centre: np.ndarray, shape: np.ndarray) -> bool:
    """Whether a spot is darker at half its radius than at one and a half."""
    angle = np.arange(16) * np.pi / 8
    to_edge = np.linalg.inv(np.linalg.cholesky(shape)).T @ np.stack([np.cos(angle), np.sin(angle)])
    high, wide = picture.shape
    grey = []
    for part in (0.5, 1.5):
        column, row = np.rint(centre[:, None] + part * to_edge).astype(int)
        grey.append(picture[np.clip(row, 0, high - 1), np.clip(column, 0, wide - 1)].mean())
    return bool(grey[0] < grey[1])


def _components(mask: np.ndarray):
    """Centre, Q and misfit of each connected spot of a mask that is an ellipse."""
    height, width = mask.shape
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        if len(contour) < 12:
            continue
        left, top, wide, high = cv2.boundingRect(contour)
        if left <= 1 or top <= 1 or left + wide >= width - 1 or top + high >= height - 1 or wide * high < _LEAST_AREA:
            continue
        m = cv2.moments(contour)
        if m["m00"] < _LEAST_AREA:
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
    """Centres of ellipses with their standard deviations, from where and what `blobs` says they are about."""
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
    """How much brighter the bright pixels are than the dark ones."""
    return np.array([np.subtract(*np.percentile(g[u], [90, 10])) for g, u in zip(grey, used, strict=True)])


def _rings(picture: np.ndarray, blobs: Blobs) -> Patches:
    """Pixels near the edge of each ellipse, as `windows` gives them: all of them, or every so many of large ones."""
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
    # Q d = L (L' d); the root's derivative at the very centre is not wanted there, where e is far from zero anyway.
    rho = jnp.sqrt(u * u + v * v + 1e-12)
    slope = jnp.sqrt((l1 * u) ** 2 + (l2 * u + l3 * v) ** 2 + 1e-12)
    distance = rho * (rho - 1) / slope
    width = jnp.sqrt(2 / 12 + jnp.exp(2 * blur))
    return mean + in_column * x + in_row * y + contrast * (1 - jax.scipy.special.erf(distance / width)) / 2


@eqx.filter_jit
def _discs(parameters: Float[Array, "n 10"], pixels: Float[Array, "n m 2"]):
    return linearised(_disc)(parameters, pixels)
