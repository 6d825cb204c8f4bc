"""The datum: what observations leave open is counted and named; closing it changes nothing that can be estimated."""

import dataclasses
import re

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import FIXED, FREE, DatumError, adjust
from jaxphoto.adjustment.datum_messages import MOTIONS
from jaxphoto.block import Datum
from jaxphoto.georeferencing import StripBias
from jaxphoto.observations import CameraPositions, ControlCoordinates, Distances
from tests.adjustment.dense import with_constraints
from tests.blocks import (
    BROWN,
    adjusted,
    aerial,
    all_attitudes,
    all_stations,
    bare,
    covariance_of,
    measured,
    rows,
    simulated,
)

SHIFTS, ROTATIONS = set(MOTIONS[:3]), set(MOTIONS[3:6])
BARE = bare(aerial(), {"one": BROWN}, ("one",) * 10)


def block_with(**observations):
    """The aerial block with only these observations beside image points, at its true values."""
    observations.setdefault("stations", CameraPositions.none())
    return measured(BARE._replace(block=dataclasses.replace(BARE.block, **observations))).block


def defect_of(block):
    """Defect and motions that the sentence names."""
    with pytest.raises(DatumError) as caught:
        with_constraints(block)
    text = str(caught.value)
    count = int(re.search(r"defect of (\d)", text)[1])
    return count, {m for m in MOTIONS if re.search(rf"\b{m}\b", text.split(" cannot be")[0])}, text


BAR = Distances(np.array([[3, 37]]), np.zeros(1), np.array([0.01]))


def test_image_coordinates_alone_leave_seven():
    count, named, text = defect_of(block_with())
    assert (count, named) == (7, set(MOTIONS))
    assert "image coordinates alone" in text
    assert '[datum] kind = "inner"' in text


def test_a_scale_bar_leaves_six():
    count, named, text = defect_of(block_with(distances=BAR))
    assert (count, named) == (6, set(MOTIONS) - {"scale"})
    assert "1 distance;" in text


def test_attitudes_leave_shifts_and_scale():
    count, named, _ = defect_of(block_with(attitudes=all_attitudes(BARE.block)))
    assert (count, named) == (4, SHIFTS | {"scale"})


def test_one_control_point_leaves_rotations_and_scale():
    count, named, _ = defect_of(block_with(control=rows((20,))))
    assert count == 4
    assert named >= ROTATIONS | {"scale"}


def test_two_control_points_leave_a_rotation_about_their_line():
    """Two points along X at one height: a turn about X; scale and the other turns are seen."""
    points = np.array(BARE.truth.points)
    points[37] = points[3] + [300.0, 0.0, 0.0]
    control = rows((3, 37))
    surveyed = points[control.who, control.axis]
    block = eqx.tree_at(lambda b: b.control.value, block_with(control=control), surveyed)
    count, named, _ = defect_of(block)
    assert count == 1
    assert "rotation about X" in named
    assert named.isdisjoint({"rotation about Y", "rotation about Z", "scale"})


def test_control_in_height_only():
    """Three heights are a plane, which any scale keeps; more of them, on relief, give the scale."""
    count, named, _ = defect_of(block_with(control=rows((3, 4, 20), (2,))))
    assert count == 4
    assert named >= {"shift in X", "shift in Y", "rotation about Z", "scale"}
    count, named, _ = defect_of(block_with(control=rows((3, 4, 20, 36, 37), (2,))))
    assert (count, named) == (3, {"shift in X", "shift in Y", "rotation about Z"})


def stations_at(places):
    stations = rows(range(len(places)), sigma=0.1, kind=CameraPositions)
    block = block_with(stations=stations)
    return eqx.tree_at(lambda b: b.stations.value, block, places[stations.who, stations.axis])


def test_stations_on_a_line_leave_a_rotation():
    """Whatever the approximate positions; with noise in the stations, too, which closes it by nothing but itself."""
    line = np.linspace([-400.0, 0.0, 1000.0], [400.0, 0.0, 1000.0], 5)
    count, named, _ = defect_of(stations_at(line))
    assert count == 1
    assert "rotation about X" in named
    with pytest.raises(DatumError, match=r"nearly undetermined: rotation about X cannot .* off the line") as caught:
        with_constraints(stations_at(line + 0.1 * np.random.default_rng(3).standard_normal(line.shape)))
    # What it is said to be known to follows from how far the stations are off the line.
    assert 5 < float(re.search(r"than to (\S+) deg", str(caught.value))[1]) < 60
    # One station beside the line closes it.
    with_constraints(stations_at(line + np.eye(5)[:, 2:3] * [0.0, 30.0, 0.0]))


def test_free_shifts_leave_the_position():
    strips = {name: StripBias(np.zeros(3), np.zeros(3)) for name in "ab"}
    block, truth = bare(aerial(), {"one": BROWN}, ("one",) * 10, strips=strips)
    block = dataclasses.replace(block, stations=all_stations(block))
    shifted = eqx.tree_at(lambda b: b.priors.strips, block, {name: StripBias(FREE, FIXED) for name in "ab"})
    count, named, text = defect_of(measured(type(BARE)(shifted, truth)).block)
    assert (count, named) == (3, SHIFTS)
    assert "strips[a].shift_X_m" in text
    # One shift alone, or one control point, closes it.
    with_constraints(measured(type(BARE)(eqx.tree_at(lambda b: b.priors.strips["a"].shift, block, FREE), truth)).block)
    with_constraints(measured(type(BARE)(dataclasses.replace(shifted, control=rows((20,))), truth)).block)


@pytest.mark.parametrize(
    "observations",
    [
        {"control": rows((3, 4, 37))},
        {"control": ControlCoordinates.joined(rows((3, 4), (0, 1)), rows((3, 20, 36), (2,)))},
        {"fixed": rows((3, 4, 37), sigma=0.0)},
        {"stations": rows(range(10), sigma=0.1, kind=CameraPositions)},
        {"attitudes": all_attitudes(BARE.block), "control": rows((20,)), "distances": BAR},
    ],
    ids=["full", "plan-and-height", "fixed", "stations", "attitudes-and-bar"],
)
def test_what_closes_the_datum(observations):
    values, _ = with_constraints(block_with(**observations))
    assert values.datum_points.shape[0] == 0


@pytest.mark.parametrize("kind", ["inner", "minimal"])
def test_constraints_fill_the_defect_and_no_more(kind):
    for observations, defect in (({}, 7), ({"distances": BAR}, 6), ({"control": rows((3, 37))}, 1)):
        values, _ = with_constraints(dataclasses.replace(block_with(**observations), datum=Datum(kind)))
        assert values.datum_points.shape[0] == defect


@pytest.mark.parametrize(
    ("datum", "distances", "words"),
    [
        (Datum("inner", "points", True), BAR, "scale = true"),
        (Datum("inner", "points", False), Distances.none(), "scale = false"),
        (Datum("inner", ("p3",)), BAR, "cannot fix the datum"),
        (Datum("inner", ("p3", "p4")), BAR, "cannot fix the datum"),
    ],
)
def test_constraints_that_cannot_be(datum, distances, words):
    with pytest.raises(DatumError, match=words):
        with_constraints(dataclasses.replace(block_with(distances=distances), datum=datum))


@pytest.mark.parametrize("name", ["inner_images", "inner_some", "minimal"])
def test_what_can_be_estimated_does_not_depend_on_the_datum(name):
    one, other = adjusted("inner"), adjusted(name)
    assert float(one.sigma0) == pytest.approx(float(other.sigma0), rel=1e-9)
    assert one.redundancy == other.redundancy == 414
    np.testing.assert_allclose(other.residuals.image, one.residuals.image, atol=1e-4)
    np.testing.assert_allclose(other.residuals["distances"], one.residuals["distances"], atol=1e-4)
    sigma = np.asarray(covariance_of("inner").shared_sigma)
    np.testing.assert_allclose(covariance_of(name).shared_sigma, sigma, rtol=1e-6)
    free_of = lambda a: np.asarray(a.values.shared)[a.structure.free]  # noqa: E731
    np.testing.assert_array_less(np.abs(free_of(one) - free_of(other)) / sigma, 3e-5)
    # Coordinates and their sigmas do depend on it.
    assert np.abs(np.asarray(one.unknowns.points) - np.asarray(other.unknowns.points)).max() > 1e-4
    sigmas = [np.asarray(covariance_of(n).point_sigma) for n in ("inner", name)]
    assert np.abs(sigmas[1] / sigmas[0] - 1).max() > 0.1


def test_minimal_constraints_hold_coordinates_at_their_start():
    sigma = np.asarray(covariance_of("minimal").point_sigma)
    # The variance is a difference: what rounding leaves of it is below 1e-8 of the others.
    held = sigma < 1e-4 * np.median(sigma)
    assert held.sum() == 6
    moved = np.asarray(adjusted("minimal").unknowns.points) - simulated("minimal").block.start.unknowns.points
    np.testing.assert_allclose(moved[held], 0.0, atol=1e-9)
    assert np.abs(moved[~held]).min() > 1e-6


def test_scale_bars_give_the_scale():
    """Halve the bars and their sigmas, and every distance between points halves."""
    block = adjusted("inner").block
    where = lambda b: (b.distances.value, b.distances.sigma)  # noqa: E731
    half = eqx.tree_at(where, block, tuple(0.5 * np.asarray(v) for v in where(block)))
    small, large = (
        np.linalg.norm(np.diff(np.asarray(a.unknowns.points), axis=0), axis=1)
        for a in (adjust(half, block.start.unknowns), adjusted("inner"))
    )
    np.testing.assert_allclose(small / large, 0.5, rtol=1e-6)
