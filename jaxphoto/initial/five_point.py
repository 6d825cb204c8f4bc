"""Five-point relative orientation: all essential matrices of five ray pairs, vectorised over many samples.

The four right singular vectors of the five coplanarity conditions span the essential matrices `E = x E_1 + y E_2 + z
E_3 + E_4`. `det E = 0` and `2 E E' E - tr(E E') E = 0` are ten cubic equations in x, y, z. Solving them for the ten
monomials of third degree gives a 10 x 10 matrix, the multiplication by x of the other ten: its real eigenvalues are x,
and its eigenvectors contain y and z. Unlike the linear eight-point solution this is valid for flat scenes.

Sources: Nister (2004), "An efficient solution to the five-point relative pose problem", IEEE PAMI 26(6); Stewenius,
Engels and Nister (2006), "Recent developments on direct relative orientation", ISPRS Journal 60(4).
"""

from itertools import product

import numpy as np
from jaxtyping import Float

# Exponents of x, y, z: first the monomials of third degree, then the others, 1 last.
_MONOMIALS = (
    (3, 0, 0), (2, 1, 0), (1, 2, 0), (0, 3, 0), (2, 0, 1), (1, 1, 1), (0, 2, 1), (1, 0, 2), (0, 1, 2), (0, 0, 3),
    (2, 0, 0), (1, 1, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0),
)  # fmt: skip
_LEFT = _MONOMIALS[10:]


def _collected() -> Float[np.ndarray, "64 20"]:
    """Return the matrix that assigns each product of three factors of (x, y, z, 1) (row) to its monomial (column)."""
    factors = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))
    table = np.zeros((64, 20))
    for row, three in enumerate(product(factors, repeat=3)):
        table[row, _MONOMIALS.index(tuple(sum(axis) for axis in zip(*three, strict=True)))] = 1.0
    return table


_COLLECTED = _collected()
_TIMES_X = [_MONOMIALS.index((a + 1, b, c)) for a, b, c in _LEFT]
_LINEAR = [_LEFT.index(e) for e in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0))]


def five_point_essentials(
    rays_1: Float[np.ndarray, "fives 5 3"], rays_2: Float[np.ndarray, "fives 5 3"], imaginary: float = 1e-9
) -> Float[np.ndarray, "solutions 3 3"]:
    """Return every real essential matrix E, `x_2' E x_1 = 0`, of each sample of five ray pairs; norm sqrt 2.

    Samples with linearly dependent conditions, such as collinear points, are skipped. Measurement errors may turn a
    pair of real solutions into a complex pair, so a sample may have no solution. A relative imaginary part of at most
    `imaginary` is ignored; the matrix is then only approximately essential.
    """
    conditions = np.einsum("fni,fnj->fnij", rays_2, rays_1).reshape(-1, 5, 9)
    _, size, vectors = np.linalg.svd(conditions)
    basis = vectors[size[:, 4] > 1e-12 * size[:, 0], 5:].reshape(-1, 4, 3, 3)
    coefficients = _cubics(basis)
    solvable = np.linalg.det(coefficients[:, :, :10]) != 0
    basis, coefficients = basis[solvable], coefficients[solvable]
    highest = np.linalg.solve(coefficients[:, :, :10], -coefficients[:, :, 10:])
    times_x = np.zeros((len(basis), 10, 10))
    for row, monomial in enumerate(_TIMES_X):
        if monomial < 10:
            times_x[:, row] = highest[:, monomial]
        else:
            times_x[:, row, monomial - 10] = 1.0
    times_x = times_x[np.isfinite(times_x).all(axis=(1, 2))]
    values, vectors = np.linalg.eig(times_x)
    five, which = np.nonzero(np.abs(values.imag) <= imaginary * np.abs(values))
    weights = vectors[five, :, which].real[:, _LINEAR]
    essentials = np.einsum("sk,skij->sij", weights, basis[five])
    return essentials * (np.sqrt(2) / np.linalg.norm(essentials, axis=(1, 2), keepdims=True))


def _cubics(basis: Float[np.ndarray, "fives 4 3 3"]) -> Float[np.ndarray, "fives 10 20"]:
    """Return the coefficients of the ten equations in the monomials."""
    e = basis.transpose(0, 2, 3, 1)  # axes: (sample, row, column, factor)
    square = np.einsum("frka,fckb->frcab", e, e)  # E E'
    trace = np.einsum("frrab->fab", square)
    cubic = 2 * np.einsum("frkab,fkcd->frcabd", square, e) - np.einsum("fab,frcd->frcabd", trace, e)
    minors = np.einsum("fia,fjb->fijab", e[:, 1], e[:, 2])
    minors = minors - np.swapaxes(minors, 1, 2)
    rest = np.stack([minors[:, 1, 2], minors[:, 2, 0], minors[:, 0, 1]], axis=1)
    determinant = np.einsum("fia,fibd->fabd", e[:, 0], rest)
    rows = np.concatenate([cubic.reshape(-1, 9, 64), determinant.reshape(-1, 1, 64)], axis=1)
    return rows @ _COLLECTED


def orientations(
    essentials: Float[np.ndarray, "m 3 3"],
) -> tuple[Float[np.ndarray, "m 4 3 3"], Float[np.ndarray, "m 4 3"]]:
    """Return the four orientations of each essential matrix: `camera_2_from_camera_1` and the base in camera 1's frame.

    They combine the rotations U W V' and U W' V' with both directions of the base, the null vector of E. Only one of
    them has the points in front of both cameras.
    """
    u, _, vt = np.linalg.svd(essentials)
    u = u * np.linalg.det(u)[:, None, None]
    vt = vt * np.linalg.det(vt)[:, None, None]
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    first, second = u @ quarter @ vt, u @ quarter.T @ vt
    base = vt[:, 2]
    return np.stack([first, first, second, second], axis=1), np.stack([base, -base, base, -base], axis=1)
