"""Corresponding planes of two laser strips: patches of both, in the cells of a common grid.

The plane of a cell minimises the squared distances of its returns: it contains their mean, and its normal is the
eigenvector of the smallest eigenvalue of their scatter. A cell is used if it has enough returns that cover the cell and
are no rougher than a hard surface (no vegetation, no edge). Planes of two strips correspond if their normals agree and
their means are close. Source: Glira, Pfeifer, Briese and Ressl (2015), A correspondence framework for ALS strip
adjustments based on variants of the ICP algorithm; selection, matching and rejection apply to single points there, to
cells here.
"""

import dataclasses
from itertools import combinations
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError


@dataclasses.dataclass(frozen=True)
class StripSettings:
    """Settings of strip planes: cells of `cell_m` with at least `returns` returns, and a roughness of at most
    `roughness_m`.

    `normals_deg`: maximum angle between the normals of two strips. `most`: maximum number of observed planes of all
    pairs of strips. `outlier`: number of standard deviations above which a gap is rejected. `knots_s`: knot spacing of
    the trajectory errors; `sigma_position_m`, `sigma_attitude_deg` (about right and forward), `sigma_heading_deg` and
    the correlation time `correlation_s` describe them (`observations.knot_steps`). Poses of exposures have these errors
    and, independently, `sigma_exposure_m` and `sigma_exposure_deg`.
    """

    cell_m: float = 3.0
    returns: int = 10
    roughness_m: float = 0.06
    least_roughness_m: float = 0.005
    normals_deg: float = 5.0
    outlier: float = 4.0
    most: int = 4000
    knots_s: float = 10.0
    correlation_s: float = 100.0
    sigma_position_m: float = 0.08
    sigma_attitude_deg: float = 0.005
    sigma_heading_deg: float = 0.01
    sigma_exposure_m: float = 0.01
    sigma_exposure_deg: float = 0.002

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value:g}: give a positive number")
        if self.returns < 4 or self.most < 1:
            raise InputError(
                f"returns must be at least 4 and most at least 1, got returns = {self.returns} and most = {self.most}"
            )

    @property
    def sigma_attitude(self) -> np.ndarray:
        """Return the standard deviations about right, forward and up (rad)."""
        return np.deg2rad([self.sigma_attitude_deg, self.sigma_attitude_deg, self.sigma_heading_deg])


class Raster(NamedTuple):
    """Values (m) of square cells, NaN if missing; `west` and `north` (m) are outer edges of cell (0, 0)."""

    heights: Float[np.ndarray, "rows columns"]
    west: float
    north: float
    cell_m: float

    @property
    def extent(self) -> Float[np.ndarray, "2 2"]:
        """Return the minimum and maximum X, Y (m) of the outer edges."""
        rows, columns = self.heights.shape
        east, south = self.west + columns * self.cell_m, self.north - rows * self.cell_m
        return np.array([[self.west, south], [east, self.north]])


def strip_differences(cloud: Cloud, settings: StripSettings) -> Raster | None:
    """Compute the gaps (m) of strips in cells of `settings.cell_m`, NaN without a gap; None if there are no gaps.

    The gap of a cell with planes of two strips is the height of the later plane above the earlier one at their mean
    position; for more than two strips it is the gap of the two that differ most. Rough ground and partly covered cells
    have no plane and no gap, so slopes and trees cause none.
    """
    strips = [cloud.xyz[cloud.strip == k] for k in range(len(cloud.strips))]
    patches = [planes_of(xyz, xyz, np.zeros(len(xyz)), cells_of(xyz, settings), settings) for xyz in strips]
    cell = np.concatenate([p.cell for p in patches])
    if not len(cell):
        return None
    west, south = columns_and_rows(cell).min(axis=1)
    east, north = columns_and_rows(cell).max(axis=1) + 1
    gaps = np.full((north - south, east - west), np.nan)
    for one, other in combinations(patches, 2):
        pairs = corresponding(one, other, settings)
        column, up = columns_and_rows(pairs.cell)
        # The gap is along the normal, earlier above later strip.
        height = -pairs.gap / pairs.normal[:, 2]
        row, column = north - 1 - up, column - west
        larger = ~(np.abs(gaps[row, column]) >= np.abs(height))
        gaps[row[larger], column[larger]] = height[larger]
    if np.isnan(gaps).all():
        return None
    return Raster(gaps, west * settings.cell_m, north * settings.cell_m, settings.cell_m)


def cells_of(xyz: Float[np.ndarray, "n 3"], settings: StripSettings) -> Int[np.ndarray, "n"]:
    """Return the cell of each return in a grid through the origin, independent of the cloud's extent."""
    column, up = np.floor(xyz[:, :2] / settings.cell_m).astype(np.int64).T
    return (column << 32) + up


def columns_and_rows(cell: Int[np.ndarray, "n"]) -> Int[np.ndarray, "2 n"]:
    """Return column and row of cells of `cells_of` relative to the origin."""
    up = ((cell + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
    return np.stack([(cell - up) >> 32, up])


# Moderated variances (empirical Bayes) from few values each.
#
# A variance s^2 estimated with v degrees of freedom may be too small, and its observation then gets too large a weight.
# If true variances follow a scaled inverse chi-squared distribution with v0 degrees of freedom about s0^2, the expected
# variance given s^2 is
#
#     (v0 s0^2 + v s^2) / (v0 + v)
#
# v0 and s0^2 are estimated from mean and variance of log s^2; if it scatters no more than by chance, v0 is infinite,
# and all variances are equal. Source: Smyth (2004), Linear models and empirical Bayes methods for assessing
# differential expression in microarray experiments.

_ROUNDS = 50


def moderated_variances(variance: Float[np.ndarray, "n"], freedom: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the expected variances of positive `variance` with `freedom` degrees of freedom each (one or more)."""
    if len(variance) < 2:
        return variance
    half = freedom / 2
    log = np.log(variance) - scipy.special.digamma(half) + np.log(half)
    scatter = float(np.var(log, ddof=1) - np.mean(scipy.special.polygamma(1, half)))
    if scatter <= 0:
        return np.full(len(variance), np.exp(np.mean(log)))
    # Invert trigamma by Newton's method on 1 / trigamma, nearly linear and convex: monotone convergence.
    prior = 0.5 + 1 / scatter
    for _ in range(_ROUNDS):
        slope = scipy.special.polygamma(1, prior)
        step = float(slope * (1 - slope / scatter) / scipy.special.polygamma(2, prior))
        prior += step
        if abs(step) < 1e-9 * prior:
            break
    common = np.exp(np.mean(log) + scipy.special.digamma(prior) - np.log(prior))
    return (prior * common + half * variance) / (prior + half)


# Minimum spread of a patch along its shorter axis, as a fraction of the cell; a full cell has 0.29.
_SPREAD = 0.15
# Maximum distance of the means of two corresponding patches, as a fraction of the cell.
_CLOSE = 0.3
# Minimum slope (degrees) of planes that determine shifts in X and Y.
_STEEP_DEG = 5.0


class StripPatches(NamedTuple):
    """Planes of one strip, by cell in ascending order."""

    cell: Int[np.ndarray, "n"]
    returns: Int[np.ndarray, "n"]
    mean: Float[np.ndarray, "n 3"]
    """Mean of the returns, corrected (m)."""
    measured: Float[np.ndarray, "n 3"]
    """Mean of the uncorrected returns (m)."""
    time: Float[np.ndarray, "n"]
    """Mean time of the returns (s)."""
    normal: Float[np.ndarray, "n 3"]
    """Unit normals, upwards."""
    roughness: Float[np.ndarray, "n"]
    """Standard deviation of a return from the plane (m), moderated by planes of similar slope."""
    cofactor: Float[np.ndarray, "n 3 3"]
    """Inverse scatter within the plane (1/m^2): cofactor of the plane's tilt for returns of unit variance."""


class PlanePairs(NamedTuple):
    """Pairs of corresponding planes of two strips, and their gaps."""

    a: Int[np.ndarray, "n"]
    """Index into `StripPatches` of the first strip."""
    b: Int[np.ndarray, "n"]
    cell: Int[np.ndarray, "n"]
    foot_a: Float[np.ndarray, "n 3"]
    """Point on a's plane (m), corrected."""
    foot_b: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    gap: Float[np.ndarray, "n"]
    """Height of a's plane above b's, along the normal (m)."""
    sigma: Float[np.ndarray, "n"]
    """Standard deviation of the gap (m), from the roughness of both patches."""


def planes_of(
    xyz: Float[np.ndarray, "n 3"],
    measured: Float[np.ndarray, "n 3"],
    time: Float[np.ndarray, "n"],
    cell: Int[np.ndarray, "n"],
    settings: StripSettings,
) -> StripPatches:
    """Fit the planes of a strip: `xyz` corrected, `measured` uncorrected returns (m), `cell` from `cells_of`."""
    cells, of = np.unique(cell, return_inverse=True)
    count = np.bincount(of, minlength=len(cells))

    def average(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(of, v, len(cells)) for v in values.T], axis=-1) / count[:, None]

    mean = average(xyz)
    offset = xyz - mean[of]
    scatter = np.empty((len(cells), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            scatter[:, i, j] = scatter[:, j, i] = np.bincount(of, offset[:, i] * offset[:, j], len(cells))
    value, axes = np.linalg.eigh(scatter)
    roughness = np.sqrt(np.maximum(value[:, 0], 0.0) / np.maximum(count - 3, 1))
    usable = (
        (count >= settings.returns)
        & (roughness <= settings.roughness_m)
        & (np.sqrt(np.maximum(value[:, 1], 0.0) / count) > _SPREAD * settings.cell_m)
    )
    normal = axes[:, :, 0] * np.where(axes[:, 2, 0] < 0, -1.0, 1.0)[:, None]
    along = axes[usable][:, :, 1:]
    # A roughness below the noise of any scanner is due to chance: limit it.
    variance = np.maximum(roughness[usable], settings.least_roughness_m) ** 2
    # Horizontal errors make steep planes rougher: moderate variances by planes of similar slope.
    above = steep(normal[usable])
    for part in (above, ~above):
        variance[part] = moderated_variances(variance[part], (count[usable] - 3)[part])
    return StripPatches(
        cells[usable], count[usable], mean[usable], average(measured)[usable], average(time[:, None])[usable, 0],
        normal[usable], np.sqrt(variance), np.einsum("nik,nk,njk->nij", along, 1 / value[usable][:, 1:], along),
    )  # fmt: skip


def steep(normal: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return True for planes steep enough to determine shifts in X and Y."""
    return normal[:, 2] < np.cos(np.deg2rad(_STEEP_DEG))


def corresponding(one: StripPatches, other: StripPatches, settings: StripSettings) -> PlanePairs:
    """Match the planes of two strips in common cells."""
    cell, a, b = np.intersect1d(one.cell, other.cell, assume_unique=True, return_indices=True)
    cosine = np.einsum("ni,ni->n", one.normal[a], other.normal[b])
    apart = np.linalg.norm((one.mean[a] - other.mean[b])[:, :2], axis=1)
    similar = (cosine > np.cos(np.deg2rad(settings.normals_deg))) & (apart < _CLOSE * settings.cell_m)
    a, b = a[similar], b[similar]
    weight = (one.returns[a] / (one.returns[a] + other.returns[b]))[:, None]
    place = weight * one.mean[a] + (1 - weight) * other.mean[b]
    normal = weight * one.normal[a] + (1 - weight) * other.normal[b]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    up_a, up_b = (up_to_plane(p, k, place, normal) for p, k in ((one, a), (other, b)))
    variance = variance_of_plane(one, a, place) + variance_of_plane(other, b, place)
    return PlanePairs(
        a, b, cell[similar], place + up_a[:, None] * normal, place + up_b[:, None] * normal, normal, up_a - up_b,
        np.sqrt(variance),
    )  # fmt: skip


def fitting(gap: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"], limit: float) -> np.ndarray:
    """Return True for gaps within `limit` standard deviations of their median, with a robust standard deviation."""
    w = gap / sigma
    middle = np.median(w) if len(w) else 0.0
    # 1.4826 times the median absolute deviation is the standard deviation of normal errors.
    spread = max(1.0, 1.4826 * float(np.median(np.abs(w - middle)))) if len(w) else 1.0
    return np.abs(w - middle) <= limit * spread


def up_to_plane(patches: StripPatches, which: np.ndarray, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the distance of the planes from `place` along the normal."""
    normals = patches.normal[which]
    return np.einsum("ni,ni->n", normals, patches.mean[which] - place) / np.einsum("ni,ni->n", normals, normal)


def variance_of_plane(patches: StripPatches, which: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the variance (m^2) of the planes' heights at `place`."""
    offset = place - patches.mean[which]
    tilt = np.einsum("ni,nij,nj->n", offset, patches.cofactor[which], offset)
    return patches.roughness[which] ** 2 * (1 / patches.returns[which] + tilt)


# Object points on planes fitted to one strip's surrounding returns.
#
# The plane is fitted to the returns in a window of one cell about the point (`planes_of`): at the window's centre
# the plane is most accurate, and curvature has the smallest effect.


class PointsOnPlanes(NamedTuple):
    """Points with a matching plane of a strip, and their distances from it."""

    patch: Int[np.ndarray, "n"]
    """Index into `StripPatches`."""
    point: Int[np.ndarray, "n"]
    """Index into the given points."""
    foot: Float[np.ndarray, "n 3"]
    """Point on the plane (m), corrected."""
    gap: Float[np.ndarray, "n"]
    """Height of the point above the plane, along its normal (m)."""
    sigma: Float[np.ndarray, "n"]
    """Standard deviation (m) of the plane there, from its roughness."""


def returns_about(
    xyz: Float[np.ndarray, "returns 3"], points: Float[np.ndarray, "points 3"], settings: StripSettings
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return pairs (return, point): the returns in the window of each point, one cell wide."""
    half = settings.cell_m / 2
    cell = cells_of(xyz, settings)
    order = np.argsort(cell, kind="stable")
    ordered = cell[order]
    found: list[np.ndarray] = []
    # A window is as wide as a cell: it overlaps only the cells of its four corners.
    for corner in ((-half, -half, 0.0), (-half, half, 0.0), (half, -half, 0.0), (half, half, 0.0)):
        at = cells_of(points + np.array(corner), settings)
        first, last = np.searchsorted(ordered, at, "left"), np.searchsorted(ordered, at, "right")
        count = last - first
        point = np.repeat(np.arange(len(points)), count)
        index = order[np.arange(len(point)) + np.repeat(first - (np.cumsum(count) - count), count)]
        inside = (np.abs(xyz[index, :2] - points[point, :2]) < half).all(axis=1)
        found.append(np.stack([index[inside], point[inside]]))
    index, point = np.concatenate(found, axis=1)
    return index, point


def on_planes(patches: StripPatches, points: Float[np.ndarray, "points 3"]) -> PointsOnPlanes:
    """Match points with planes of a strip; `patches.cell` is the index of the point."""
    patch, place = np.arange(len(patches.cell)), points[patches.cell]
    up = up_to_plane(patches, patch, place, patches.normal)
    sigma = np.sqrt(variance_of_plane(patches, patch, place))
    return PointsOnPlanes(patch, patches.cell, place + up[:, None] * patches.normal, -up, sigma)
