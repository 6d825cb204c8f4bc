"""Robust plane through laser points with errors in X, Y and Z.

With S = diag(sigma_xy^2, sigma_xy^2, sigma_z^2) the points are y = S^-1/2 x with unit errors in every direction, and
the most likely plane minimises the squared distances in y: through the mean, its normal m the eigenvector of the
smallest eigenvalue of sum (y - mean) (y - mean)'. In metres it is

    n . (x - centroid) = 0,    n = S^-1/2 m / |S^-1/2 m|

Random samples of three points (RANSAC) give a start value that is robust to blunders; then the plane through the points
within three standard deviations is re-fitted until these do not change. Regression of Z on X and Y would underestimate
every slope: horizontal errors widen the patch but not its heights.
"""

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxphoto.errors import InputError

# Number of samples: all contain a blunder once in 10^11 cases at 50 % blunders, once in 230 at 70 %.
_DRAWS = 200
_SCORED = 4000
_CUT = 3.0
# Variance of a normal distribution truncated at +-3 standard deviations.
_CUT_VARIANCE = 0.9733
_ROUNDS = 30


class Plane(eqx.Module):
    """Fitted plane `normal . (x - centroid) = 0` through laser points (m)."""

    normal: Float[np.ndarray, "3"]
    """Unit normal, upwards."""
    centroid: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "4 4"]
    """A posteriori covariance of the normal and the offset (m) at the centroid; singular along the normal."""
    sigma0: float
    """Ratio of the points' scatter to the stated standard deviations: 1 if these and the plane are correct."""
    inliers: Bool[np.ndarray, "n"]
    """True for inliers."""


def fit_plane(xyz: Float[np.ndarray, "n 3"], sigma_xy_m: float, sigma_z_m: float) -> Plane:
    """Fit a plane to the majority of laser points `xyz` (m), by RANSAC and total least squares.

    `sigma_xy_m` (of X and of Y) and `sigma_z_m` are the standard deviations of a laser point. Pass all returns of a
    surface: a window cut by measured X and Y from a larger slope gives a slightly too steep plane. Random samples are
    reproducible. Raises InputError for fewer than four points, collinear points, or sigmas that are not positive.
    """
    sigma = point_sigma(sigma_xy_m, sigma_z_m)
    if len(xyz) < 4:
        raise InputError(f"a plane with redundancy needs 4 laser points, got {len(xyz)}; use a larger patch")
    origin = np.median(xyz, axis=0)
    scaled = (xyz - origin) / sigma
    inliers = np.abs(_start(scaled)) < _CUT
    for _ in range(_ROUNDS):
        mean, squares, axes = _principal(scaled[inliers])
        new = np.abs((scaled - mean) @ axes[:, 0]) < _CUT * max(1.0, _sigma0(squares[0], inliers))
        if new.sum() < 4 or (new == inliers).all():
            break
        inliers = new
    mean, squares, axes = _principal(scaled[inliers])
    n, sigma0 = int(inliers.sum()), _sigma0(squares[0], inliers)
    noise = n * sigma0**2
    if not squares[1] > 2 * noise + 1e-9 * squares[2]:
        raise InputError(
            f"the {len(xyz)} laser points lie on a line within their standard deviations and do not determine a "
            "plane; use a larger patch"
        )
    # Variances of the tilts about both long axes and of the offset, scaled by the errors along these axes.
    variance = sigma0**2 * np.array([s / (s - noise) ** 2 for s in squares[1:]] + [1 / n])
    stretched = axes / sigma[:, None]
    length = np.linalg.norm(stretched[:, 0]) * (1 if stretched[2, 0] >= 0 else -1)
    normal = stretched[:, 0] / length
    by = np.zeros((4, 3))
    by[:3, :2] = (np.eye(3) - np.outer(normal, normal)) @ stretched[:, 1:] / length
    by[3, 2] = 1 / length
    return Plane(normal, origin + sigma * mean, by * variance @ by.T, sigma0, inliers)


def point_sigma(sigma_xy_m: float, sigma_z_m: float) -> Float[np.ndarray, "3"]:
    """Return standard deviations (m) of a laser point in X, Y and Z. Raises InputError for invalid ones.

    Zero in X and Y is replaced by a thousandth of the value in Z: the plane then equals the regression of Z on X and Y
    to 1e-6.
    """
    if not (sigma_z_m > 0 and sigma_xy_m >= 0):
        raise InputError(
            f"the standard deviation of a laser point must be positive in Z and not negative in X and Y, got "
            f"{sigma_z_m} m and {sigma_xy_m} m"
        )
    return np.array([max(sigma_xy_m, 1e-3 * sigma_z_m)] * 2 + [sigma_z_m])


def plane_distance(
    plane: Plane, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the distance (m) of `points` (m) above the plane, along its normal, and the plane's sigma (m) there."""
    offset = points - plane.centroid
    by = np.column_stack([offset, -np.ones(len(offset))])
    return offset @ plane.normal, np.sqrt(np.einsum("ni,ij,nj->n", by, plane.covariance, by))


def plane_feet(
    plane: Plane, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return point-to-plane observations for `points` (m): foot points (m), unit normal, sigma of the plane at each
    point (m).

    A row of an adjustment is then `normal . (point - foot) = 0 +- sigma`. The sigma contains the error of the plane
    only, which all points of a plane share.
    """
    distance, sigma = plane_distance(plane, points)
    normal = np.broadcast_to(plane.normal, points.shape)
    return points - distance[:, None] * normal, normal, sigma


def _start(scaled: np.ndarray) -> np.ndarray:
    """Return distances of all points from the best plane through three random points."""
    rng = np.random.default_rng(0)
    corners = scaled[rng.integers(0, len(scaled), (_DRAWS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    drawn = length > 0
    if not drawn.any():
        raise InputError(
            f"the {len(scaled)} laser points lie on a line and do not determine a plane; use a larger patch"
        )
    normals, corners = normals[drawn] / length[drawn, None], corners[drawn, 0]
    some = scaled[rng.permutation(len(scaled))[:_SCORED]]
    distance = some @ normals.T - np.sum(corners * normals, axis=1)
    best = np.argmin(np.minimum(distance**2, _CUT**2).sum(axis=0))
    return (scaled - corners[best]) @ normals[best]


def _principal(scaled: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean, the sums of squares along the principal axes in ascending order, and the axes as columns."""
    mean = scaled.mean(axis=0)
    return mean, *np.linalg.eigh((scaled - mean).T @ (scaled - mean))


def _sigma0(sum_of_squares: float, inliers: np.ndarray) -> float:
    return float(np.sqrt(max(sum_of_squares, 0.0) / (_CUT_VARIANCE * max(inliers.sum() - 3, 1))))


# Planar patches of a cloud, mainly roof faces, by region growing; planes, outlines and centroids.
#
# A patch grows from a point whose neighbours are coplanar. Fit a plane to its points, select all connected points
# within three standard deviations, and repeat until the points do not change. Accept the largest patch of several
# seeds, then continue with the remaining points. Along a ridge the first patch includes points of the other face;
# therefore each point is finally assigned to the nearest plane of its neighbours.

# Number of neighbours of a seed, and of the connectivity graph.
_SEED, _GRAPH = 12, 8
# Maximum length of a connection, as a multiple of the median distance of the farthest neighbour.
_GAP = 2.0
# Maximum ratio of the residual variance of a seed to the lidar's variance (exceeded by chance once in a thousand).
_PLANAR = 2.7
_RIDGE_ROUNDS, _SHARED = 12, 3
# Number of seeds from which the largest patch is selected: a seed on a ridge grows over parts of both faces.
_TRIED = 6
# Minimum spread across a face, in horizontal standard deviations: a width of about six of them.
_WIDTH = 2.0
# Maximum sigma0 of a face; points uniformly distributed between -3 and 3 standard deviations have 1.73.
_SPREAD = 1.35


class Patch(eqx.Module):
    """Connected coplanar laser points."""

    index: Int[np.ndarray, "n"]
    """Indices into the given points."""
    plane: Plane
    """Plane through the points of the patch; all are inliers."""
    outline: Float[np.ndarray, "corners 3"]
    """Convex hull in X and Y, counterclockwise, projected onto the plane (m); slightly enlarged by horizontal noise."""


def planar_patches(
    xyz: Float[np.ndarray, "n 3"], sigma_xy_m: float, sigma_z_m: float, least_points: int = 20
) -> list[Patch]:
    """Find the planar patches of at least `least_points` laser points `xyz` (m), largest first.

    The standard deviations of a laser point define planarity: they should be realistic. Pass the points of buildings
    (LAS class 6) or of a window: level ground is also planar. Faces narrower than six `sigma_xy_m` cannot be
    distinguished from noise. Raises InputError for fewer points than a patch needs and, like `fit_plane`, for invalid
    sigmas.
    """
    if len(xyz) < max(least_points, _SEED):
        raise InputError(
            f"{len(xyz)} laser points, but a planar patch needs {least_points}; use a larger window, or all classes"
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
    # Process connected points (houses) separately: unconnected points have no common face.
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
    """Return the centroid (m) of the laser points of a roof face or a roof, and its covariance (m^2): scatter over n.

    For uniformly distributed points it is the centroid of the area in plan. Points of overlapping strips on a part of
    the roof bias it without an effect on the covariance: use the points of one strip. Points hidden from the lidar, for
    example behind a chimney, bias it as well.
    """
    if len(points) < 4:
        raise InputError(f"the centroid of a roof needs 4 laser points, got {len(points)}")
    return points.mean(axis=0), np.cov(points.T) / len(points)


def _of_house(
    xyz: np.ndarray, near: np.ndarray, even: np.ndarray, graph: "scipy.sparse.csr_matrix", sigma: np.ndarray, least: int
) -> list[Patch]:
    """Find the patches of connected points; `near` are the neighbours of each point, -1 if not among them."""
    members: list[np.ndarray] = []
    free, scaled = np.ones(len(xyz), bool), xyz / sigma
    seeds = np.random.default_rng(0).permutation(np.flatnonzero(even))
    while len(seeds):
        starts = [n[(n >= 0) & free[n]] for n in near[seeds[:_TRIED]]]
        grown, _ = _faces(xyz, [_grown(scaled, start, free, graph) for start in starts], least, sigma)
        if grown:
            largest = max(grown, key=len)
            members.append(largest)
            free[largest] = False
        else:
            seeds = seeds[_TRIED:]
        seeds = seeds[free[seeds]]
    members, planes = _faces(xyz, members, least, sigma)
    for _ in range(_SHARED if len(planes) > 1 else 0):
        members, planes = _faces(xyz, _shared(xyz, members, planes, graph, sigma), least, sigma)
    return [_patch(member, plane, xyz) for member, plane in zip(members, planes, strict=True)]


def _faces(
    xyz: np.ndarray, members: list[np.ndarray], least: int, sigma: np.ndarray
) -> tuple[list[np.ndarray], list[Plane]]:
    """Select the `members` that are faces, and return them with their planes.

    A face has enough points, is wider than a strip of noise along a ridge or eaves, and its points scatter about the
    plane like the lidar's noise, not uniformly over the search band.
    """
    faces, planes = [], []
    for member in members:
        points = xyz[member]
        if len(member) >= max(least, 4) and np.linalg.eigvalsh(np.cov(points[:, :2].T))[0] > (_WIDTH * sigma[0]) ** 2:
            plane = fit_plane(points, sigma[0], sigma[2])
            if plane.sigma0 < _SPREAD:
                faces.append(member)
                planes.append(plane)
    return faces, planes


def _patch(members: np.ndarray, plane: Plane, xyz: np.ndarray) -> Patch:
    index = members[plane.inliers]
    plane = eqx.tree_at(lambda p: p.inliers, plane, np.ones(len(index), bool))
    corners = xyz[index][scipy.spatial.ConvexHull(xyz[index, :2]).vertices]
    distance, _ = plane_distance(plane, corners)
    return Patch(index, plane, corners - np.outer(distance / plane.normal[2], [0.0, 0.0, 1.0]))


def _unevenness(around: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return the ratio of the variance of each point's neighbours about their plane to the lidar's variance."""
    scaled = (around - around.mean(axis=1, keepdims=True)) / sigma
    return np.linalg.eigvalsh(np.swapaxes(scaled, 1, 2) @ scaled)[:, 0] / (around.shape[1] - 3)


def _grown(
    scaled: np.ndarray, seed: np.ndarray, free: np.ndarray, graph: "scipy.sparse.csr_matrix"
) -> Int[np.ndarray, "n"]:
    """Grow a patch of free points from `seed`; `scaled`: all coordinates, divided by their standard deviations."""
    patch = seed
    for _ in range(_RIDGE_ROUNDS):
        if len(patch) < 4:
            break
        offset = scaled - scaled[patch].mean(axis=0)
        _, axes = np.linalg.eigh(offset[patch].T @ offset[patch])
        near = np.flatnonzero(free & (np.abs(offset @ axes[:, 0]) < _CUT))
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
    """Assign each point to the nearest plane among its own and its neighbours' planes."""
    distance = np.abs(np.stack([_scaled_distance(xyz, plane, sigma) for plane in planes]))
    for k, member in enumerate(members):
        mask = np.zeros(len(xyz))
        mask[member] = 1
        beside = graph @ mask + mask > 0
        distance[k, ~beside | (distance[k] > _CUT)] = np.inf
    best = np.where(np.isfinite(distance.min(axis=0)), np.argmin(distance, axis=0), -1)
    return [np.flatnonzero(best == k) for k in range(len(planes))]


def _scaled_distance(xyz: np.ndarray, plane: Plane, sigma: np.ndarray) -> np.ndarray:
    """Return distances from a plane, divided by the standard deviation of a laser point along its normal."""
    return (xyz - plane.centroid) @ plane.normal / np.linalg.norm(sigma * plane.normal)
