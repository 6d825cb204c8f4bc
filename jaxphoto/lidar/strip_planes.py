"""Corresponding planes of two laser strips: patches of both, in the cells of a common grid.

The plane of a cell minimises the squared distances of its returns: through their mean, with the eigenvector of the
smallest eigenvalue of their scatter as normal. A cell is used if its returns are numerous, cover the cell and are no
rougher than a hard surface (no vegetation, no edge); planes of two strips correspond if their normals agree and their
means are close. All sums are accumulated in one pass over the returns (`cell_returns`). Source: Glira, Pfeifer, Briese
and Ressl (2015), A correspondence framework for ALS strip adjustments based on variants of the ICP algorithm;
selection, matching and rejection apply to single points there, to cells here.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxphoto.errors import InputError

_POSITIVE = (
    "cell_m", "roughness_m", "least_roughness_m", "normals_deg", "outlier", "knots_s", "correlation_s",
    "sigma_position_m", "sigma_attitude_deg", "sigma_heading_deg", "sigma_exposure_m", "sigma_exposure_deg",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class StripSettings:
    """Planes are fitted in cells of `cell_m` with at least `returns` returns, and a roughness of at most `roughness_m`.

    Normals of two strips agree to `normals_deg`; at most `most` planes of all pairs of strips together are observed. A
    gap of more than `outlier` standard deviations is rejected. The trajectory's knots are `knots_s` apart; its errors
    have `sigma_position_m`, `sigma_attitude_deg` (about right and forward) and `sigma_heading_deg`, and the correlation
    time `correlation_s` (`observations.knot_steps`). Poses of exposures have these errors and, independently,
    `sigma_exposure_m` and `sigma_exposure_deg`.
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
        for name in _POSITIVE:
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value:g}: give a positive number")
        if self.returns < 4 or self.most < 1:
            raise InputError(
                f"a plane needs 4 returns and an adjustment 1 plane, got returns {self.returns} and most {self.most}"
            )

    @property
    def sigma_attitude(self) -> np.ndarray:
        """About right, forward and up (rad)."""
        return np.deg2rad([self.sigma_attitude_deg, self.sigma_attitude_deg, self.sigma_heading_deg])


# Returns of a strip by grid cell: number, mean and scatter, which can be accumulated in parts.
#
# For parts of a cell with numbers n, means m and scatters S about them, the total has the common mean, and S = sum (S_k
# + n_k (m_k - m) (m_k - m)'): no digits are lost to squares of coordinates. Source: Chan, Golub and LeVeque (1979),
# Updating formulae and a pairwise algorithm for computing sample variances.

# Number of parts after which they are merged: a compromise between memory and time.
_PARTS = 8


class CellReturns(NamedTuple):
    """Sums from which the planes of a strip follow, by cell in ascending order."""

    cell: Int[np.ndarray, "n"]
    returns: Int[np.ndarray, "n"]
    mean: Float[np.ndarray, "n 3"]
    """Mean of the returns (m)."""
    measured: Float[np.ndarray, "n 3"]
    """Mean of the returns as measured."""
    time: Float[np.ndarray, "n"]
    """Mean time of the returns (s)."""
    scatter: Float[np.ndarray, "n 3 3"]
    """Sum of squares and products of the returns about their mean (m^2)."""


def cells_of(xyz: Float[np.ndarray, "n 3"], settings: StripSettings) -> Int[np.ndarray, "n"]:
    """Return the cell of each return in a grid through the origin, independent of the part of the cloud."""
    column, up = np.floor(xyz[:, :2] / settings.cell_m).astype(np.int64).T
    return (column << 32) + up


def columns_and_rows(cell: Int[np.ndarray, "n"]) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return column and row of cells of `cells_of` relative to the origin."""
    up = ((cell + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
    return (cell - up) >> 32, up


def gathered(
    xyz: Float[np.ndarray, "n 3"],
    measured: Float[np.ndarray, "n 3"],
    time: Float[np.ndarray, "n"],
    cell: Int[np.ndarray, "n"],
) -> CellReturns:
    """Accumulate returns `xyz` (m), corrected, by cell; `measured` are the original ones, `time` (s) their times."""
    cells, of = np.unique(cell, return_inverse=True)
    return _together(cells, of, np.ones(len(of), int), xyz, measured, time, None)


def joined(parts: Sequence[CellReturns]) -> CellReturns:
    """Merge the cells of parts of one strip."""
    columns = (np.concatenate(of_parts) for of_parts in zip(*parts, strict=True))
    cell, count, mean, measured, time, scatter = columns
    cells, of = np.unique(cell, return_inverse=True)
    return _together(cells, of, count, mean, measured, time, scatter)


def _together(
    cells: Int[np.ndarray, "cells"],
    of: Int[np.ndarray, "n"],
    count: Int[np.ndarray, "n"],
    mean: Float[np.ndarray, "n 3"],
    measured: Float[np.ndarray, "n 3"],
    time: Float[np.ndarray, "n"],
    scatter: Float[np.ndarray, "n 3 3"] | None,
) -> CellReturns:
    """Merge means of `count` returns each, and their scatters (None: single returns), of the cells `cells[of]`."""
    total = np.bincount(of, count, len(cells))

    def average(values: np.ndarray) -> np.ndarray:
        return np.bincount(of, count * values, len(cells)) / total

    middle = np.column_stack([average(v) for v in mean.T])
    before = middle if measured is mean else np.column_stack([average(v) for v in measured.T])
    offset = mean - middle[of]
    result = np.empty((len(cells), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            product = count * (offset[:, i] * offset[:, j])
            product = product if scatter is None else product + scatter[:, i, j]
            result[:, i, j] = result[:, j, i] = np.bincount(of, product, len(cells))
    return CellReturns(cells, total.astype(int), middle, before, average(time), result)


class CellTally:
    """Accumulated cells of several strips; the returns themselves are not stored."""

    def __init__(self, settings: StripSettings) -> None:
        self.settings = settings
        self._parts: dict[str, list[CellReturns]] = {}

    def add(self, key: str, xyz: Float[np.ndarray, "n 3"]) -> None:
        """Add returns (m) of the strip `key`."""
        parts = self._parts.setdefault(key, [])
        parts.append(gathered(xyz, xyz, np.zeros(len(xyz)), cells_of(xyz, self.settings)))
        if len(parts) > _PARTS:
            parts[:] = [joined(parts)]

    @property
    def strips(self) -> dict[str, CellReturns]:
        """Return the cells of each strip, in order of arrival."""
        return {key: joined(parts) for key, parts in self._parts.items()}


# Moderated variances (empirical Bayes) from few values each.
#
# With v degrees of freedom a variance s^2 is too small as often as too large, and as weights the small ones count most.
# If true variances follow a scaled inverse chi-squared distribution with v0 degrees of freedom about s0^2, the expected
# one given s^2 is
#
#     (v0 s0^2 + v s^2) / (v0 + v)
#
# v0 and s0^2 follow from mean and variance of log s^2 over all; if these scatter no more than by chance, v0 is
# infinite, and all variances are equal. Source: Smyth (2004), Linear models and empirical Bayes methods for assessing
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
    prior = _inverse_trigamma(scatter)
    common = np.exp(np.mean(log) + scipy.special.digamma(prior) - np.log(prior))
    return (prior * common + half * variance) / (prior + half)


def _inverse_trigamma(value: float) -> float:
    """Newton's method on 1 / trigamma, which is nearly linear and convex: it converges from one side."""
    x = 0.5 + 1 / value
    for _ in range(_ROUNDS):
        slope = scipy.special.polygamma(1, x)
        step = float(slope * (1 - slope / value) / scipy.special.polygamma(2, x))
        x += step
        if abs(step) < 1e-9 * x:
            break
    return x


# Minimum spread of a patch along the shorter of its axes, as a fraction of the cell; a full cell has 0.29.
_SPREAD = 0.15
# Maximum distance of the means of two corresponding patches, as a fraction of the cell.
_CLOSE = 0.3
# Planes steeper than this (degrees) determine shifts in X and Y.
_STEEP_DEG = 5.0


class StripPatches(NamedTuple):
    """Planes of one strip, by cell in ascending order."""

    cell: Int[np.ndarray, "n"]
    returns: Int[np.ndarray, "n"]
    mean: Float[np.ndarray, "n 3"]
    """Mean of the returns, corrected (m)."""
    measured: Float[np.ndarray, "n 3"]
    """Mean of the returns as measured."""
    time: Float[np.ndarray, "n"]
    """Mean time of the returns (s)."""
    normal: Float[np.ndarray, "n 3"]
    """Unit vectors, upwards."""
    roughness: Float[np.ndarray, "n"]
    """Standard deviation of a return from the plane (m), moderated by that of other planes of similar slope."""
    cofactor: Float[np.ndarray, "n 3 3"]
    """Inverse scatter within the plane (1/m^2): cofactor of the plane's tilt for returns of unit variance."""


class PlanePairs(NamedTuple):
    """Pairs of corresponding planes of two strips, and their gaps."""

    a: Int[np.ndarray, "n"]
    """Indices of `StripPatches` of the first strip."""
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
    """Fit the planes of a strip's returns `xyz` (m), corrected; `measured` are the original ones, `cell` from
    `cells_of`.
    """
    return planes_from(gathered(xyz, measured, time, cell), settings)


def planes_from(cells: CellReturns, settings: StripSettings) -> StripPatches:
    """Fit the planes of a strip from sums by cell."""
    count = cells.returns
    value, axes = np.linalg.eigh(cells.scatter)
    roughness = np.sqrt(np.maximum(value[:, 0], 0.0) / np.maximum(count - 3, 1))
    usable = (
        (count >= settings.returns)
        & (roughness <= settings.roughness_m)
        & (np.sqrt(np.maximum(value[:, 1], 0.0) / count) > _SPREAD * settings.cell_m)
    )
    normal = axes[:, :, 0] * np.where(axes[:, 2, 0] < 0, -1.0, 1.0)[:, None]
    along = axes[usable][:, :, 1:]
    # A patch smoother than any scanner is so by chance.
    variance = np.maximum(roughness[usable], settings.least_roughness_m) ** 2
    return StripPatches(
        cells.cell[usable], count[usable], cells.mean[usable], cells.measured[usable], cells.time[usable],
        normal[usable], np.sqrt(_moderated(variance, count[usable] - 3, normal[usable])),
        np.einsum("nik,nk,njk->nij", along, 1 / value[usable][:, 1:], along),
    )  # fmt: skip


def steep(normal: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return True for planes steep enough to determine shifts in X and Y."""
    return normal[:, 2] < np.cos(np.deg2rad(_STEEP_DEG))


def _moderated(
    variance: Float[np.ndarray, "n"], freedom: Int[np.ndarray, "n"], normal: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Moderate variances by planes of similar slope: errors in X and Y make steep ones rougher than flat ones."""
    result, above = variance.copy(), steep(normal)
    for part in (above, ~above):
        result[part] = moderated_variances(variance[part], freedom[part])
    return result


def corresponding(one: StripPatches, other: StripPatches, settings: StripSettings) -> PlanePairs:
    """Match the planes of both strips, and reject `outliers` robustly."""
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
    """Return True for gaps within `limit` standard deviations of their median, estimated from the middle half."""
    w = gap / sigma
    middle = np.median(w) if len(w) else 0.0
    # 1.4826 times the median absolute deviation is the standard deviation of normal errors.
    spread = max(1.0, 1.4826 * float(np.median(np.abs(w - middle)))) if len(w) else 1.0
    return np.abs(w - middle) <= limit * spread


def up_to_plane(patches: StripPatches, which: np.ndarray, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the distance of the planes from places along the normal."""
    normals = patches.normal[which]
    return np.einsum("ni,ni->n", normals, patches.mean[which] - place) / np.einsum("ni,ni->n", normals, normal)


def variance_of_plane(patches: StripPatches, which: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the variance of the heights of the planes at places (m^2)."""
    offset = place - patches.mean[which]
    tilt = np.einsum("ni,nij,nj->n", offset, patches.cofactor[which], offset)
    return patches.roughness[which] ** 2 * (1 / patches.returns[which] + tilt)


# Object points on planes fitted to one strip's surrounding returns.
#
# The plane of a point is that of the returns in a window of one cell about it (`planes_of`), so
# the point is at its centre, where a plane is best determined and curvature has the least effect.


class PointsOnPlanes(NamedTuple):
    """Points with a plane of a strip, and their distances from it."""

    patch: Int[np.ndarray, "n"]
    """Index of `StripPatches`."""
    point: Int[np.ndarray, "n"]
    """Index of the given points."""
    foot: Float[np.ndarray, "n 3"]
    """Point on the plane (m), corrected."""
    gap: Float[np.ndarray, "n"]
    """Height of the point above the plane, along its normal (m)."""
    sigma: Float[np.ndarray, "n"]
    """Of the plane there (m), from its roughness."""


def returns_about(
    xyz: Float[np.ndarray, "returns 3"], points: Float[np.ndarray, "points 3"], settings: StripSettings
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return the returns in the window of each point, one cell wide, and the point of each."""
    half = settings.cell_m / 2
    cell = cells_of(xyz, settings)
    order = np.argsort(cell, kind="stable")
    ordered = cell[order]
    found: list[np.ndarray] = []
    # A window is as wide as a cell: it overlaps the cells of its four corners, and no others.
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


def windows_of_returns(index: Int[np.ndarray, "n"], point: Int[np.ndarray, "n"]) -> Float[np.ndarray, "points"]:
    """Return the mean number of windows, from `returns_about`, that a return about each point belongs to.

    Variances of planes times this number count the returns of close points once.
    """
    often = np.bincount(index)[index]
    return np.bincount(point, often) / np.maximum(np.bincount(point), 1)


def on_planes(patches: StripPatches, points: Float[np.ndarray, "points 3"]) -> PointsOnPlanes:
    """Match points with planes of a strip; the cells of `patches` are the indices of the points."""
    patch, place = np.arange(len(patches.cell)), points[patches.cell]
    up = up_to_plane(patches, patch, place, patches.normal)
    sigma = np.sqrt(variance_of_plane(patches, patch, place))
    return PointsOnPlanes(patch, patches.cell, place + up[:, None] * patches.normal, -up, sigma)


# Object points on breaklines: two smooth faces of a strip that intersect, such as those of a roof in its ridge.
#
# The returns in a window of two cells about a point are divided by a straight line, of any direction, that minimises
# the residuals of two planes; then by the intersection of these planes, until it does not change. Each face is a plane
# on which the point lies: both together leave it free only along the line. Source: Habib, Ghanma, Morgan and Al-Ruzouq
# (2005), Photogrammetric and lidar data registration using linear features, where roofs give the lines of the lidar as
# well.

# Number of directions of the line that are tried, and of iterations.
_DIRECTIONS = np.pi * np.arange(12) / 12
_TURNS = 10
# Planes whose slopes differ by less (a tangent) form no breakline.
_BREAK = 0.15
# As fractions of the cell: returns this close to the line may be of either face; a line farther from the point is
# another one.
_NEAR, _FAR = 0.1, 0.5
# Returns beyond this number of robust standard deviations from their face belong to another object, such as a chimney.
_OTHER = 4.0


def faces_about(
    xyz: Float[np.ndarray, "returns 3"], points: Float[np.ndarray, "points 3"], settings: StripSettings
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Return the returns of the two faces about each point, and their faces: 2 k and 2 k + 1 are those of point k.

    A point without two such faces has none.
    """
    index, point = returns_about(xyz, points, dataclasses.replace(settings, cell_m=2 * settings.cell_m))
    parts = [np.zeros((2, 0), int)]
    for k in np.flatnonzero(np.bincount(point, minlength=len(points)) >= 2 * settings.returns):
        candidates = index[point == k]
        side = _sides(xyz[candidates] - points[k], settings)
        parts.append(np.stack([candidates, 2 * k + side])[:, side >= 0])
    index, face = np.concatenate(parts, axis=1)
    return index, face


def _sides(offset: Float[np.ndarray, "n 3"], settings: StripSettings) -> Int[np.ndarray, "n"]:
    """Return 0 and 1 for the returns of either face about the origin; -1 for neither."""
    none = np.full(len(offset), -1)
    tried = [offset[:, :2] @ np.array([np.cos(a), np.sin(a)]) > 0 for a in _DIRECTIONS]
    tried = [first for first in tried if _enough(first, settings)]
    if not tried:
        return none
    first = min(tried, key=lambda one: float(np.sum(np.square(_fitted(offset, one)[1]))))
    for _ in range(_TURNS):
        planes, residual = _fitted(offset, first)
        constant, slope = planes[0, 0] - planes[1, 0], planes[0, 1:] - planes[1, 1:]
        size = float(np.linalg.norm(slope))
        if size < _BREAK or abs(constant) / size > _FAR * settings.cell_m:
            return none
        beyond = (constant + offset[:, :2] @ slope) / size
        parted = beyond > 0
        # A ridge is the lower of its planes on either side, a valley the higher.
        parted = parted if np.mean(parted == first) > 0.5 else ~parted
        if not _enough(parted, settings):
            return none
        if np.array_equal(parted, first):
            break
        first = parted
    spread = 1.4826 * float(np.median(np.abs(residual)))
    clear = (np.abs(beyond) > _NEAR * settings.cell_m) & (np.abs(residual) <= _OTHER * spread)
    return np.where(clear, np.where(first, 0, 1), -1)


def _enough(first: np.ndarray, settings: StripSettings) -> bool:
    return settings.returns <= int(first.sum()) <= len(first) - settings.returns


def _fitted(offset: Float[np.ndarray, "n 3"], first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return height at the origin and slopes of the planes of both sides, and the residual of each return."""
    rows, residual, planes = np.column_stack([np.ones(len(offset)), offset[:, :2]]), np.empty(len(offset)), []
    for side in (first, ~first):
        planes.append(np.linalg.lstsq(rows[side], offset[side, 2])[0])
        residual[side] = offset[side, 2] - rows[side] @ planes[-1]
    return np.stack(planes), residual
