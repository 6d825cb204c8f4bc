"""The essential matrix of two images from eight or more points, and the orientations that an essential matrix means.

The coplanarity condition x_2' E x_1 = 0 is linear in the nine elements of E (Longuet-Higgins 1981, Nature 293;
Hartley 1997, IEEE PAMI 19(6)). A flat scene leaves it open: the five-point solution does not.
"""

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import BlockError


def linear_essential(
    rays_1: Float[np.ndarray, "n 3"], rays_2: Float[np.ndarray, "n 3"], images: str = "the two images"
) -> Float[np.ndarray, "3 3"]:
    """The essential matrix E of norm sqrt 2, `x_2' E x_1 = 0`, nearest to all pairs of unit rays, blunders and all.

    The right singular vector of the smallest singular value, with the singular values then made (1, 1, 0).

    Raises BlockError where there are fewer than eight pairs, or where they leave more than one matrix: flat scenes,
    points on a line, images from one place. `images` names the two for the message.
    """
    if len(rays_1) < 8:
        raise BlockError(
            f"{images} have {len(rays_1)} points in common and the linear relative orientation needs 8: measure more, "
            "or use relative_orientation, which needs 5"
        )
    rows = np.einsum("ni,nj->nij", rays_2, rays_1).reshape(-1, 9)
    _, size, vectors = np.linalg.svd(rows.T @ rows)
    # Squared singular values: the smallest is that of noise, and the one before it must not be.
    if size[7] < 10 * size[8] or size[7] < 1e-14 * size[0]:
        raise BlockError(
            f"the points that {images} have in common leave the linear relative orientation open, as points of a flat "
            "scene, on a line, or seen from one place do: use relative_orientation, or measure other points"
        )
    u, _, vt = np.linalg.svd(vectors[8].reshape(3, 3))
    return u @ np.diag([1.0, 1.0, 0.0]) @ vt


def orientations(
    essentials: Float[np.ndarray, "m 3 3"],
) -> tuple[Float[np.ndarray, "m 4 3 3"], Float[np.ndarray, "m 4 3"]]:
    """The four orientations of each essential matrix: `camera_2_from_camera_1` and the base in camera 1's frame.

    Both rotations U W V', U W' V' with both directions of the base, the vector that E takes to zero. Points lie in
    front of both cameras in one of the four only.
    """
    u, _, vt = np.linalg.svd(essentials)
    u = u * np.linalg.det(u)[:, None, None]
    vt = vt * np.linalg.det(vt)[:, None, None]
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    first, second = u @ quarter @ vt, u @ quarter.T @ vt
    base = vt[:, 2]
    return np.stack([first, first, second, second], axis=1), np.stack([base, -base, base, -base], axis=1)
