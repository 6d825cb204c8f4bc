"""How well the rays of points meet, which tells a rotation from its transpose where a description does not."""

import numpy as np
from jaxtyping import Float, Int


def ray_misfit(
    centres: Float[np.ndarray, "images 3"],
    camera_from_object: Float[np.ndarray, "images 3 3"],
    rays: Float[np.ndarray, "n 3"],
    image: Int[np.ndarray, "n"],
    point: Int[np.ndarray, "n"],
) -> float:
    """The median angle (rad) by which rays, given in the axes of their cameras, miss the place nearest to all rays of
    their point; NaN where no point has two."""
    several = np.bincount(point, minlength=1)[point] >= 2
    image, point, rays = image[several], point[several], rays[several]
    if not len(image):
        return np.nan
    along = np.einsum("nji,nj->ni", camera_from_object[image], rays)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    middle = centres.mean(axis=0)
    start = centres[image] - middle
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    normal, right = np.zeros((point.max() + 1, 3, 3)), np.zeros((point.max() + 1, 3))
    np.add.at(normal, point, across)
    np.add.at(right, point, np.einsum("nij,nj->ni", across, start))
    # Parallel rays meet nowhere: a little of the unit matrix, more than the rounding of as many rays, keeps their place
    # finite.
    little = 1e-12 * np.maximum(np.einsum("pii->p", normal), 1.0)[:, None, None] * np.eye(3)
    at = np.linalg.solve(normal + little, right[:, :, None])[:, :, 0]
    to = at[point] - start
    off = np.linalg.norm(np.einsum("nij,nj->ni", across, to), axis=1)
    ahead = np.einsum("ni,ni->n", along, to)
    return float(np.median(np.arctan2(off, ahead)))
