"""Planar patches of a cloud, mainly roof faces, by region growing; planes, outlines and centroids.

From a point whose neighbours are coplanar a patch grows: the plane through its points; all connected points within
three standard deviations of it; the plane through these, until they do not change. The largest patch from several seeds
is kept, and then the next of the remaining points. Along a ridge the first patch takes points of the other; therefore
each point is finally assigned to the nearest of the planes of its neighbours.
"""

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxphoto.errors import InputError
from jaxphoto.lidar.planes import Plane, fit_plane, plane_distance, point_sigma

# Number of neighbours of a seed, and for connectivity.
_SEED, _GRAPH = 12, 8
# Points are connected up to this multiple of the usual distance of the farthest neighbour.
_GAP = 2.0
# Residual variance of a seed relative to that of the lidar: once in a thousand by chance.
_PLANAR = 2.7
_CUT = 3.0
_ROUNDS, _SHARED = 12, 3
# Number of seeds of which the largest patch is used: one on a ridge grows over parts of both faces.
_TRIED = 6
# Spread across a face, in horizontal standard deviations, that is more than noise: a width of about six of them.
_WIDTH = 2.0
# Largest sigma0 of a face; points uniformly between -3 and 3 standard deviations have 1.73.
_SPREAD = 1.35


class Patch(eqx.Module):
    """Connected coplanar laser points."""

    index: Int[np.ndarray, "n"]
    """Indices of its points, in the given order."""
    plane: Plane
    """Through its points; `plane.inliers` are all of them."""
    outline: Float[np.ndarray, "corners 3"]
    """Convex hull in X and Y, counterclockwise, on the plane (m): slightly enlarged by horizontal noise."""


def planar_patches(
    xyz: Float[np.ndarray, "n 3"], sigma_xy_m: float, sigma_z_m: float, least_points: int = 20
) -> list[Patch]:
    """Find the planar patches of at least `least_points` laser points `xyz` (m), largest first.

    Standard deviations are those of a laser point and define planarity: they should be correct. Pass the points of
    buildings (LAS class 6), or a window of all: level ground is a plane as well. A face narrower than six `sigma_xy_m`
    cannot be distinguished from noise. Raises InputError for fewer points than a patch needs and, like `fit_plane`, for
    invalid sigmas.
    """
    if len(xyz) < max(least_points, _SEED):
        raise InputError(
            f"planar patches of {least_points} points or more were asked of {len(xyz)} laser points; take a larger "
            "window, or all classes"
        )
    sigma = point_sigma(sigma_xy_m, sigma_z_m)
    distance, near = scipy.spatial.KDTree(xyz).query(xyz, k=_SEED)
    reach = _GAP * np.median(distance[:, _GRAPH - 1])
    pairs = np.argwhere(distance[:, 1:_GRAPH] <= reach)
    graph = scipy.sparse.csr_matrix(
        (np.ones(len(pairs)), (pairs[:, 0], near[pairs[:, 0], pairs[:, 1] + 1])), (len(xyz),) * 2
    )
    graph = (graph + graph.T).tocsr()
    even = _unevenness(xyz[near], sigma) < _PLANAR
    # House by house: unconnected points have no face in common.
    _, house = scipy.sparse.csgraph.connected_components(graph, directed=False)
    by_house = np.split(np.argsort(house, kind="stable"), np.cumsum(np.bincount(house))[:-1])
    place = np.full(len(xyz), -1)
    patches: list[Patch] = []
    for of in by_house:
        if len(of) >= max(least_points, 4):
            place[of] = np.arange(len(of))
            found = _of_house(xyz[of], place[near[of]], even[of], graph[of][:, of], sigma, least_points)
            patches += [eqx.tree_at(lambda p: p.index, patch, of[patch.index]) for patch in found]
            place[of] = -1
    return sorted(patches, key=lambda p: -len(p.index))


def roof_centroid(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return the centroid (m) of a roof face, or of a roof, from its laser points, and its covariance (m^2): scatter
    over n.

    It is that of the area in plan for uniformly distributed points, a sample of the area. If strips overlap over a part
    of the roof, the mean is shifted there, and the covariance does not show it: use the points of one strip. Points
    hidden from the lidar, behind a chimney, shift it, too.
    """
    if len(points) < 4:
        raise InputError(f"the centroid of a roof needs 4 laser points, got {len(points)}")
    return points.mean(axis=0), np.cov(points.T) / len(points)


def ridge_line(first: Plane, second: Plane) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the intersection of two roof faces: a point (m) of it between them, and its unit direction.

    Raises InputError for planes that are parallel within three standard deviations.
    """
    direction = np.cross(first.normal, second.normal)
    length = np.linalg.norm(direction)
    tilt = np.sqrt(np.trace(first.covariance[:3, :3]) + np.trace(second.covariance[:3, :3]))
    if length < _CUT * tilt:
        raise InputError("the two planes are parallel within their standard deviations and meet in no ridge")
    direction = direction / length
    middle = (first.centroid + second.centroid) / 2
    rows = np.stack([first.normal, second.normal, direction])
    offset = [(plane.centroid - middle) @ plane.normal for plane in (first, second)]
    return middle + np.linalg.solve(rows, [*offset, 0.0]), direction


def _plane(xyz: np.ndarray, sigma: np.ndarray) -> Plane:
    return fit_plane(xyz, sigma[0], sigma[2])


def _of_house(
    xyz: np.ndarray, near: np.ndarray, even: np.ndarray, graph: "scipy.sparse.csr_matrix", sigma: np.ndarray, least: int
) -> list[Patch]:
    """Return the patches of connected points; `near` are the neighbours of each, -1 if not among them."""
    members: list[np.ndarray] = []
    free, scaled = np.ones(len(xyz), bool), xyz / sigma
    seeds = np.random.default_rng(0).permutation(np.flatnonzero(even))
    while len(seeds):
        starts = [found[(found >= 0) & free[found]] for found in near[seeds[:_TRIED]]]
        grown, _ = _faces(xyz, [_grown(scaled, start, free, graph) for start in starts], least, sigma)
        if grown:
            found = max(grown, key=len)
            members.append(found)
            free[found] = False
        else:
            seeds = seeds[_TRIED:]
        seeds = seeds[free[seeds]]
    members, planes = _faces(xyz, members, least, sigma)
    for _ in range(_SHARED if len(planes) > 1 else 0):
        members, planes = _faces(xyz, _shared(xyz, members, planes, graph, sigma), least, sigma)
    return [_patch(found, plane, xyz) for found, plane in zip(members, planes, strict=True)]


def _faces(
    xyz: np.ndarray, members: list[np.ndarray], least: int, sigma: np.ndarray
) -> tuple[list[np.ndarray], list[Plane]]:
    """Return those of `members` that are faces, with their planes.

    A face has enough points, exceeds what noise leaves in a strip along a ridge or the eaves, and its points scatter
    about its plane as the lidar's noise does, without filling the band from which they were taken.
    """
    faces, planes = [], []
    for found in members:
        points = xyz[found]
        if len(found) >= max(least, 4) and np.linalg.eigvalsh(np.cov(points[:, :2].T))[0] > (_WIDTH * sigma[0]) ** 2:
            plane = _plane(points, sigma)
            if plane.sigma0 < _SPREAD:
                faces.append(found)
                planes.append(plane)
    return faces, planes


def _patch(members: np.ndarray, plane: Plane, xyz: np.ndarray) -> Patch:
    index = members[plane.inliers]
    plane = eqx.tree_at(lambda p: p.inliers, plane, np.ones(len(index), bool))
    corners = xyz[index][scipy.spatial.ConvexHull(xyz[index, :2]).vertices]
    distance, _ = plane_distance(plane, corners)
    return Patch(index, plane, corners - np.outer(distance / plane.normal[2], [0.0, 0.0, 1.0]))


def _unevenness(around: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return the variance of each point's neighbours about their plane, relative to that of the lidar."""
    scaled = (around - around.mean(axis=1, keepdims=True)) / sigma
    return np.linalg.eigvalsh(np.swapaxes(scaled, 1, 2) @ scaled)[:, 0] / (around.shape[1] - 3)


def _grown(
    scaled: np.ndarray, seed: np.ndarray, free: np.ndarray, graph: "scipy.sparse.csr_matrix"
) -> Int[np.ndarray, "n"]:
    """Return the free points of a patch grown from `seed`; `scaled` are all, in standard deviations of X, Y and Z."""
    patch = seed
    for _ in range(_ROUNDS):
        if len(patch) < 4:
            break
        off = scaled - scaled[patch].mean(axis=0)
        _, axes = np.linalg.eigh(off[patch].T @ off[patch])
        near = np.flatnonzero(free & (np.abs(off @ axes[:, 0]) < _CUT))
        _, part = scipy.sparse.csgraph.connected_components(graph[near][:, near], directed=False)
        largest = np.bincount(part[np.isin(near, patch)], minlength=1)
        new = near[part == np.argmax(largest)] if len(near) else near
        if np.array_equal(new, patch):
            break
        patch = new
    return patch


def _shared(
    xyz: np.ndarray, members: list[np.ndarray], planes: list[Plane], graph: "scipy.sparse.csr_matrix", sigma: np.ndarray
) -> list[np.ndarray]:
    """Assign each point to the nearest of the planes of its neighbours and its own."""
    distance = np.abs(np.stack([_scaled_distance(xyz, plane, sigma) for plane in planes]))
    for k, found in enumerate(members):
        member = np.zeros(len(xyz))
        member[found] = 1
        beside = graph @ member + member > 0
        distance[k, ~beside | (distance[k] > _CUT)] = np.inf
    best = np.where(np.isfinite(distance.min(axis=0)), np.argmin(distance, axis=0), -1)
    return [np.flatnonzero(best == k) for k in range(len(planes))]


def _scaled_distance(xyz: np.ndarray, plane: Plane, sigma: np.ndarray) -> np.ndarray:
    """Return distances from a plane in standard deviations of a laser point along its normal."""
    return (xyz - plane.centroid) @ plane.normal / np.linalg.norm(sigma * plane.normal)
