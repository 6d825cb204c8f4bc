"""Geometry of an adjusted block: ground coverage, format coverage, links between images, intersection angles.

Ground coverage: a ground cell, at the height of the nearest object points, is covered if it projects into the format of
an image (a polygon of directions). Occlusions by trees and buildings between points are ignored.

Links: images are nodes, and the number of common points is the weight of an edge. In the maximum spanning tree the path
between any two images has the largest possible minimum weight. Its edges of smallest weight are the weakest links of
the block.
"""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.camera.picture_size import Mismatch, size_mismatch
from jaxphoto.compiling import call_compiled
from jaxphoto.stability import as_arrays

# Number of vertices per side of the format polygon.
_SIDE = 8
# Number of ground cells along the longer side of the block.
_CELLS = 120
# Number of nearest object points whose median height is the height of a cell.
_NEIGHBOURS = 5
# Minimum number of images of a camera whose format is compared with their image points.
_IMAGES = 3
# Margin of the coverage map around points and stations, as a fraction of the flying height.
_MARGIN = 0.5


class Coverage(NamedTuple):
    """Ground coverage of a block."""

    height_m: Float[np.ndarray, "images"]
    """Height of each projection centre above its object points (median, m)."""
    gsd_m: Float[np.ndarray, "images"]
    """Ground sample distance along the optical axis (m)."""
    x: Float[np.ndarray, "columns"]
    """X of the cell centres (m)."""
    y: Float[np.ndarray, "rows"]
    """Y of the cell centres (m)."""
    seen_by: Int[np.ndarray, "rows columns"]
    """Number of images that cover each cell."""
    step_m: float
    """Side of a cell (m)."""

    def area_m2(self, least: int) -> float:
        """Return the area covered by at least `least` images (m^2)."""
        return float((self.seen_by >= least).sum() * self.step_m**2)


def coverage(adjusted: Adjustment) -> Coverage:
    """Compute the ground coverage of an adjusted block. Z of the object frame must be up."""
    s, block = adjusted.structure, adjusted.block
    position = np.asarray(adjusted.unknowns.exterior.position)
    rotation = np.asarray(adjusted.unknowns.exterior.camera_from_object)
    points = np.asarray(adjusted.unknowns.points)
    ray = points[s.point] - position[s.image]
    depth = -np.einsum("nk,nk->n", rotation[s.image][:, 2], ray)
    order = np.argsort(s.image, kind="stable")
    first = np.searchsorted(s.image[order], np.arange(len(position) + 1))
    parts = [order[a:b] for a, b in itertools.pairwise(first)]
    median = lambda v: np.array([np.median(v[part]) if len(part) else np.nan for part in parts])  # noqa: E731
    height, depth = median(-ray[:, 2]), median(depth)
    angle = {
        name: block.sensors[name].pixel_mm / float(interior.c) for name, interior in adjusted.unknowns.interior.items()
    }
    gsd = depth * np.array([angle[name] for name in block.image_camera])
    x, y, ground, step = _cells(points, position, _MARGIN * float(np.nanmedian(height)))
    count = np.zeros((len(y), len(x)), int)
    for name, interior in adjusted.unknowns.interior.items():
        polygon = _format(interior, block.sensors[name])
        for image in np.flatnonzero(np.array(block.image_camera) == name):
            in_camera = (ground - position[image]) @ rotation[image].T
            in_front = in_camera[..., 2] < 0
            tangents = in_camera[..., :2] / np.where(in_front, -in_camera[..., 2], 1.0)[..., None]
            count += in_front & _inside(tangents, polygon)
    return Coverage(height, gsd, x, y, count, step)


def _cells(points: np.ndarray, position: np.ndarray, margin: float):
    """Return X and Y of the cell centres, the cells as object points and their side (m).

    The grid covers the stations and the points without outliers.
    """
    low, high = np.percentile(points, [1, 99], axis=0)
    low = np.minimum(low[:2], position[:, :2].min(axis=0)) - margin
    high = np.maximum(high[:2], position[:, :2].max(axis=0)) + margin
    step = float((high - low).max()) / _CELLS
    x, y = (np.arange(a + step / 2, b + step / 2, step) for a, b in zip(low, high, strict=True))
    plan = np.stack(np.meshgrid(x, y), axis=-1)
    _, near = scipy.spatial.cKDTree(points[:, :2]).query(plan.reshape(-1, 2), k=min(_NEIGHBOURS, len(points)))
    z = np.median(points[near.reshape(len(near), -1), 2], axis=1)
    return x, y, np.dstack([plan, z.reshape(plan.shape[:2])]), step


def _format(interior: InteriorOrientation, sensor: Sensor) -> Float[np.ndarray, "corners 2"]:
    """Return the outline of the format as tangents of the angles from the optical axis, to the right and up."""
    side = np.arange(_SIDE) / _SIDE * 2 - 1
    ones = np.ones(_SIDE)
    edge = np.concatenate([np.stack(v, axis=1) for v in ((side, -ones), (ones, side), (-side, ones), (-ones, -side))])
    corners = edge * [sensor.width_mm / 2, sensor.height_mm / 2]
    return np.asarray(call_compiled(_tangents, as_arrays(interior), corners))


@eqx.filter_jit
def _tangents(interior: InteriorOrientation, xy: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    def tangent(point):
        u, v, w = interior.direction_from_ideal(interior.ideal_from_measured(point))
        return jnp.stack([u, v]) / -w

    return jax.vmap(tangent)(xy)


def _inside(at: Float[np.ndarray, "rows columns 2"], polygon: Float[np.ndarray, "corners 2"]) -> np.ndarray:
    """Return a mask, True for points inside a polygon (even-odd rule)."""
    x, y = at[..., 0], at[..., 1]
    odd = np.zeros(x.shape, bool)
    for (x1, y1), (x2, y2) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y1 != y2:
            odd ^= ((y1 > y) != (y2 > y)) & (x < (x2 - x1) * (y - y1) / (y2 - y1) + x1)
    return odd


class FormatCoverage(NamedTuple):
    """Fraction of the format covered by the convex hull of image points."""

    whole: float
    """Fraction covered by the points of all images together."""
    images: Float[np.ndarray, "images"]
    """Fraction covered by the points of each image; images without points are omitted."""


def format_coverage(adjusted: Adjustment, camera: str) -> FormatCoverage:
    """Compute the format coverage of one camera: zero for collinear points and for fewer than three points."""
    s, sensor = adjusted.structure, adjusted.block.sensors[camera]
    rows = np.array([c == camera for c in adjusted.block.image_camera])[s.image]
    xy, image = np.asarray(adjusted.values.xy).T[rows], s.image[rows]
    area = sensor.width_mm * sensor.height_mm
    order = np.argsort(image, kind="stable")
    parts = np.split(xy[order], np.flatnonzero(np.diff(image[order])) + 1) if len(xy) else []
    return FormatCoverage(_hull_area(xy) / area, np.array([_hull_area(part) / area for part in parts]))


def size_mismatches(block: Block) -> dict[str, Mismatch]:
    """Detect image points that do not fit the format of their camera, by camera (`size_mismatch`).

    A camera with few images is not judged: their points may be anywhere.
    """
    rows = block.image_points
    camera = np.array(block.image_camera)[np.asarray(rows.image)]
    found = {
        name: size_mismatch(sensor, np.asarray(rows.xy).T[:, camera == name])
        for name, sensor in block.sensors.items()
        if block.image_camera.count(name) >= _IMAGES
    }
    return {name: mismatch for name, mismatch in found.items() if mismatch}


def _hull_area(xy: Float[np.ndarray, "n 2"]) -> float:
    try:
        # Qhull's `volume` of a two-dimensional hull is its area.
        return float(scipy.spatial.ConvexHull(xy).volume) if len(xy) > 2 else 0.0
    except scipy.spatial.QhullError:
        return 0.0


class ImageLinks(NamedTuple):
    """Pairs of images with common object points."""

    first: Int[np.ndarray, "pairs"]
    second: Int[np.ndarray, "pairs"]
    """Image indices of each pair, first < second."""
    common: Int[np.ndarray, "pairs"]
    """Number of common object points of each pair."""


def image_links(adjusted: Adjustment) -> ImageLinks:
    """List all pairs of images with at least one common object point."""
    measured = _measured(adjusted)
    common = scipy.sparse.triu(measured @ measured.T, k=1, format="coo")
    first, second = common.coords
    return ImageLinks(first.astype(int), second.astype(int), common.data.astype(int))


def _measured(adjusted: Adjustment) -> "scipy.sparse.csr_array":
    """Return the incidence matrix (images, points): one where the image measured the point."""
    s = adjusted.structure
    shape = len(adjusted.block.images), len(adjusted.block.points)
    incidence = scipy.sparse.csr_array((np.ones(len(s.image), int), (s.image, s.point)), shape=shape)
    # Count repeated measurements of a point in one image once.
    incidence.data[:] = 1
    return incidence


def intersection_angles(adjusted: Adjustment) -> Float[np.ndarray, "points"]:
    """Compute the largest intersection angle (rad) between two rays of each point; NaN with fewer than two images.

    cos = d_i' d_j of the unit vectors d from the point to the projection centres of its images.
    """
    s = adjusted.structure
    order = np.argsort(s.point, kind="stable")
    vector = np.asarray(adjusted.unknowns.exterior.position)[s.image] - np.asarray(adjusted.unknowns.points)[s.point]
    ray = (vector / np.linalg.norm(vector, axis=1, keepdims=True))[order]
    rays = np.bincount(s.point, minlength=len(adjusted.block.points))
    first = np.cumsum(rays) - rays
    angle = np.full(len(rays), np.nan)
    # Process points with the same number of rays in one batch.
    for n in np.unique(rays[rays > 1]):
        points = np.flatnonzero(rays == n)
        d = ray[first[points, None] + np.arange(n)]
        cosine = np.einsum("mik,mjk->mij", d, d).min(axis=(1, 2))
        angle[points] = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle
