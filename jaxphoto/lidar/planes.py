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
from jaxtyping import Bool, Float

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
    off = points - plane.centroid
    by = np.column_stack([off, -np.ones(len(off))])
    return off @ plane.normal, np.sqrt(np.einsum("ni,ij,nj->n", by, plane.covariance, by))


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
