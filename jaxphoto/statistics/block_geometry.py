"""What the photographs of a block show of the ground: height, ground sample distance, overlap and area.

The format of an image, as a polygon on the ideal image, is what a cell of the ground is looked for in, at the height of
the object points around it; trees and roofs between two points hide nothing here.


How much of a camera's format its image points reach: beyond them a distortion is an extrapolation.

Which images of a block share points, and where the block hangs together by the fewest.

Images are nodes, and the points that two of them both measured are the strength of the link between them. The spanning
tree of the strongest links holds, for every pair of images, the way between them whose weakest link is as strong as
can be; so its weakest links are where the block would come apart first.


At which angles the rays of object points meet: what a height is worth before anything is adjusted.
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
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.compiling import call_compiled

# Of the polygon that stands for the format: corners of each side.
_SIDE = 8
# Cells along the longer side of the block: a map, no survey.
_CELLS = 120
# The height of a cell is the median of so many points nearest to it.
_NEAR = 5
# Beyond the footprints of the points, of the flying height: what is seen of the ground past the last point.
_AROUND = 0.5


class Coverage(NamedTuple):
    """A block from above; metres."""

    height_m: Float[np.ndarray, "images"]
    """Of each projection centre over the ground that its image points show (median),"""
    gsd_m: Float[np.ndarray, "images"]
    """and a pixel there, along the optical axis."""
    x: Float[np.ndarray, "columns"]
    """Centres of cells,"""
    y: Float[np.ndarray, "rows"]
    seen_by: Int[np.ndarray, "rows columns"]
    """and how many images see them;"""
    step_m: float
    """the side of a cell."""

    def area_m2(self, least: int) -> float:
        """What `least` images see or more."""
        return float((self.seen_by >= least).sum() * self.step_m**2)


def coverage(adjusted: Adjustment) -> Coverage:
    """The coverage of an adjusted block whose Z is up."""
    s, block = adjusted.structure, adjusted.block
    position = np.asarray(adjusted.unknowns.exterior.position)
    turn = np.asarray(adjusted.unknowns.exterior.camera_from_object)
    points = np.asarray(adjusted.unknowns.points)
    away = points[s.point] - position[s.image]
    depth = -np.einsum("nk,nk->n", turn[s.image][:, 2], away)
    order = np.argsort(s.image, kind="stable")
    first = np.searchsorted(s.image[order], np.arange(len(position) + 1))
    parts = [order[a:b] for a, b in itertools.pairwise(first)]
    middle = lambda v: np.array([np.median(v[part]) if len(part) else np.nan for part in parts])  # noqa: E731
    height, depth = middle(-away[:, 2]), middle(depth)
    angle = {
        name: block.sensors[name].pixel_mm / float(interior.c) for name, interior in adjusted.unknowns.interior.items()
    }
    gsd = depth * np.array([angle[name] for name in block.image_camera])
    x, y, ground, step = _cells(points, position, _AROUND * float(np.nanmedian(height)))
    seen = np.zeros((len(y), len(x)), int)
    for name, interior in adjusted.unknowns.interior.items():
        polygon = _format(interior, block.sensors[name])
        for image in np.flatnonzero(np.array(block.image_camera) == name):
            there = (ground - position[image]) @ turn[image].T
            ahead = there[..., 2] < 0
            flat = there[..., :2] / np.where(ahead, -there[..., 2], 1.0)[..., None]
            seen += ahead & _inside(flat, polygon)
    return Coverage(height, gsd, x, y, seen, step)


def _cells(points: np.ndarray, position: np.ndarray, around: float):
    """Centres of cells over points and stations, without the points that lie astray, their places on the ground,
    and the side of one."""
    low, high = np.percentile(points, [1, 99], axis=0)
    low = np.minimum(low[:2], position[:, :2].min(axis=0)) - around
    high = np.maximum(high[:2], position[:, :2].max(axis=0)) + around
    step = float((high - low).max()) / _CELLS
    x, y = (np.arange(a + step / 2, b + step / 2, step) for a, b in zip(low, high, strict=True))
    plan = np.stack(np.meshgrid(x, y), axis=-1)
    _, near = scipy.spatial.cKDTree(points[:, :2]).query(plan.reshape(-1, 2), k=min(_NEAR, len(points)))
    z = np.median(points[near.reshape(len(near), -1), 2], axis=1)
    return x, y, np.dstack([plan, z.reshape(plan.shape[:2])]), step


def _format(interior: InteriorOrientation, sensor: Sensor) -> Float[np.ndarray, "corners 2"]:
    """The edge of the format as tangents of angles from the axis, to the right and up."""
    part = np.arange(_SIDE) / _SIDE * 2 - 1
    one = np.ones(_SIDE)
    edge = np.concatenate([np.stack(v, axis=1) for v in ((part, -one), (one, part), (-part, one), (-one, -part))])
    given = jax.tree.map(lambda v: jnp.asarray(v, float), interior)
    return np.asarray(call_compiled(_tangents, given, jnp.asarray(edge * [sensor.width_mm / 2, sensor.height_mm / 2])))


@eqx.filter_jit
def _tangents(interior: InteriorOrientation, xy: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    def one(at):
        u, v, w = interior.direction_from_ideal(interior.ideal_from_measured(at))
        return jnp.stack([u, v]) / -w

    return jax.vmap(one)(xy)


def _inside(at: Float[np.ndarray, "rows columns 2"], polygon: Float[np.ndarray, "corners 2"]) -> np.ndarray:
    """Whether places lie in a polygon: a line from each to the right crosses it an odd number of times."""
    x, y = at[..., 0], at[..., 1]
    odd = np.zeros(x.shape, bool)
    for (x1, y1), (x2, y2) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y1 != y2:
            odd ^= ((y1 > y) != (y2 > y)) & (x < (x2 - x1) * (y - y1) / (y2 - y1) + x1)
    return odd


class FormatCoverage(NamedTuple):
    """Parts of the format that convex hulls of image points cover."""

    whole: float
    """Of the points of all images."""
    images: Float[np.ndarray, "images"]
    """Of those of each image that has any."""


def format_coverage(adjusted: Adjustment, camera: str) -> FormatCoverage:
    """Of one camera of a block; a line or fewer than three points cover nothing."""
    s, sensor = adjusted.structure, adjusted.block.sensors[camera]
    mine = np.array([c == camera for c in adjusted.block.image_camera])[s.image]
    xy, image = np.asarray(adjusted.values.xy).T[mine], s.image[mine]
    area = sensor.width_mm * sensor.height_mm
    order = np.argsort(image, kind="stable")
    parts = np.split(xy[order], np.flatnonzero(np.diff(image[order])) + 1) if len(xy) else []
    return FormatCoverage(_hull_area(xy) / area, np.array([_hull_area(part) / area for part in parts]))


def _hull_area(xy: Float[np.ndarray, "n 2"]) -> float:
    try:
        # In two dimensions the volume of qhull is an area.
        return float(scipy.spatial.ConvexHull(xy).volume) if len(xy) > 2 else 0.0
    except scipy.spatial.QhullError:
        return 0.0


class ImageLinks(NamedTuple):
    """Pairs of images that have points in common."""

    first: Int[np.ndarray, "pairs"]
    second: Int[np.ndarray, "pairs"]
    """Indices of images; the first is the smaller."""
    common: Int[np.ndarray, "pairs"]
    """How many object points both measured."""


class WeakLink(NamedTuple):
    """A link without which the block would hang together by weaker ones."""

    first: int
    second: int
    common: int
    """Points that these two images share,"""
    across: int
    """and all points measured on both sides of it."""
    side: Int[np.ndarray, "images"]
    """The images of the smaller side."""


def image_links(adjusted: Adjustment) -> ImageLinks:
    """All pairs of images with at least one point in common."""
    measured = _measured(adjusted)
    common = scipy.sparse.triu(measured @ measured.T, k=1, format="coo")
    first, second = common.coords
    return ImageLinks(first.astype(int), second.astype(int), common.data.astype(int))


def weak_links(adjusted: Adjustment, links: ImageLinks, most: int) -> list[WeakLink]:
    """The `most` weakest links of the tree of the strongest ones, the weakest first."""
    n, measured = len(adjusted.block.images), _measured(adjusted)
    # The strongest tree is the shortest one of what falls as links grow stronger.
    ends = links.first.astype(np.int32), links.second.astype(np.int32)
    length = scipy.sparse.coo_array((1.0 / links.common, ends), shape=(n, n))
    tree = scipy.sparse.csgraph.minimum_spanning_tree(length.tocsr()).tocoo()
    found = []
    for cut in np.argsort(-tree.data, kind="stable")[:most]:
        first, second = (int(end[cut]) for end in tree.coords)
        rest = np.arange(tree.nnz) != cut
        apart = scipy.sparse.coo_array((tree.data[rest], [end[rest] for end in tree.coords]), shape=(n, n))
        _, part = scipy.sparse.csgraph.connected_components(apart, directed=False)
        one, other = (np.flatnonzero(part == part[end]) for end in (first, second))
        seen = [np.asarray(measured[side].sum(axis=0)).ravel() > 0 for side in (one, other)]
        common = round(1 / float(tree.data[cut]))
        side = min(one, other, key=len)
        found.append(WeakLink(min(first, second), max(first, second), common, int((seen[0] & seen[1]).sum()), side))
    return found


def _measured(adjusted: Adjustment) -> "scipy.sparse.csr_array":
    """Images by points: one where an image measured a point."""
    s = adjusted.structure
    shape = len(adjusted.block.images), len(adjusted.block.points)
    found = scipy.sparse.csr_array((np.ones(len(s.image), int), (s.image, s.point)), shape=shape)
    # Measured twice in one image is measured once.
    found.data[:] = 1
    return found


def intersection_angles(adjusted: Adjustment) -> Float[np.ndarray, "points"]:
    """The largest angle (rad) between two rays of each point; NaN where fewer than two images measured it.

    cos = d_i' d_j of the unit vectors d from the point to the projection centres of its images.
    """
    s = adjusted.structure
    order = np.argsort(s.point, kind="stable")
    away = np.asarray(adjusted.unknowns.exterior.position)[s.image] - np.asarray(adjusted.unknowns.points)[s.point]
    ray = (away / np.linalg.norm(away, axis=1, keepdims=True))[order]
    rays = np.bincount(s.point, minlength=len(adjusted.block.points))
    first = np.cumsum(rays) - rays
    angle = np.full(len(rays), np.nan)
    # Points of as many rays at once.
    for many in np.unique(rays[rays > 1]):
        points = np.flatnonzero(rays == many)
        own = ray[first[points, None] + np.arange(many)]
        cosine = np.einsum("mik,mjk->mij", own, own).min(axis=(1, 2))
        angle[points] = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle
