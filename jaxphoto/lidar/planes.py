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

# All of 200 samples contain a blunder once in 10^11 cases at 50 % blunders, once in 230 at 70 %.
_DRAWS = 200
_SCORED = 4000
_CUT = 3.0
# Variance of a normal distribution truncated at +-3 standard deviations.
_CUT_VARIANCE = 0.9733
_ROUNDS = 30


class Plane(eqx.Module):
    """Plane `normal . (x - centroid) = 0` through laser points (m)."""

    normal: Float[np.ndarray, "3"]
    """Unit vector, upwards."""
    centroid: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "4 4"]
    """Of the normal and of the offset (m) at the centroid, a posteriori; singular along the normal, of length 1."""
    sigma0: float
    """Ratio of the points' spread to the stated standard deviations: 1 if these and the plane are correct."""
    inliers: Bool[np.ndarray, "n"]
    """True for the points used."""


def fit_plane(xyz: Float[np.ndarray, "n 3"], sigma_xy_m: float, sigma_z_m: float) -> Plane:
    """Fit a plane to the majority of laser points `xyz` (m), by a robust start and total least squares.

    `sigma_xy_m`, of X and of Y, and `sigma_z_m` are the standard deviations of a laser point. The points should be all
    returns of a surface: a window cut by measured X and Y from a larger slope makes it slightly too steep. The samples
    are the same each time. Raises InputError for fewer than four points, collinear points, or sigmas that are not
    positive.
    """
    sigma = point_sigma(sigma_xy_m, sigma_z_m)
    if len(xyz) < 4:
        raise InputError(f"a plane with a check on it needs 4 laser points, got {len(xyz)}; take a larger patch")
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
            f"the {len(xyz)} laser points lie on a line within their standard deviations and determine no plane; take "
            "a larger patch"
        )
    # Variances of the tilts about both long axes and of the offset, enlarged by errors along these axes.
    variance = sigma0**2 * np.array([s / (s - noise) ** 2 for s in squares[1:]] + [1 / n])
    stretched = axes / sigma[:, None]
    length = np.linalg.norm(stretched[:, 0]) * (1 if stretched[2, 0] >= 0 else -1)
    normal = stretched[:, 0] / length
    by = np.zeros((4, 3))
    by[:3, :2] = (np.eye(3) - np.outer(normal, normal)) @ stretched[:, 1:] / length
    by[3, 2] = 1 / length
    return Plane(normal, origin + sigma * mean, by * variance @ by.T, sigma0, inliers)


def point_sigma(sigma_xy_m: float, sigma_z_m: float) -> Float[np.ndarray, "3"]:
    """Return standard deviations (m) of a laser point in X, Y and Z; raises InputError for invalid ones.

    Zero in X and Y is replaced by a thousandth of that in Z: a plane is then regression on X and Y, to a millionth.
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
    """Return the distance (m) of `points` (m) above the plane, along its normal, and its sigma (m) due to the plane."""
    offset = points - plane.centroid
    by = np.column_stack([offset, -np.ones(len(offset))])
    return offset @ plane.normal, np.sqrt(np.einsum("ni,ij,nj->n", by, plane.covariance, by))


def plane_feet(
    plane: Plane, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return observations that `points` (m) lie on the plane: their feet on it (m), its normal and its sigma there (m).

    A row of an adjustment is then `normal . (point - foot) = 0 +- sigma`. Its sigma is that of the plane alone, and
    common to all points of one plane.
    """
    distance, sigma = plane_distance(plane, points)
    normal = np.broadcast_to(plane.normal, points.shape)
    return points - distance[:, None] * normal, normal, sigma


def _start(scaled: np.ndarray) -> np.ndarray:
    """Return distances of all points from the best of the planes through three of them."""
    rng = np.random.default_rng(0)
    corners = scaled[rng.integers(0, len(scaled), (_DRAWS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    drawn = length > 0
    if not drawn.any():
        raise InputError(f"the {len(scaled)} laser points lie on a line and determine no plane; take a larger patch")
    normals, corners = normals[drawn] / length[drawn, None], corners[drawn, 0]
    some = scaled[rng.permutation(len(scaled))[:_SCORED]]
    distance = some @ normals.T - np.sum(corners * normals, axis=1)
    best = np.argmin(np.minimum(distance**2, _CUT**2).sum(axis=0))
    return (scaled - corners[best]) @ normals[best]


def _principal(scaled: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean, sums of squares along the principal axes, smallest first, and these axes as columns."""
    mean = scaled.mean(axis=0)
    return mean, *np.linalg.eigh((scaled - mean).T @ (scaled - mean))


def _sigma0(sum_of_squares: float, inliers: np.ndarray) -> float:
    return float(np.sqrt(max(sum_of_squares, 0.0) / (_CUT_VARIANCE * max(inliers.sum() - 3, 1))))


# Planar patches of a cloud, mainly roof faces, by region growing; planes, outlines and centroids.
#
# From a point whose neighbours are coplanar a patch grows: the plane through its points; all connected points within
# three standard deviations of it; the plane through these, until they do not change. The largest patch from several
# seeds is kept, and then the next of the remaining points. Along a ridge the first patch takes points of the other;
# therefore each point is finally assigned to the nearest of the planes of its neighbours.

# Number of neighbours of a seed, and for connectivity.
_SEED, _GRAPH = 12, 8
# Points are connected up to this multiple of the usual distance of the farthest neighbour.
_GAP = 2.0
# Residual variance of a seed relative to that of the lidar: once in a thousand by chance.
_PLANAR = 2.7
_RIDGE_ROUNDS, _SHARED = 12, 3
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
    """Return those of `members` that are faces, with their planes.

    A face has enough points, exceeds what noise leaves in a strip along a ridge or the eaves, and its points scatter
    about its plane as the lidar's noise does, without filling the band from which they were taken.
    """
    faces, planes = [], []
    for member in members:
        points = xyz[member]
        if len(member) >= max(least, 4) and np.linalg.eigvalsh(np.cov(points[:, :2].T))[0] > (_WIDTH * sigma[0]) ** 2:
            plane = _plane(points, sigma)
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
    """Return the variance of each point's neighbours about their plane, relative to that of the lidar."""
    scaled = (around - around.mean(axis=1, keepdims=True)) / sigma
    return np.linalg.eigvalsh(np.swapaxes(scaled, 1, 2) @ scaled)[:, 0] / (around.shape[1] - 3)


def _grown(
    scaled: np.ndarray, seed: np.ndarray, free: np.ndarray, graph: "scipy.sparse.csr_matrix"
) -> Int[np.ndarray, "n"]:
    """Return the free points of a patch grown from `seed`; `scaled` are all, in standard deviations of X, Y and Z."""
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
    """Assign each point to the nearest of the planes of its neighbours and its own."""
    distance = np.abs(np.stack([_scaled_distance(xyz, plane, sigma) for plane in planes]))
    for k, member in enumerate(members):
        mask = np.zeros(len(xyz))
        mask[member] = 1
        beside = graph @ mask + mask > 0
        distance[k, ~beside | (distance[k] > _CUT)] = np.inf
    best = np.where(np.isfinite(distance.min(axis=0)), np.argmin(distance, axis=0), -1)
    return [np.flatnonzero(best == k) for k in range(len(planes))]


def _scaled_distance(xyz: np.ndarray, plane: Plane, sigma: np.ndarray) -> np.ndarray:
    """Return distances from a plane in standard deviations of a laser point along its normal."""
    return (xyz - plane.centroid) @ plane.normal / np.linalg.norm(sigma * plane.normal)
