"""Corresponding planes of two laser strips: patches of both, in the cells of a common grid.

The plane of a cell minimises the squared distances of its returns: through their mean, with the eigenvector of the
smallest eigenvalue of their scatter as normal. A cell is used if its returns are numerous, cover the cell and are no
rougher than a hard surface (no vegetation, no edge); planes of two strips correspond if their normals agree and their
means are close. All sums are accumulated in one pass over the returns (`cell_returns`). Source: Glira, Pfeifer, Briese
and Ressl (2015), A correspondence framework for ALS strip adjustments based on variants of the ICP algorithm;
selection, matching and rejection apply to single points there, to cells here.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.lidar.cell_returns import CellReturns, gathered
from jaxphoto.lidar.moderated_variances import moderated_variances
from jaxphoto.lidar.strip_settings import StripSettings

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
    kept = (
        (count >= settings.returns)
        & (roughness <= settings.roughness_m)
        & (np.sqrt(np.maximum(value[:, 1], 0.0) / count) > _SPREAD * settings.cell_m)
    )
    normal = axes[:, :, 0] * np.where(axes[:, 2, 0] < 0, -1.0, 1.0)[:, None]
    along = axes[kept][:, :, 1:]
    # A patch smoother than any scanner is so by chance.
    variance = np.maximum(roughness[kept], settings.least_roughness_m) ** 2
    return StripPatches(
        cells.cell[kept],
        count[kept],
        cells.mean[kept],
        cells.measured[kept],
        cells.time[kept],
        normal[kept],
        np.sqrt(_moderated(variance, count[kept] - 3, normal[kept])),
        np.einsum("nik,nk,njk->nij", along, 1 / value[kept][:, 1:], along),
    )


def steep(normal: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return True for planes steep enough to determine shifts in X and Y."""
    return normal[:, 2] < np.cos(np.deg2rad(_STEEP_DEG))


def _moderated(
    variance: Float[np.ndarray, "n"], freedom: Int[np.ndarray, "n"], normal: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Moderate variances by planes of similar slope: errors in X and Y make steep ones rougher than flat ones."""
    result, above = variance.copy(), steep(normal)
    for own in (above, ~above):
        result[own] = moderated_variances(variance[own], freedom[own])
    return result


def corresponding(one: StripPatches, other: StripPatches, settings: StripSettings) -> PlanePairs:
    """Match the planes of both strips, and reject `outliers` robustly."""
    cell, a, b = np.intersect1d(one.cell, other.cell, assume_unique=True, return_indices=True)
    cosine = np.einsum("ni,ni->n", one.normal[a], other.normal[b])
    apart = np.linalg.norm((one.mean[a] - other.mean[b])[:, :2], axis=1)
    alike = (cosine > np.cos(np.deg2rad(settings.normals_deg))) & (apart < _CLOSE * settings.cell_m)
    a, b = a[alike], b[alike]
    weight = (one.returns[a] / (one.returns[a] + other.returns[b]))[:, None]
    place = weight * one.mean[a] + (1 - weight) * other.mean[b]
    normal = weight * one.normal[a] + (1 - weight) * other.normal[b]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    up_a, up_b = (up_to_plane(p, k, place, normal) for p, k in ((one, a), (other, b)))
    variance = variance_of_plane(one, a, place) + variance_of_plane(other, b, place)
    return PlanePairs(
        a,
        b,
        cell[alike],
        place + up_a[:, None] * normal,
        place + up_b[:, None] * normal,
        normal,
        up_a - up_b,
        np.sqrt(variance),
    )


def fitting(gap: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"], limit: float) -> np.ndarray:
    """Return True for gaps within `limit` standard deviations of their median, estimated from the middle half."""
    w = gap / sigma
    middle = np.median(w) if len(w) else 0.0
    # 1.4826 times the median absolute deviation is the standard deviation of normal errors.
    spread = max(1.0, 1.4826 * float(np.median(np.abs(w - middle)))) if len(w) else 1.0
    return np.abs(w - middle) <= limit * spread


def up_to_plane(patches: StripPatches, which: np.ndarray, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the distance of the planes from places along the normal."""
    own = patches.normal[which]
    return np.einsum("ni,ni->n", own, patches.mean[which] - place) / np.einsum("ni,ni->n", own, normal)


def variance_of_plane(patches: StripPatches, which: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the variance of the heights of the planes at places (m^2)."""
    off = place - patches.mean[which]
    tilt = np.einsum("ni,nij,nj->n", off, patches.cofactor[which], off)
    return patches.roughness[which] ** 2 * (1 / patches.returns[which] + tilt)
