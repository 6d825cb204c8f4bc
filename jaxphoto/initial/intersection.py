"""Forward intersection of all points of a block, vectorised."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.compiling import call_compiled
from jaxphoto.initial.rays import padded, padded_length
from jaxphoto.least_squares import least_squares

# Ratio of standard deviation to distance above which errors along the rays are asymmetric.
_OPEN = 0.2


class IntersectedPoints(NamedTuple):
    """Points intersected from error-free images; NaN where undetermined."""

    points: Float[np.ndarray, "points 3"]
    """Coordinates (m)."""
    covariance: Float[np.ndarray, "points 3 3"]
    """A priori covariance (m^2)."""
    determined: Bool[np.ndarray, " points"]
    """True if the rays intersect in front of the cameras, at an angle that is significant with respect to their errors.
    """


def intersect_points(
    origins: Float[np.ndarray, "rows 3"],
    directions: Float[np.ndarray, "rows 3"],
    point: Int[np.ndarray, " rows"],
    n_points: int,
    coordinates: tuple[Int[np.ndarray, " known"], Int[np.ndarray, " known"], Float[np.ndarray, " known"]] | None = None,
    min_angle: float = np.deg2rad(0.02),
) -> tuple[Float[np.ndarray, "points 3"], Bool[np.ndarray, " points"]]:
    """Return the point (m) nearest to its rays, for every point, and True where the rays determine it.

        sum over rays (I - d d') (X - origin) = 0

    `origins` (m) and unit `directions` have one row per ray, `point` is the index of the ray's point. `coordinates`
    (point, axis, value in m) are known single coordinates, such as a height: each is an additional plane with the
    weight of a ray. A point with a single ray, or with all rays within `min_angle` (rad), is undetermined: its
    coordinates are NaN. For one point and derivatives use `jaxphoto.collinearity.intersect`.
    """
    # Reduce to the centre of the cameras: large map coordinates would lose digits.
    centre = origins.mean(axis=0) if len(origins) else np.zeros(3)
    local = origins - centre
    along = np.sum(directions * local, axis=1)
    normal = np.zeros((n_points, 3, 3))
    right = np.zeros((n_points, 3))
    count = np.bincount(point, minlength=n_points).astype(float)
    for i in range(3):
        right[:, i] = np.bincount(point, local[:, i] - directions[:, i] * along, n_points)
        for j in range(i, 3):
            outer = np.bincount(point, directions[:, i] * directions[:, j], n_points)
            normal[:, i, j] = normal[:, j, i] = (count if i == j else 0.0) - outer
    if coordinates is not None:
        who, axis, value = coordinates
        np.add.at(normal, (who, axis, axis), 1.0)
        np.add.at(right, (who, axis), value - centre[axis])
    # For two rays at the angle a the smallest eigenvalue is a^2 / 2.
    some = np.flatnonzero(np.trace(normal, axis1=1, axis2=2) > 0)
    some = some[np.linalg.eigvalsh(normal[some])[:, 0] > 0.5 * min_angle**2]
    result, determined = np.full((n_points, 3), np.nan), np.zeros(n_points, bool)
    determined[some] = True
    result[some] = centre + np.linalg.solve(normal[some], right[some][..., None])[..., 0]
    return result, determined


def intersect_with_covariance(
    positions: Float[np.ndarray, "images 3"],
    camera_from_object: Float[np.ndarray, "images 3 3"],
    image: Int[np.ndarray, " rows"],
    rays: Float[np.ndarray, "rows 3"],
    point: Int[np.ndarray, " rows"],
    n_points: int,
    sigma_rad: float,
    min_angle: float = np.deg2rad(0.02),
) -> IntersectedPoints:
    """Intersect points by least squares of image coordinates; return them with their covariances.

        sum J' (u - u(X)) = 0,   u = (x, y) / -z,   Q = sigma_rad^2 (sum J' J)^-1,   J = du / dX

    `rays` are unit directions in the camera frame of the `image` of each row, `point` is the index of the row's point;
    `sigma_rad` is the standard deviation of image coordinates as a fraction of c. The approximate values are from
    `intersect_points` with `min_angle` (rad). A point is undetermined if it lies behind one of its cameras, or if its
    standard deviation exceeds a fifth of its distance: such errors are asymmetric. Raises ValueError if `sigma_rad` is
    not positive.
    """
    if not sigma_rad > 0:
        raise ValueError(f"sigma_rad, the standard deviation of image coordinates, must be positive, got {sigma_rad}")
    directions = np.einsum("nij,ni->nj", camera_from_object[image], rays)
    points, determined = intersect_points(positions[image], directions, point, n_points, min_angle=min_angle)
    covariance = np.full((n_points, 3, 3), np.nan)
    rows, count = np.argsort(point, kind="stable"), np.bincount(point, minlength=n_points)
    begin = np.cumsum(count) - count
    # Programs have a fixed number of rays per point: group points by similar ray counts.
    sizes = 4 ** np.ceil(np.log(np.maximum(count, 2)) / np.log(4)).astype(int)
    for size in np.unique(sizes[determined]):
        some = np.flatnonzero(determined & (sizes == size))
        used = np.arange(size) < count[some, None]
        ray = rows[begin[some, None] + np.where(used, np.arange(size), 0)]
        offsets, matrices = points[some, None] - positions[image[ray]], camera_from_object[image[ray]]
        arguments = (padded(v, padded_length(len(some))) for v in (offsets, matrices, rays[ray], used))
        shift, normal, good = (np.asarray(v)[: len(some)] for v in call_compiled(_adjusted, *arguments))
        offsets = offsets + shift[:, None]
        depth = np.einsum("pri,pri->pr", matrices[:, :, 2], offsets)
        distance = np.linalg.norm(offsets, axis=2).min(axis=1)
        points[some] += shift
        covariance[some] = sigma_rad**2 * _inverses(normal)
        spread = np.sqrt(np.trace(covariance[some], axis1=1, axis2=2))
        determined[some] = good & (spread < _OPEN * distance) & (depth < 0).all(axis=1)
    points[~determined], covariance[~determined] = np.nan, np.nan
    return IntersectedPoints(points, covariance, determined)


@eqx.filter_jit
def _adjusted(offsets, camera_from_object, rays, used):
    """Return shifts (m) of points, normal matrices, and True if converged; `offsets` are the vectors from image to
    point.
    """

    def adjusted(offsets, camera_from_object, rays, used):
        def residuals(shift, _):
            x, y, z = jnp.einsum("rij,rj->ir", camera_from_object, offsets + shift)
            return jnp.concatenate(
                [used * (rays[:, 0] / -rays[:, 2] + x / z), used * (rays[:, 1] / -rays[:, 2] + y / z)]
            )

        fit = least_squares(residuals, jnp.zeros(3), damping=1e-6, atol=1e-14)
        return fit.unknowns, fit.normal, fit.converged

    return jax.vmap(adjusted)(offsets, camera_from_object, rays, used)


def _inverses(normal: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Invert matrices; NaN where one is singular or not finite."""
    result = np.full_like(normal, np.nan)
    regular = np.isfinite(normal).all(axis=(1, 2))
    values = np.linalg.eigvalsh(normal[regular])
    regular[regular] = values[:, 0] > 1e-15 * values[:, 2]
    result[regular] = np.linalg.inv(normal[regular])
    return result
