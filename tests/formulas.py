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


def turns(vectors: np.ndarray) -> np.ndarray:
    """Rotations by the angle |v| about each vector v, right-handed (Rodrigues)."""
    vectors = np.atleast_2d(vectors)
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    axis = vectors / np.where(angle[:, :, 0] > 0, angle[:, :, 0], 1.0)
    x, y, z = axis.T
    zero = np.zeros_like(x)
    k = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def attitudes(roll_pitch_yaw: np.ndarray) -> np.ndarray:
    """Body (right, forward, up) to east-north-up: yaw about down, then pitch about right, then roll about forward."""
    roll, pitch, yaw = np.atleast_2d(roll_pitch_yaw).T[:, :, None]
    return turns(-yaw * [[0, 0, 1]]) @ turns(pitch * [[1, 0, 0]]) @ turns(roll * [[0, 1, 0]])


def direct(station, roll_pitch_yaw, arm, boresight) -> tuple[np.ndarray, np.ndarray]:
    """Projection centres and camera_from_object of a camera with x forward; `arm` from the camera to the sensor."""
    body = attitudes(roll_pitch_yaw)
    x_forward_y_left = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    object_from_camera = body @ x_forward_y_left @ turns(-np.atleast_2d(boresight))
    return station - np.einsum("nij,nj->ni", body, np.atleast_2d(arm)), object_from_camera.transpose(0, 2, 1)


def assert_scatter(errors: np.ndarray, covariance: np.ndarray) -> None:
    """Draws (n, k) have mean zero and this covariance: whitened, each variance within 5 of its standard errors."""
    n = len(errors)
    white = np.linalg.solve(np.linalg.cholesky(covariance), errors.T)
    np.testing.assert_array_less(np.abs(white.mean(axis=1)), 5 / np.sqrt(n))
    np.testing.assert_array_less(np.abs(white @ white.T / n - np.eye(len(white))), 5 * np.sqrt(2 / n))
