"""Three-point resection: all exterior orientations that fit the rays to three known points.

Grunert's (1841) solution as written by Haralick, Lee, Ottenberg and Noelle (1994), "Review and analysis of solutions of
the three point perspective pose estimation problem", equations (2)-(9). Let a, b, c be the sides of the object triangle
opposite points 1, 2, 3. The distances are s1, u s1, v s1; v is a root of a quartic with coefficients from the sides and
the cosines of the angles between the rays. The published formula for u divides by zero for symmetric figures, such as a
vertical photograph of a square. Here u is a root of the quadratic of side c; the caller rejects its false root by the
reprojection error.
"""

import numpy as np
from jaxtyping import Float

# Maximum relative difference of the sides of a solution. False roots have large differences, but true double roots are
# only as accurate as the square root of the rounding and image errors.
_MISFIT = 0.3


def three_point_resections(
    rays: Float[np.ndarray, "triples 3 3"], points: Float[np.ndarray, "triples 3 3"]
) -> tuple[Float[np.ndarray, "solutions 3"], Float[np.ndarray, "solutions 3 3"]]:
    """Return positions (m) and `camera_from_object` of every solution of every triple.

    `rays` are unit directions in the camera frame, in the order of the points (triple, point, axis).
    """
    d12, d13, d23 = (np.linalg.norm(points[:, i] - points[:, j], axis=1) for i, j in ((0, 1), (0, 2), (1, 2)))
    cos12, cos13, cos23 = (np.sum(rays[:, i] * rays[:, j], axis=1) for i, j in ((0, 1), (0, 2), (1, 2)))
    v = _roots(_quartic(d23, d13, d12, cos23, cos13, cos12))
    triple = np.repeat(np.arange(len(rays)), 4)
    v = v.ravel()
    with np.errstate(all="ignore"):
        s1 = d13[triple] / np.sqrt(1 + v**2 - 2 * v * cos13[triple])
        discriminant = cos12[triple] ** 2 - 1 + (d12[triple] / s1) ** 2
        root = np.sqrt(np.maximum(discriminant, 0.0))
        u = np.concatenate([cos12[triple] + root, cos12[triple] - root])
    triple, v, s1 = np.tile(triple, 2), np.tile(v, 2), np.tile(s1, 2)
    distances = np.stack([s1, u * s1, v * s1], axis=1)
    in_camera = rays[triple] * distances[..., None]
    side = np.linalg.norm(in_camera[:, 1] - in_camera[:, 2], axis=1)
    with np.errstate(invalid="ignore"):
        good = np.all(np.isfinite(distances) & (distances > 0), axis=1) & (np.abs(side / d23[triple] - 1) < _MISFIT)
    in_camera, in_object = in_camera[good], points[triple[good]]
    matrices = np.einsum("nik,njk->nij", _triad(in_camera), _triad(in_object))
    positions = in_object.mean(axis=1) - np.einsum("nij,ni->nj", matrices, in_camera.mean(axis=1))
    return positions, matrices


def _quartic(a, b, c, cos_a, cos_b, cos_g):
    """Return the coefficients, highest power first, of Haralick et al. (1994), equation (9)."""
    a2, b2, c2 = a * a, b * b, c * c
    minus, plus = (a2 - c2) / b2, (a2 + c2) / b2
    return np.stack(
        [
            (minus - 1) ** 2 - 4 * c2 / b2 * cos_a**2,
            4 * (minus * (1 - minus) * cos_b - (1 - plus) * cos_a * cos_g + 2 * c2 / b2 * cos_a**2 * cos_b),
            2
            * (
                minus**2 - 1 + 2 * minus**2 * cos_b**2 + 2 * (b2 - c2) / b2 * cos_a**2
                - 4 * plus * cos_a * cos_b * cos_g + 2 * (b2 - a2) / b2 * cos_g**2
            ),
            4 * (-minus * (1 + minus) * cos_b + 2 * a2 / b2 * cos_g**2 * cos_b - (1 - plus) * cos_a * cos_g),
            (1 + minus) ** 2 - 4 * a2 / b2 * cos_g**2,
        ],
        axis=1,
    )  # fmt: skip


def _roots(coefficients):
    """Return the real roots (NaN for complex ones), as eigenvalues of the companion matrices."""
    leading = coefficients[:, :1]
    tiny = np.abs(leading) < 1e-12 * np.max(np.abs(coefficients), axis=1, keepdims=True)
    companion = np.zeros((len(coefficients), 4, 4))
    companion[:, 0, :] = -coefficients[:, 1:] / np.where(tiny, 1.0, leading)
    companion[:, [1, 2, 3], [0, 1, 2]] = 1.0
    roots = np.linalg.eigvals(companion)
    # Noise splits a double root into a complex pair; its imaginary part is of the order of the square root of the
    # noise.
    real = (np.abs(roots.imag) < 0.1 * (0.1 + np.abs(roots.real))) & ~tiny
    return np.where(real, roots.real, np.nan)


def _triad(triangles):
    """Return right-handed orthonormal axes of triangles, as columns."""
    first = triangles[:, 1] - triangles[:, 0]
    normal = np.cross(first, triangles[:, 2] - triangles[:, 0])
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first), normal], axis=2)
