"""Where a laser return lies by scanner and trajectory: known displacements, derivatives, and the splines of time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from jaxphoto.georeferencing import (
    ScannerCalibration,
    StripErrors,
    StripSpline,
    corrected_point,
    corrected_return,
    corrected_shot,
)
from tests.formulas import camera_from_object

POSITION, TURN = np.array([10.0, -20.0, 900.0]), camera_from_object(0.03, -0.05, 1.2)
SHOT = np.array([180.0, 15.0, -600.0])
NONE = np.zeros(3)
VELOCITY, RATE = np.array([40.0, 30.0, -1.0]), np.array([0.02, -0.05, 0.1])
RIGHT = ScannerCalibration(jnp.zeros(3), jnp.zeros(()), jnp.zeros(()), jnp.zeros(()), jnp.zeros(2))


def moved(pattern="line", **errors) -> np.ndarray:
    """How a shot of SHOT changes by errors of the scanner."""
    own = {"lever_arm": jnp.zeros(3)} | {name: jnp.asarray(value, float) for name, value in errors.items()}
    return np.asarray(corrected_shot(jnp.asarray(SHOT), ScannerCalibration(**own, pattern=pattern))) - SHOT


def test_ranges_that_are_too_long_are_shortened_along_the_shot():
    length = np.linalg.norm(SHOT)
    np.testing.assert_allclose(moved(range_offset=0.3), -0.3 * SHOT / length, atol=1e-12)
    np.testing.assert_allclose(moved(range_scale=50.0), -50e-6 * SHOT, atol=1e-12)


def test_angles_that_are_too_large_are_turned_back_about_the_forward_axis():
    right, forward, up = SHOT
    angle, across = np.arctan2(right, -up), np.hypot(right, up)

    def at(angle):
        return np.array([across * np.sin(angle), forward, -across * np.cos(angle)]) - SHOT

    np.testing.assert_allclose(moved(angle_scale=200.0), at(angle * (1 - 200e-6)), atol=1e-9)
    turn = 3e-4 * np.cos(angle) - 2e-4 * np.sin(angle)
    np.testing.assert_allclose(moved(eccentricity=(3e-4, -2e-4)), at(angle - turn), atol=1e-9)


def test_angles_all_around_are_turned_towards_the_nadir_and_about_it():
    right, forward, up = SHOT
    length, aside, around = np.linalg.norm(SHOT), np.hypot(right, forward), np.arctan2(right, forward)

    def at(angle, around):
        out = length * np.sin(angle)
        return np.array([out * np.sin(around), out * np.cos(around), -length * np.cos(angle)]) - SHOT

    angle = np.arctan2(aside, -up)
    found = moved("circle", angle_scale=200.0)
    np.testing.assert_allclose(found, at(angle * (1 - 200e-6), around), atol=1e-9)
    turn = 3e-4 * np.cos(around) - 2e-4 * np.sin(around)
    np.testing.assert_allclose(moved("circle", eccentricity=(3e-4, -2e-4)), at(angle, around - turn), atol=1e-9)


def test_prisms_that_deflect_too_much_scale_the_angle():
    """Two thin prisms of equal wedges deflect by delta each, to where they point: k more of it is k more of theta."""
    one, other = np.deg2rad(20.0), np.deg2rad(75.0)
    arrows = np.array([[np.sin(one), np.cos(one)], [np.sin(other), np.cos(other)]]).sum(axis=0)
    true, measured = (delta * arrows for delta in (0.1, 0.1 * (1 + 300e-6)))

    def shot(deflection):
        angle = np.linalg.norm(deflection)
        return 500.0 * np.append(np.sin(angle) * deflection / angle, -np.cos(angle))

    calibration = ScannerCalibration(jnp.zeros(3), angle_scale=300.0, pattern="circle")
    np.testing.assert_allclose(corrected_shot(jnp.asarray(shot(measured)), calibration), shot(true), atol=2e-5)


def test_an_offset_of_the_encoder_is_a_boresight_about_the_forward_axis():
    """An angle counts from the nadir to the right, a boresight from up to the right: their signs differ."""
    angle = np.arctan2(SHOT[0], -SHOT[2])
    # cos^2 + sin^2 = 1: at this angle, an offset of 1e-6 rad.
    found = POSITION + TURN @ (SHOT + moved(eccentricity=1e-6 * np.array([np.cos(angle), np.sin(angle)])))
    by_boresight = corrected_point(POSITION + TURN @ SHOT, POSITION, TURN, np.array([0.0, -1e-6, 0.0]), NONE)
    np.testing.assert_allclose(found, by_boresight, atol=1e-9)


def test_without_calibration_and_drift_a_return_is_a_corrected_point():
    point, boresight, shift = POSITION + TURN @ SHOT, np.array([3e-4, -2e-4, 5e-4]), np.array([0.2, -0.1, 0.3])
    expected = corrected_point(point, POSITION, TURN, boresight, shift)
    found = corrected_return(point, POSITION, TURN, NONE, NONE, shift, NONE, boresight, RIGHT)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_an_attitude_is_off_as_a_boresight_is():
    point, turn = POSITION + TURN @ SHOT, np.array([3e-4, -2e-4, 5e-4])
    one = corrected_return(point, POSITION, TURN, NONE, NONE, NONE, turn, NONE, RIGHT)
    other = corrected_return(point, POSITION, TURN, NONE, NONE, NONE, NONE, turn, RIGHT)
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_a_return_of_later_lies_where_the_scanner_was_later():
    """Straight on at the velocity, and turned on by the rate."""
    clock = ScannerCalibration(jnp.zeros(3), time_offset=jnp.asarray(0.01))
    found = corrected_return(POSITION + TURN @ SHOT, POSITION, TURN, VELOCITY, RATE, NONE, NONE, NONE, clock)
    later = TURN @ Rotation.from_rotvec(0.01 * RATE).as_matrix()
    np.testing.assert_allclose(found, POSITION + 0.01 * VELOCITY + later @ SHOT, atol=1e-9)
    assert np.linalg.norm((later - TURN) @ SHOT) > 0.1


@pytest.mark.parametrize("pattern", ["line", "circle"])
@pytest.mark.parametrize("shot", [SHOT, [0.0, 0.0, -500.0], [-400.0, 100.0, 30.0]])
def test_derivatives(shot, pattern):
    """Forward, reverse and central differences agree, at the nadir and above the horizon, too."""
    point = POSITION + TURN @ np.array(shot)

    def at(v):
        own = ScannerCalibration(v[9:12], v[12], 1e3 * v[13], 1e3 * v[14], v[15:17], v[17], pattern)
        return corrected_return(point, POSITION, TURN, VELOCITY, RATE, v[:3], v[3:6], v[6:9], own)

    compiled, start, step = jax.jit(at), np.linspace(-1e-3, 2e-3, 18), 1e-4
    forward, reverse = jax.jit(jax.jacfwd(at))(start), jax.jit(jax.jacrev(at))(start)
    differences = np.stack(
        [(compiled(start + step * e) - compiled(start - step * e)) / (2 * step) for e in np.eye(18)], 1
    )
    np.testing.assert_allclose(forward, reverse, atol=1e-9)
    np.testing.assert_allclose(forward, differences, atol=1e-5)
    # At the nadir a scale of angles moves nothing; nor does an angle about it.
    none = {"line": 2, "circle": 3}[pattern] if shot[0] == 0 else 0
    assert (np.abs(forward).max(axis=0) > 1e-3).sum() == 18 - none


def test_splines_are_those_of_scipy():
    spline, time = StripSpline.over(7, 100.0, 131.0, 4.0), np.linspace(100.0, 131.0, 200)
    knots, weights = spline.weights(time)
    assert knots.min() == 7 and knots.max() == 7 + spline.size - 1
    values = np.random.default_rng(1).normal(size=spline.size)
    nodes = spline.start + spline.interval * np.arange(-3, spline.size + 1)
    found = np.sum(weights * values[knots - 7], axis=1)
    np.testing.assert_allclose(found, BSpline(nodes, values, 3)(time), atol=1e-12)
    # A straight line in the times of the coefficients is one in time.
    np.testing.assert_allclose(np.sum(weights * spline.times[knots - 7], axis=1), time, atol=1e-10)


def test_one_knot_is_a_constant():
    knots, weights = StripSpline.constant(3).weights(np.array([0.0, 1e6]))
    assert (knots == 3).all()
    np.testing.assert_array_equal(weights.sum(axis=1), 1.0)


@pytest.mark.parametrize("strip", [0, 1, 2])
def test_what_is_compiled_takes_off_the_same(strip):
    """Inside a strip and beyond its ends, and of one knot alone."""
    splines = StripSpline.over(0, 100.0, 131.0, 4.0), StripSpline.over(11, 200.0, 203.0, 4.0), StripSpline.constant(15)
    position, attitude = np.random.default_rng(2).normal(size=(2, 16, 3))
    errors = StripErrors(splines, position, attitude, NONE, RIGHT)
    assert sum(spline.size for spline in splines) == len(position)
    time = np.linspace(95.0, 210.0, 300)
    found = errors.of_strip(strip).at(jnp.asarray(time))
    np.testing.assert_allclose(found, np.hstack(errors.at(strip, time)), atol=1e-12)
