import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto import rotation
from tests.derivatives import check_derivatives, compiled
from tests.formulas import axis_rotation, camera_from_object, random_rotations

bounded = settings(max_examples=50, deadline=None, derandomize=True, database=None)
angle = st.floats(-3.1, 3.1)
tilt = st.floats(-1.55, 1.55)

matrix_from_opk = compiled(rotation.matrix_from_omega_phi_kappa)
opk = rotation.omega_phi_kappa_from_matrix
opk_from_matrix = compiled(rotation.omega_phi_kappa_from_matrix)
matrix_from_rpy = compiled(rotation.matrix_from_roll_pitch_yaw)
rpy_from_matrix = compiled(rotation.roll_pitch_yaw_from_matrix)
matrix_from_quaternion = compiled(rotation.matrix_from_quaternion)
quaternion_from_matrix = compiled(rotation.quaternion_from_matrix)
small_rotation = compiled(rotation.small_rotation)
small_angles = compiled(rotation.small_angles)


@bounded
@given(angle, angle, angle)
def test_omega_phi_kappa_is_the_product_of_three_axis_rotations(omega, phi, kappa):
    matrix = matrix_from_opk([omega, phi, kappa])
    np.testing.assert_allclose(matrix, camera_from_object(omega, phi, kappa), rtol=0, atol=1e-14)


@bounded
@given(angle, tilt, angle)
def test_omega_phi_kappa_round_trip(omega, phi, kappa):
    angles = [omega, phi, kappa]
    np.testing.assert_allclose(opk_from_matrix(matrix_from_opk(angles)), angles, rtol=0, atol=1e-12)


@pytest.mark.parametrize("phi", [np.pi / 2, -np.pi / 2])
def test_at_phi_90_degrees_the_angles_still_give_the_matrix_back(phi):
    matrix = matrix_from_opk([0.3, phi, -0.7])
    np.testing.assert_allclose(matrix_from_opk(opk_from_matrix(matrix)), matrix, rtol=0, atol=1e-12)


@pytest.mark.parametrize("distance", [0.0, 1e-13, 1e-10, 1e-6])
@pytest.mark.parametrize("sign", [1, -1])
def test_near_phi_90_degrees_a_matrix_of_any_origin_comes_back(sign, distance):
    # A product rounds: omega and kappa taken each from elements that should vanish would be two unrelated angles.
    for turn in random_rotations(np.random.default_rng(20), 5):
        matrix = turn @ (turn.T @ camera_from_object(2.5, sign * (np.pi / 2 - distance), -0.7))
        np.testing.assert_allclose(matrix_from_opk(opk_from_matrix(matrix)), matrix, rtol=0, atol=2e-15)


@bounded
@given(angle, tilt, angle)
def test_roll_pitch_yaw_round_trip_and_independent_product(roll, pitch, yaw):
    angles = [roll, pitch, yaw]
    matrix = matrix_from_rpy(angles)
    # The same in body axes right, forward, up: yaw clockwise about up, pitch about right, roll about forward.
    product = axis_rotation(2, yaw) @ axis_rotation(0, -pitch) @ axis_rotation(1, -roll)
    np.testing.assert_allclose(matrix, product, rtol=0, atol=1e-14)
    np.testing.assert_allclose(rpy_from_matrix(matrix), angles, rtol=0, atol=1e-12)


RIGHT, FORWARD, UP = np.eye(3)


@pytest.mark.parametrize(
    ("roll_pitch_yaw", "axis", "where"),
    [
        ((0.1, 0, 0), RIGHT, (np.cos(0.1), 0, -np.sin(0.1))),  # right wing down
        ((0, 0.1, 0), FORWARD, (0, np.cos(0.1), np.sin(0.1))),  # nose up
        ((0, 0, np.pi / 2), FORWARD, (1, 0, 0)),  # flying east
        ((0, 0, np.pi / 2), RIGHT, (0, -1, 0)),  # and the right wing points south
        ((0.2, 0, 0), FORWARD, (0, 1, 0)),  # roll leaves the nose where it is
    ],
)
def test_signs_of_roll_pitch_yaw(roll_pitch_yaw, axis, where):
    object_from_body = matrix_from_rpy(roll_pitch_yaw)
    np.testing.assert_allclose(object_from_body @ axis, where, rtol=0, atol=1e-15)


def half_turns():
    axes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, -1], [1, 1, 1], [3, -1, 2]], float)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)


@pytest.mark.parametrize("matrix", [*random_rotations(np.random.default_rng(0), 30), *half_turns(), np.eye(3)])
def test_quaternion_round_trip(matrix):
    quaternion = quaternion_from_matrix(matrix)
    assert quaternion[0] >= 0
    assert np.linalg.norm(quaternion) == pytest.approx(1, abs=1e-15)
    np.testing.assert_allclose(matrix_from_quaternion(quaternion), matrix, rtol=0, atol=1e-14)


def test_quaternion_of_a_quarter_turn_and_of_any_length():
    root = np.sqrt(0.5)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x to y, about z
    np.testing.assert_allclose(quaternion_from_matrix(quarter), [root, 0, 0, root], rtol=0, atol=1e-15)
    np.testing.assert_allclose(matrix_from_quaternion([-3.0, 0, 0, -3.0]), quarter, rtol=0, atol=1e-15)


THETAS = [(0, 0, 0), (1e-9, -2e-9, 0), (9.9e-4, 0, 0), (1.01e-3, 0, 0), (0.3, -0.2, 0.5), (1.5, 2.0, -1.0), (0, 0, 3.1)]


@pytest.mark.parametrize("theta", THETAS)
def test_small_rotation_is_the_exponential_and_small_angles_its_inverse(theta):
    x, y, z = theta
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    term, exponential = np.eye(3), np.eye(3)
    for k in range(1, 40):
        term = term @ -cross / k
        exponential = exponential + term
    matrix = small_rotation(theta)
    np.testing.assert_allclose(matrix, exponential, rtol=0, atol=2e-14)
    np.testing.assert_allclose(small_angles(matrix), theta, rtol=0, atol=2e-13)


def test_rotate_is_the_matrix_product():
    rng = np.random.default_rng(1)
    matrix, vector = rng.normal(size=(3, 3)), rng.normal(size=3)
    np.testing.assert_allclose(compiled(rotation.rotate)(matrix, vector), matrix @ vector, rtol=1e-14)


# Derivatives: of what takes a matrix, along the rotations only, `small_rotation(theta) @ matrix` ----------------

ANGLES = np.concatenate(
    [
        np.random.default_rng(2).uniform(-3, 3, (20, 3)),
        [[0, 0, 0], [0, 0, 2], [0.3, np.pi / 2, -0.7], [0.3, -np.pi / 2, -0.7], [np.pi, 0, 0], [0.8, -0.9, 3.0]],
    ]
)
TILTED = np.array([[0, 0, 0], [0, 0, 1.5], [0.1, 0.2, 0.3], [2.9, 1.2, -2.8], [-1.0, -1.2, 1.0], [1.2, 0, -0.4]])
HALF_TURNS = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0.6, -0.8, 0], [0, 0.48, 0.6, 0.64]]
SHORT = np.random.default_rng(5).normal(size=(6, 3)) * 0.3


def turned_omega_phi_kappa(theta, angles):
    matrix = rotation.small_rotation(theta) @ rotation.matrix_from_omega_phi_kappa(angles)
    return rotation.omega_phi_kappa_from_matrix(matrix)


def turned_roll_pitch_yaw(theta, angles):
    matrix = rotation.small_rotation(theta) @ rotation.matrix_from_roll_pitch_yaw(angles)
    return rotation.roll_pitch_yaw_from_matrix(matrix)


def turned_quaternion(theta, quaternion):
    q = rotation.quaternion_from_matrix(rotation.small_rotation(theta) @ rotation.matrix_from_quaternion(quaternion))
    return jnp.outer(q, q)  # the sign of q jumps at half a turn, and means nothing


def angles_between(theta, quaternion):
    return rotation.small_angles(rotation.small_rotation(theta) @ rotation.matrix_from_quaternion(quaternion))


@pytest.mark.parametrize("fn", [rotation.matrix_from_omega_phi_kappa, rotation.matrix_from_roll_pitch_yaw])
def test_derivatives_of_matrices_by_angles(fn):
    check_derivatives(fn, ANGLES)


def test_derivatives_of_small_rotation():
    check_derivatives(rotation.small_rotation, np.concatenate([ANGLES, np.array(THETAS, float)]))


def test_derivatives_of_the_matrix_of_a_quaternion():
    quaternions = np.random.default_rng(4).normal((3, 0, 0, 0), size=(10, 4))
    check_derivatives(rotation.matrix_from_quaternion, np.concatenate([quaternions, HALF_TURNS, [[1, 0, 0, 0]]]))


@pytest.mark.parametrize("fn", [turned_omega_phi_kappa, turned_roll_pitch_yaw])
def test_derivatives_of_angles_by_rotation(fn):
    check_derivatives(fn, np.concatenate([np.zeros((6, 3)), 0.1 * SHORT]), np.concatenate([TILTED, TILTED]))


def test_derivatives_of_the_quaternion_of_a_matrix():
    quaternions = np.concatenate([np.random.default_rng(6).normal(size=(6, 4)), HALF_TURNS, [[1, 0, 0, 0]]])
    check_derivatives(turned_quaternion, np.zeros((12, 3)), quaternions)


def test_derivatives_of_small_angles():
    quaternions = np.concatenate(
        [np.tile([[1.0, 0, 0, 0]], (8, 1)), np.random.default_rng(7).normal((2, 0, 0, 0), size=(4, 4))]
    )
    thetas = np.concatenate([np.zeros((1, 3)), [[1e-3, 0, 0]], SHORT, SHORT[:4]])
    check_derivatives(angles_between, thetas, quaternions)


def test_derivative_of_phi_is_no_nan_at_exactly_90_degrees():
    # Omega and kappa are undetermined here, but phi is not (where it is largest its derivative is zero).
    matrix = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    value, slope = compiled(lambda m: (opk(m), jax.jacfwd(opk)(m)))(matrix)
    np.testing.assert_allclose(value[1], np.pi / 2, rtol=0, atol=1e-15)
    assert np.isfinite(slope[1]).all()
