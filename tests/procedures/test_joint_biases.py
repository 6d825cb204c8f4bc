"""Trajectory errors applied to the data and as errors of a Monte Carlo have the same effects."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import InputError, adjust, bias, covariance, monte_carlo, readjust
from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.georeferencing import TrajectoryKnot, strip_of_knot
from jaxphoto.observations import StripPlanes, StripPoints, TrajectoryAttitudes, TrajectoryStations
from jaxphoto.parameters import numbers_of
from jaxphoto.rotation import roll_pitch_yaw_from_matrix
from jaxphoto.sensitivity import response, sensitivity, station_bias
from jaxphoto.unknowns import FIXED
from tests.procedures.joint import fitted, flown
from tests.procedures.test_joint_adjustment import small, turned

OFF_M, OFF_RAD = np.array([0.06, -0.04, 0.1]), np.array([5e-5, -4e-5, 8e-5])
# Of roll, pitch and yaw, in the order of the matrix's own function.
ANGLES = np.vectorize(lambda matrix: np.asarray(roll_pitch_yaw_from_matrix(matrix)), signature="(3,3)->(3)")


def in_strip(block: Block, strip: str, knots: np.ndarray) -> np.ndarray:
    names = list(block.start.unknowns.more["trajectory_knots"])
    return np.array([strip in ("block", strip_of_knot(names[k])) for k in knots[:, 0]])


def moved(place, scanner, angles, own, off_m, off_rad):
    """A place of a strip, and the scanner's pose, as a trajectory gives them that is off by so much."""
    right = turned(angles)
    wrong = right @ small(np.tile(off_rad, (len(right), 1))).transpose(0, 2, 1)
    shot = np.einsum("nji,nj->ni", right, place - scanner)
    there = scanner + off_m + np.einsum("nij,nj->ni", wrong, shot)
    pairs = (there, place), (scanner + off_m, scanner), (ANGLES(wrong), angles)
    return [np.where(own[:, None], new, old) for new, old in pairs]


def wrong_data(block: Block, strip: str, off_m, off_rad) -> Block:
    """All that the trajectory of a strip, or of all ("block"), has gone into, computed with another one."""
    more = []
    for of in block.more:
        changed = {}
        for side in ("_a", "_b") if isinstance(of, StripPlanes) else ("",):
            if isinstance(of, StripPlanes | StripPoints):
                names = ["point" + side if side else "foot", "scanner" + side, "roll_pitch_yaw" + side]
                own = in_strip(block, strip, getattr(of, "knots" + side))
                given = (np.asarray(getattr(of, name)) for name in names)
                changed |= dict(zip(names, moved(*given, own, off_m, off_rad), strict=True))
        if isinstance(of, TrajectoryStations):
            changed["value"] = of.value + off_m[of.axis] * in_strip(block, strip, of.knots)
        if isinstance(of, TrajectoryAttitudes):
            own = in_strip(block, strip, of.knots)
            wrong = turned(of.roll_pitch_yaw) @ small(np.tile(off_rad, (len(of), 1))).transpose(0, 2, 1)
            changed["roll_pitch_yaw"] = np.where(own[:, None], ANGLES(wrong), of.roll_pitch_yaw)
        more.append(dataclasses.replace(of, **changed))
    return dataclasses.replace(block, more=tuple(more))


def nominal() -> Adjustment:
    return fitted().adjusted


def estimates(adjusted: Adjustment) -> np.ndarray:
    return np.asarray(adjusted.values.shared)[adjusted.structure.free]


def in_sigmas(change: np.ndarray) -> np.ndarray:
    return change / np.asarray(fitted().covariance.shared_sigma)


def anew(block: Block) -> Adjustment:
    return adjust(block, nominal().unknowns, block.priors)


def of_knots(kind: str, strip: str, off: np.ndarray) -> np.ndarray:
    """What knots that are counted from the wrong trajectory have more than those from the right one."""
    knots = nominal().unknowns.more["trajectory_knots"]
    more = np.zeros((len(knots), 2, 3))
    more[[strip in ("block", strip_of_knot(name)) for name in knots], int(kind != "trajectory")] = off
    labels = nominal().structure.labels
    first = min(k for k, label in enumerate(labels) if label.startswith("trajectory_knots"))
    return np.concatenate([np.zeros(first), more.ravel(), np.zeros(len(labels) - first - more.size)])


BIASES = {"trajectory": OFF_M, "trajectory-attitude": OFF_RAD}


@pytest.mark.parametrize("strip", ["block", "2"])
@pytest.mark.parametrize("kind", BIASES)
def test_a_bias_of_the_trajectory_is_that_of_its_data(kind, strip):
    block, off, none = nominal().block, BIASES[kind], np.zeros(3)
    errors = bias(block, kind, 1.0, "block" if strip == "block" else "strip", of=[strip])
    drawn = anew(errors.applied(jnp.asarray(off), block))
    made = anew(wrong_data(block, strip, *((off, none) if kind == "trajectory" else (none, off))))
    expected = in_sigmas(estimates(made) - estimates(nominal()))
    # Attitudes to first order: products of angles are a ten-thousandth of these.
    change = in_sigmas(estimates(drawn) - estimates(nominal()) + of_knots(kind, strip, off))
    np.testing.assert_allclose(change, expected, atol=1e-3)
    np.testing.assert_allclose(drawn.unknowns.points, made.unknowns.points, atol=1e-5)
    camera = [k for k, label in enumerate(nominal().structure.labels) if not label.startswith("trajectory_knots")]
    if (kind, strip) == ("trajectory", "block"):
        # Nothing tells of it: all the ground goes with it.
        assert np.abs(expected[camera]).max() < 1e-3
        rise = np.asarray(drawn.unknowns.points) - np.asarray(nominal().unknowns.points)
        np.testing.assert_allclose(rise, np.broadcast_to(off, rise.shape), atol=1e-5)
    else:
        assert np.abs(expected[camera]).max() > 0.3


@pytest.mark.slow
def test_draws_and_exact_sensitivity_know_them():
    """Draws are what adjusting anew gives, derivatives what small changes give."""
    block = nominal().block
    kinds = {"trajectory": (0.05, "strip"), "trajectory-attitude": (5e-5, "strip"), "station": (0.05, "strip"),
             "attitude": (5e-5, "strip")}  # fmt: skip
    several = [bias(block, kind, sigma, per) for kind, (sigma, per) in kinds.items()]

    def perturb(key, block):
        recorded = {}
        for k, errors in enumerate(several):
            block, own = errors(jax.random.fold_in(key, k), block)
            recorded |= {f"{k}.{name}": error for name, error in own.items()}
        return block, recorded

    draws = monte_carlo(nominal(), perturb, 2, seed=3)
    assert draws.converged.all() and not draws.fallback.any() and len(draws.recorded) == 4 * 9
    assert {name.split(".")[1] for name in draws.recorded} == {"1", "2", "3", "A", "B", "C"}
    changed, _ = perturb(jax.random.fold_in(jax.random.key(3), 0), block)
    # Adjustments end within 1e-5 of their own.
    np.testing.assert_allclose(in_sigmas(draws.shared[0] - estimates(anew(changed))), 0.0, atol=5e-5)
    assert np.abs(in_sigmas(draws.shared[0] - estimates(nominal()))).max() > 0.5
    # Where the trajectory of a strip is held, too.
    held = dataclasses.replace(block, priors=with_held(block, "2"))
    errors = bias(held, "trajectory", 0.05, "strip", of="2")
    fixed = adjust(held, nominal().unknowns, held.priors)
    one = np.array([0.02, -0.01, 0.03])
    draw = readjust(fixed, errors.applied, one[None])
    made = wrong_data(held, "2", one, np.zeros(3))
    sigma = np.asarray(covariance(fixed).shared_sigma)
    assert np.abs((draw.shared[0] - estimates(adjust(made, fixed.unknowns, held.priors))) / sigma).max() < 1e-4


def with_held(block: Block, strip: str):
    knots = block.priors.more["trajectory_knots"]
    held = {
        name: TrajectoryKnot(FIXED, FIXED) if strip_of_knot(name) == strip else known for name, known in knots.items()
    }
    return dataclasses.replace(block.priors, more=block.priors.more | {"trajectory_knots": held})


@pytest.mark.slow
def test_exact_changes_are_those_of_small_biases():
    block, labels = nominal().block, nominal().structure.labels
    small_m = np.array([0.0, 0.0, 1e-3])
    found = station_bias(nominal(), sensitivity(nominal()), "strip", 1.0)
    assert found.units == ("A", "B", "C")
    at = slice(6 * len(block.images), None)
    for errors, change in (
        (bias(block, "station", 1.0, "strip", of="B"), found.change[at, 1, 2] * 1e-3),
        (bias(block, "trajectory", 1.0, "strip", of="2"), None),
    ):
        both = [anew(errors.applied(jnp.asarray(s * small_m), block)) for s in (1.0, -1.0)]
        expected = in_sigmas((estimates(both[0]) - estimates(both[1])) / 2)
        if change is None:
            moved = errors.applied(jnp.asarray(small_m), block)
            exact = response(nominal(), moved, priors=moved.priors).unknowns
            change = np.array([shared_of(exact, label) for label in labels])
        np.testing.assert_allclose(in_sigmas(change), expected, atol=1e-4)
        assert np.abs(expected).max() > 1e-3


def shared_of(unknowns, label: str) -> float:
    """A change by the label of its unknown."""
    table = {}
    for camera, own in unknowns.interior.items():
        table |= {f"interior[{camera}].{name}": get_parameter(own, name) for name in parameter_names(own)}
    for owners in unknowns.tables.values():
        for owner, own in owners.items():
            table |= dict(zip(own.labels(owner), numbers_of(own), strict=True))
    return float(table[label])


def test_what_cannot_have_a_bias():
    block = nominal().block
    with pytest.raises(InputError, match=r"unknown strip 'A' for a bias of kind trajectory: .* 1, 2, 3"):
        bias(block, "trajectory", 0.1, "strip", of="A")
    with pytest.raises(InputError, match="per block or strip, not per image"):
        bias(block, "trajectory", 0.1, "image")
    with pytest.raises(InputError, match="has no trajectory of a laser scanner"):
        bias(flown().block, "trajectory", 0.1)
