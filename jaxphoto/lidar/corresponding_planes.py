"""Corresponding planes of two laser strips: patches of both, cell by cell of one grid.

The plane of a cell is that of least squared distances from its returns: through their mean, the normal the eigenvector
of the least eigenvalue of their scatter. Cells are kept where the returns are many, spread over the cell and no rougher
than a hard surface is (no vegetation, no edge); planes of two strips correspond where their normals agree and their
means lie close. All sums are made in one pass over the returns (`cell_returns`).
Source: Glira, Pfeifer, Briese and Ressl (2015), A correspondence framework for ALS strip adjustments based on variants
of the ICP algorithm: selection, matching and rejection there are of single points, of cells here.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.lidar.cell_returns import CellReturns, gathered
from jaxphoto.lidar.moderated_variances import moderated_variances
from jaxphoto.lidar.strip_settings import StripSettings

# Spread of a patch along the shorter of its axes, as a part of the cell; a full cell has 0.29.
_SPREAD = 0.15
# Means of two patches that lie closer, as a part of the cell, are of one place.
_CLOSE = 0.3
# Planes steeper than this (degrees) are what tells shifts in X and Y.
_STEEP_DEG = 5.0


class StripPatches(NamedTuple):
    """The planes of one strip, by cell in ascending order."""

    cell: Int[np.ndarray, "n"]
    returns: Int[np.ndarray, "n"]
    mean: Float[np.ndarray, "n 3"]
    """Of the returns, corrected (m)."""
    measured: Float[np.ndarray, "n 3"]
    """The same of the returns as measured."""
    time: Float[np.ndarray, "n"]
    """Mean time of the returns (s)."""
    normal: Float[np.ndarray, "n 3"]
    """Unit vectors, upwards."""
    roughness: Float[np.ndarray, "n"]
    """Standard deviation of a return from the plane (m), drawn towards that of other planes as steep or as flat."""
    cofactor: Float[np.ndarray, "n 3 3"]
    """Inverse scatter within the plane (1/m^2): what the tilt of the plane is off by for returns that are off by 1."""


class PlanePairs(NamedTuple):
    """Places that two strips have planes at, and how far these are apart."""

    a: Int[np.ndarray, "n"]
    """StripPatches of the one strip."""
    b: Int[np.ndarray, "n"]
    cell: Int[np.ndarray, "n"]
    foot_a: Float[np.ndarray, "n 3"]
    """The place on a's plane (m), corrected."""
    foot_b: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    gap: Float[np.ndarray, "n"]
    """By how much a's plane lies above b's, along the normal (m)."""
    sigma: Float[np.ndarray, "n"]
    """Of the gap (m), by the roughness of both patches."""


def planes_of(
    xyz: Float[np.ndarray, "n 3"],
    measured: Float[np.ndarray, "n 3"],
    time: Float[np.ndarray, "n"],
    cell: Int[np.ndarray, "n"],
    settings: StripSettings,
) -> StripPatches:
    """The planes of a strip's returns `xyz` (m), corrected; `measured` is where they were, `cell` as of `cells_of`."""
    return planes_from(gathered(xyz, measured, time, cell), settings)


def planes_from(cells: CellReturns, settings: StripSettings) -> StripPatches:
    """The planes of a strip's returns, gathered cell by cell."""
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
    # A patch that is smoother than any scanner is one by chance.
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
    """Which planes are steep enough to tell shifts in X and Y."""
    return normal[:, 2] < np.cos(np.deg2rad(_STEEP_DEG))


def _moderated(
    variance: Float[np.ndarray, "n"], freedom: Int[np.ndarray, "n"], normal: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Variances drawn towards those of the planes alike: errors in X and Y make steep ones rougher than flat ones."""
    result, above = variance.copy(), steep(normal)
    for own in (above, ~above):
        result[own] = moderated_variances(variance[own], freedom[own])
    return result


def corresponding(one: StripPatches, other: StripPatches, settings: StripSettings) -> PlanePairs:
    """The planes that both strips have, robust against what is no plane of both but for the blunders of `outliers`."""
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
    """Which gaps lie within `limit` standard deviations of their median, by the spread that the middle half has."""
    w = gap / sigma
    middle = np.median(w) if len(w) else 0.0
    # 1.4826 of the median deviation is the standard deviation of normal errors.
    spread = max(1.0, 1.4826 * float(np.median(np.abs(w - middle)))) if len(w) else 1.0
    return np.abs(w - middle) <= limit * spread


def up_to_plane(patches: StripPatches, which: np.ndarray, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """How far along the normal the planes lie from places."""
    own = patches.normal[which]
    return np.einsum("ni,ni->n", own, patches.mean[which] - place) / np.einsum("ni,ni->n", own, normal)


def variance_of_plane(patches: StripPatches, which: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Of the heights of the planes at places (m^2)."""
    off = place - patches.mean[which]
    tilt = np.einsum("ni,nij,nj->n", off, patches.cofactor[which], off)
    return patches.roughness[which] ** 2 * (1 / patches.returns[which] + tilt)
