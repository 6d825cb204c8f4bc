"""Forward intersection of all points of a block at once: 3 x 3 normal equations summed over rows, in NumPy."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

_STEPS = 5
_OPEN = (
    0.2  # a standard deviation, of the distance, beyond which errors along the rays are on one side more than the other
)


class IntersectedPoints(NamedTuple):
    """Points from the rays of images without errors; NaN where they are not determined."""

    points: Float[np.ndarray, "points 3"]
    """In m."""
    covariance: Float[np.ndarray, "points 3 3"]
    """A priori, m^2."""
    determined: Bool[np.ndarray, " points"]
    """Whether rays meet at an angle that their errors leave certain, in front of the cameras."""


def intersect_points(
    origins: Float[np.ndarray, "rows 3"],
    directions: Float[np.ndarray, "rows 3"],
    point: Int[np.ndarray, " rows"],
    n_points: int,
    coordinates: tuple[Int[np.ndarray, " known"], Int[np.ndarray, " known"], Float[np.ndarray, " known"]] | None = None,
    min_angle: float = np.deg2rad(0.02),
) -> tuple[Float[np.ndarray, "points 3"], Bool[np.ndarray, " points"]]:
    """The point (m) nearest to its rays, for every point, and whether its rays determine it.

        sum over rays (I - d d') (X - origin) = 0

    `origins` (m) and unit `directions` are of the ray of each row, `point` is the point it belongs to. `coordinates`
    (point, axis, value in m) are single known coordinates, such as a height: each is one more plane of the weight of
    a ray. Where all rays of a point are within `min_angle` (rad) of each other, or there is only one, the point is not
    determined and its coordinates are NaN. `jaxphoto.collinearity.intersect` is the same of one point, for derivatives.
    """
    # About the centre of the cameras, so that map coordinates lose no digits.
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
    # Two rays at the angle a have the smallest eigenvalue a^2 / 2.
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
    """The points with the least squared errors of image coordinates, and their covariances.

        sum J' (u - u(X)) = 0,   u = (x, y) / -z,   Q = sigma_rad^2 (sum J' J)^-1,   J = du / dX

    `rays` are unit directions in the camera frame of the `image` of each row, `point` is the point it belongs to;
    `sigma_rad` is the standard deviation of image coordinates as a fraction of c. Starts from `intersect_points`, with
    its `min_angle` (rad). A point behind one of its cameras is not determined either, nor one with a standard deviation
    of more than a fifth of its distance: the errors of so weak an intersection are no longer symmetrical. Raises
    ValueError where `sigma_rad` is not positive.
    """
    if not sigma_rad > 0:
        raise ValueError(f"the standard deviation of image coordinates is positive, but sigma_rad is {sigma_rad}")
    directions = np.einsum("nij,ni->nj", camera_from_object[image], rays)
    found, determined = intersect_points(positions[image], directions, point, n_points, min_angle=min_angle)
    covariance = np.full((n_points, 3, 3), np.nan)
    use = determined[point]
    image, point, turn = image[use], point[use], camera_from_object[image[use]]
    measured = rays[use, :2] / -rays[use, 2:]
    some = np.flatnonzero(determined)
    with np.errstate(all="ignore"):  # rays that only just meet may send a point to infinity, and it is then behind
        for _ in range(_STEPS):
            x, y, z = np.einsum("nij,nj->in", turn, found[point] - positions[image])
            slope = (turn[:, :2] + np.stack([x, y], axis=1)[:, :, None] / -z[:, None, None] * turn[:, 2:]) / -z[
                :, None, None
            ]
            residual = measured - np.stack([x, y], axis=1) / -z[:, None]
            normal, right = np.zeros((n_points, 3, 3)), np.zeros((n_points, 3))
            np.add.at(normal, point, np.swapaxes(slope, 1, 2) @ slope)
            np.add.at(right, point, np.einsum("nki,nk->ni", slope, residual))
            covariance[some] = sigma_rad**2 * _inverses(normal[some])
            step = (covariance[some] @ right[some][..., None])[..., 0] / sigma_rad**2
            found[some] += step
        offsets = found[point] - positions[image]
        depth = np.einsum("ni,ni->n", turn[:, 2], offsets)
        distance = np.full(n_points, np.inf)
        np.minimum.at(distance, point, np.linalg.norm(offsets, axis=1))
        spread = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        # What the last step still moved by more than it may be wrong by has not arrived.
        good = spread < _OPEN * distance
        good[some] &= np.linalg.norm(step, axis=1) < spread[some]
    good &= np.bincount(point[~(depth < 0)], minlength=n_points) == 0
    found[~good], covariance[~good] = np.nan, np.nan
    return IntersectedPoints(found, covariance, determined & good)


def _inverses(normal: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
    """NaN where a matrix is singular or no number."""
    result = np.full_like(normal, np.nan)
    regular = np.isfinite(normal).all(axis=(1, 2))
    values = np.linalg.eigvalsh(normal[regular])
    regular[regular] = values[:, 0] > 1e-15 * values[:, 2]
    result[regular] = np.linalg.inv(normal[regular])
    return result
