"""The formulas of the field once more, by another road and in plain NumPy, to test the library against."""

import numpy as np


def axis_rotation(axis: int, angle: float) -> np.ndarray:
    """Rotation of the frame about one axis: R1, R2, R3 of photogrammetry."""
    s, c = np.sin(angle), np.cos(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = s, -s
    return matrix


def camera_from_object(omega: float, phi: float, kappa: float) -> np.ndarray:
    """R3(kappa) R2(phi) R1(omega) as a product of three matrices."""
    return axis_rotation(2, kappa) @ axis_rotation(1, phi) @ axis_rotation(0, omega)


def collinearity(c: float, angles, position, point) -> np.ndarray:
    """Ideal image coordinates with the nine rotation elements written out."""
    (so, sp, sk), (co, cp, ck) = np.sin(angles), np.cos(angles)
    dx, dy, dz = np.asarray(point) - position
    u = cp * ck * dx + (co * sk + so * sp * ck) * dy + (so * sk - co * sp * ck) * dz
    v = -cp * sk * dx + (co * ck - so * sp * sk) * dy + (so * ck + co * sp * sk) * dz
    w = sp * dx - so * cp * dy + co * cp * dz
    return np.array([-c * u / w, -c * v / w])


def random_rotations(rng: np.random.Generator, n: int) -> np.ndarray:
    """Proper rotations from the QR factors of random matrices."""
    q, r = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    q = q * np.sign(np.einsum("nii->ni", r))[:, None, :]
    q[:, :, 0] *= np.linalg.det(q)[:, None]
    return q
