"""Homographies of a plane's points in two images, and their decomposition into orientations.

Rays to points X in the plane m' X = 1, in the frame of camera 1, satisfy

    x_2 ~ H x_1,   H = R (I - b m'),   R = camera_2_from_camera_1,   b the base (m)

Four points determine H. Two orientations have the same H, usually both with all points in front. For a flat scene only
noise decides which fits better; five of its points may yield one orientation and not the other.

Sources: Hartley and Zisserman (2004), "Multiple View Geometry", algorithm 4.1; Ma, Soatto, Kosecka and Sastry (2004),
"An Invitation to 3-D Vision", section 5.3.3.
"""

import numpy as np
from jaxtyping import Float

from jaxphoto.initial.coplanarity import RayPairs
from jaxphoto.initial.quaternions import cross_matrices

_ROTATION = 1e-3  # difference of squared singular values below which H is a rotation
_SAME = 1e-12


def homographies(rays_1: Float[np.ndarray, "sets n 3"], rays_2: Float[np.ndarray, "sets n 3"]):
    """Estimate the homography H, `x_2 ~ H x_1`, middle singular value 1, of each set of four or more ray pairs.

    With three collinear points, or fewer than four distinct ones, the result is one of many solutions.
    """
    rows = (cross_matrices(rays_2)[..., :, None] * rays_1[..., None, None, :]).reshape(len(rays_1), -1, 9)
    matrices = np.linalg.eigh(np.swapaxes(rows, 1, 2) @ rows)[1][:, :, 0].reshape(-1, 3, 3)
    middle = np.linalg.svd(matrices, compute_uv=False)[:, 1]
    sign = np.sign(np.einsum("sni,sij,snj->s", rays_2, matrices, rays_1))
    return matrices * (sign / np.maximum(middle, 1e-300))[:, None, None]


def transfer_errors(matrices: Float[np.ndarray, "m 3 3"], pairs: RayPairs) -> Float[np.ndarray, "m n"]:
    """Return the distances of H x_1 from x_2, in standard deviations of both, for many homographies."""
    moved = matrices @ pairs.rays_1.T  # (m, 3, n)
    length = np.linalg.norm(moved, axis=1)
    apart = np.linalg.norm(moved / np.maximum(length, 1e-300)[:, None] - pairs.rays_2.T, axis=1)
    # Errors of ray 1 scale with H, whose three scales differ; their mean is accurate enough here.
    variance = 0.5 * (np.sum(pairs.noise_2**2, axis=(1, 2)) + np.sum(pairs.noise_1**2, axis=(1, 2)) / length**2)
    return apart / np.sqrt(np.maximum(variance, 1e-300))


def homography_orientations(
    homography: Float[np.ndarray, "3 3"], rays_1: Float[np.ndarray, "n 3"]
) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
    """Return rotations `camera_2_from_camera_1` and bases (unit vectors) of a homography with middle singular value 1.

    Returns two orientations with most of the points in front, none if H is a rotation.
    """
    squares, vectors = np.linalg.eigh(homography.T @ homography)
    if squares[2] - squares[0] < _ROTATION:
        return []
    small, large = max(1 - squares[0], 0.0), max(squares[2] - 1, 0.0)
    result = []
    for sign in (1.0, -1.0):
        # Lengths along this vector and the middle one are invariant.
        kept = np.sqrt(small) * vectors[:, 2] + sign * np.sqrt(large) * vectors[:, 0]
        kept /= np.sqrt(squares[2] - squares[0])
        axes = np.stack([vectors[:, 1], kept, np.cross(vectors[:, 1], kept)], axis=1)
        images = homography @ axes[:, :2]
        turned = np.column_stack([images, np.cross(images[:, 0], images[:, 1])])
        rotation = turned @ axes.T
        # H - R = -R b m': the plane's normal m is along the third axis, in front of the points.
        base = (np.eye(3) - rotation.T @ homography) @ axes[:, 2]
        base *= np.sign(np.sum(rays_1 @ axes[:, 2]))
        if np.linalg.norm(base) > _SAME:
            result.append((rotation, base / np.linalg.norm(base)))
    return result
