"""Interpolated trajectories against motions that are known at every time."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto.compiling.fast_compilation import jit_quickly
from jaxphoto.georeferencing.trajectory import Trajectory, covered, interpolate
from jaxphoto.rotation import (
    matrix_from_roll_pitch_yaw,
    quaternion_from_matrix,
    roll_pitch_yaw_from_matrix,
    small_angles,
    small_rotation,
)
from tests.derivatives import check_derivatives

ANY_GAP = 1e9
# Where numbers do not matter there are as many records and times, so that what is compiled for one serves all.
RECORDS, TIMES = 201, 400
_at_times = jit_quickly(interpolate)
_quaternions = jax.jit(lambda a: jax.vmap(quaternion_from_matrix)(jax.vmap(matrix_from_roll_pitch_yaw)(a)))
_matrices = jax.jit(jax.vmap(matrix_from_roll_pitch_yaw))
_angles = jax.jit(jax.vmap(roll_pitch_yaw_from_matrix))
_difference = jax.jit(jax.vmap(lambda a, b: small_angles(a.T @ b)))


def at_times(trajectory, times, max_gap):
    got = _at_times(trajectory, np.resize(times, TIMES), max_gap)
    return jax.tree.map(lambda leaf: leaf[: len(times)], got)


def recorded(motion, times, sigma=0.0) -> Trajectory:
    position, angles = motion(times)
    given = np.full((len(times), 3), sigma)
    return Trajectory(times, position, np.asarray(_quaternions(angles)), given, given / 100)


def turn(t):
    """A climbing turn through south (yaw passes 180 degrees) with waves on it: smooth, so every order shows."""
    t = np.asarray(t)
    position = np.stack([400 * np.sin(t / 9), 400 * np.cos(t / 9), 1000 + 2 * t + np.sin(t)], axis=-1)
    return position, np.stack([0.3 + 0.1 * np.sin(1.1 * t), 0.05 * np.cos(t), 2.6 + t / 9], axis=-1)


@functools.cache
def turbulence(seed: int):
    """A flight through turbulence: spectra of speed and angle that fall with (frequency)^-5/3 above 0.1 Hz."""
    rng = np.random.default_rng(seed)
    f = np.geomspace(0.01, 60.0, 500)
    size = np.sqrt(np.gradient(f) * 0.5 * (1 + (f / 0.1) ** 2) ** (-5 / 6))
    phase, axis = rng.uniform(0, 2 * np.pi, (6, len(f))), np.array([1, 1, 1, 0.02, 0.015, 0.02])
    # Aircraft do not follow gusts that are faster than about a second.
    size = size / (1 + (f / 1.0) ** 2)

    def motion(t):
        wave = np.sin(2 * np.pi * f * np.asarray(t)[:, None, None] + phase)
        gusts = wave[:, :3] @ (size / (2 * np.pi * f))
        tilts = wave[:, 3:] @ size
        straight = np.stack([60 * t, 5 * t, 1000 + 0 * t], axis=1)
        return straight + gusts * axis[:3], tilts * axis[3:] + [0, 0, 1.5]

    return motion


def misses(motion, spacing):
    """True errors and stated sigmas (times, 6) of 201 records at 400 random times, 25 records from the ends."""
    times = np.arange(RECORDS) * spacing + 350_000.25
    at = np.random.default_rng(3).uniform(times[25], times[-26], TIMES)
    shifted = lambda t: motion(t - 350_000.25)  # noqa: E731
    got = at_times(recorded(shifted, times), at, ANY_GAP)
    position, angles = shifted(at)
    right, forward, up = np.asarray(_difference(got.object_from_body, _matrices(angles))).T
    error = np.hstack([got.position - position, np.stack([forward, right, up], axis=1)])
    return error, np.hstack([got.sigma_position, got.sigma_attitude])


def test_at_the_records_it_is_the_records():
    times = np.cumsum(np.random.default_rng(1).uniform(0.5, 1.5, RECORDS))
    trajectory = recorded(turn, times, sigma=0.04)
    got = at_times(trajectory, times, ANY_GAP)
    np.testing.assert_allclose(got.position, trajectory.position, rtol=0, atol=1e-10)
    np.testing.assert_allclose(got.object_from_body, _matrices(turn(times)[1]), rtol=0, atol=1e-14)
    np.testing.assert_allclose(got.sigma_position, 0.04, rtol=1e-12)
    np.testing.assert_allclose(got.sigma_attitude, 0.0004, rtol=1e-12)


def test_a_parabola_is_reproduced_to_its_ends():
    times = np.array([0.0, 1.0, 1.5, 3.0, 4.0, 4.5, 6.0, 7.0, 8.0, 9.5])

    def motion(t):
        return np.stack([t**2, 3 * t, 0 * t], axis=-1), np.zeros((len(t), 3))

    at = np.linspace(0, 9.5, 50)
    got = at_times(recorded(motion, times), at, ANY_GAP)
    np.testing.assert_allclose(got.position, motion(at)[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(got.velocity[:, 0], 2 * at, rtol=0, atol=1e-12)


def test_errors_of_smooth_motion_fall_with_the_fourth_power():
    coarse, _ = misses(turn, 0.4)
    fine, _ = misses(turn, 0.2)
    order = np.log2(np.sqrt((coarse**2).mean(0) / (fine**2).mean(0)))
    np.testing.assert_allclose(order, 4, atol=0.25)


@pytest.mark.parametrize("spacing", [1.0, 0.5, 0.2, 0.1, 0.02])
def test_stated_sigmas_are_those_of_true_errors_in_turbulence(spacing):
    error, sigma = misses(turbulence(5), spacing)
    ratio = np.sqrt((sigma**2).mean(0) / (error**2).mean(0))
    assert (ratio > 0.5).all() and (ratio < 2.0).all(), ratio


@pytest.mark.parametrize("spacing", [0.4, 0.2])
def test_stated_sigmas_are_those_of_true_errors_in_smooth_motion(spacing):
    error, sigma = misses(turn, spacing)
    ratio = np.sqrt((sigma**2).mean(0) / (error**2).mean(0))
    assert (ratio > 0.5).all() and (ratio < 2.0).all(), ratio


def test_sigma_is_larger_where_the_flight_is_rougher():
    calm, rough = turbulence(6), turbulence(7)

    def motion(t):
        (p, a), (q, b) = calm(t), rough(t)
        share = (1 / (1 + np.exp(20 - t)))[:, None]
        straight = np.stack([60 * t, 5 * t, 1000 + 0 * t], axis=1)
        return straight + 0.05 * (p - straight) + share * (q - straight), 0.05 * a + share * b

    times = np.arange(0, 40.01, 0.2)
    got = at_times(recorded(motion, times), np.array([5.1, 35.1]), ANY_GAP)
    assert (got.sigma_position[1] > 5 * got.sigma_position[0]).all()
    assert (got.sigma_attitude[1] > 5 * got.sigma_attitude[0]).all()


def test_velocity_and_rate_are_those_of_the_motion():
    times, at, tau = 0.05 * np.arange(RECORDS), np.linspace(1, 9, 40), 1e-4
    got = at_times(recorded(turn, times), at, ANY_GAP)
    velocity = (turn(at + tau)[0] - turn(at - tau)[0]) / (2 * tau)
    np.testing.assert_allclose(got.velocity, velocity, rtol=0, atol=2e-4)
    # The definition that `recorded_attitude` uses: what was recorded tau before still has rate * tau to turn.
    recorded_body, true_body = (_matrices(turn(at + shift)[1]) for shift in (0.0, tau))
    expected = true_body @ jax.jit(jax.vmap(small_rotation))(got.rate * tau)
    np.testing.assert_allclose(recorded_body, expected, rtol=0, atol=2e-8)
    assert np.abs(got.rate * tau).max() > 5e-6


def test_rate_has_the_signs_of_the_angles():
    """Nose up is about right, right wing down about forward, and a turn to the right is negative about up."""
    times = 0.1 * np.arange(RECORDS)
    got = at_times(
        recorded(lambda t: (np.zeros((len(t), 3)), np.outer(t, [0.02, 0.03, 0.05])), times), np.zeros(1), ANY_GAP
    )
    np.testing.assert_allclose(got.rate[0], [0.03, 0.02, -0.05], rtol=0, atol=1e-4)


def test_no_spline_runs_across_a_gap():
    early, late = np.arange(0, 10.0, 0.5), np.arange(60, 70.0, 0.5)
    wild = recorded(lambda t: (turn(t)[0] + 500.0 * (np.asarray(t)[:, None] > 30), turn(t)[1]), np.r_[early, late])
    alone = recorded(turn, early)
    at = np.linspace(0, 9.5, 40)
    for got, want in zip(at_times(wild, at, 2.0)[:4], at_times(alone, at, 2.0)[:4], strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-9)
    asked = np.array([-0.1, 0.0, 9.5, 9.6, 30.0, 60.0, 69.5, 69.6])
    np.testing.assert_array_equal(covered(wild, asked, 2.0), [False, True, True, False, False, True, True, False])
    assert covered(wild, np.array([30.0]), 100.0).all()


def test_angles_of_half_a_turn_and_signs_of_quaternions_do_not_matter():
    times, at = 0.4 * np.arange(RECORDS), np.linspace(0.1, 11.0, 30)
    trajectory = recorded(turn, times)
    flipped = trajectory.quaternion * np.where(np.arange(len(times)) % 3, 1, -1)[:, None]
    other = Trajectory(times, trajectory.position, flipped, trajectory.sigma_position, trajectory.sigma_attitude)
    for got, want in zip(at_times(other, at, ANY_GAP), at_times(trajectory, at, ANY_GAP), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)
    yaw = np.asarray(_angles(at_times(trajectory, at, ANY_GAP).object_from_body))[:, 2]
    assert (yaw < -3).any() and (yaw > 3).any()


def test_too_few_records_are_refused():
    with pytest.raises(ValueError, match="at least 9 records, got 8"):
        recorded(turn, np.arange(8.0))


def test_derivatives_with_respect_to_time():
    trajectory = recorded(turn, np.arange(0, 12.0, 0.5))

    def pose(time):
        got = interpolate(trajectory, jnp.reshape(time, 1), ANY_GAP)
        return got.position / 100, got.object_from_body

    check_derivatives(pose, np.array([0.3, 3.2, 7.77, 11.2]))
