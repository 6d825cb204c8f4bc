"""Unknowns that nothing in the block can see are refused before anything is compiled, by name and with the mend."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import FIXED, FREE, DatumError, InputError, RankError, Smac, Weighted
from jaxphoto.adjustment import solve
from jaxphoto.adjustment.arguments import check_arguments
from jaxphoto.block import Datum, Motion
from jaxphoto.compiling.lru_cache import LruCache
from jaxphoto.georeferencing import Mount, StripBias
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates
from tests.blocks import simulated
from tests.checked_types import unchecked


def with_mount(**priors):
    block = simulated("mount").block
    prior = dataclasses.replace(Mount(FIXED, FIXED, FIXED), **priors)
    return eqx.tree_at(lambda b: b.priors.mounts["imu"], block, prior, is_leaf=lambda x: isinstance(x, Mount))


def with_strips(block=None, **priors):
    block = simulated("strips").block if block is None else block
    trees = {name: priors.get(name, StripBias(FIXED, FIXED)) for name in "ab"}
    return dataclasses.replace(block, priors=dataclasses.replace(block.priors, strips=trees))


def without_attitudes(block):
    return dataclasses.replace(block, attitudes=Attitudes.none())


def without_stations(block):
    return dataclasses.replace(block, stations=CameraPositions.none())


def at_one_time(block):
    return dataclasses.replace(block, image_time=np.full(len(block.images), 5.0))


def moving(block):
    n = len(block.images)
    return dataclasses.replace(block, motion=Motion(np.ones((n, 3)), np.zeros((n, 3))))


def lone(what):
    """Strip c, of the last image alone."""
    block = simulated("strips").block
    block = dataclasses.replace(block, image_strip=(*block.image_strip[:-1], "c"))
    zero = StripBias(np.zeros(3), np.zeros(3))
    priors = {name: StripBias(FIXED, FIXED) for name in "ab"} | {"c": dataclasses.replace(zero, **what)}
    strips = block.start.unknowns.strips | {"c": zero}
    start = dataclasses.replace(block.start.unknowns, strips=strips)
    block = dataclasses.replace(block, priors=dataclasses.replace(block.priors, strips=priors))
    return eqx.tree_at(lambda b: b.start.unknowns, block, start, is_leaf=lambda x: x is block.start.unknowns)


def without_turns(block):
    return eqx.tree_at(lambda b: b.surfaces.turn, block, np.zeros((len(block.surfaces.point), 3)))


def without_second_strip(block):
    return dataclasses.replace(block, surfaces=block.surfaces.take(block.surfaces.strip == 0))


BOTH_SHIFTS = {name: StripBias(FREE, FIXED) for name in "ab"}
NO_CONTROL = {"control": ControlCoordinates.none(), "fixed": ControlCoordinates.none()}


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: lone({"shift": FREE, "drift": FREE}), RankError, ["strips[c].drift", "one image", "strip c"]),
        (lambda: lone({"shift": FIXED, "drift": FREE}), RankError, ["strips[c].drift", "one image"]),
        (
            lambda: at_one_time(with_strips(a=StripBias(FREE, FREE))),
            RankError,
            ["strips[a].drift", "one time", "give the times"],
        ),
        (
            lambda: without_stations(with_strips(a=StripBias(FREE, FIXED))),
            RankError,
            ["strips[a].shift", "no image with an observed station"],
        ),
        (
            lambda: without_attitudes(with_mount(boresight=FREE)),
            RankError,
            ["mounts[imu].boresight", "attitude", "fix the boresight"],
        ),
        (
            lambda: without_stations(with_mount(lever_arm=FREE)),
            RankError,
            ["mounts[imu].lever_arm", "station", "fix the lever arm"],
        ),
        (
            lambda: with_mount(time_offset=FREE),
            RankError,
            ["mounts[imu].time_offset", "motion", "fix the time offset"],
        ),
        (
            lambda: without_stations(without_attitudes(moving(with_mount(time_offset=FREE)))),
            RankError,
            ["mounts[imu].time_offset", "station or attitude"],
        ),
        (
            lambda: dataclasses.replace(with_strips(**BOTH_SHIFTS), **NO_CONTROL),
            DatumError,
            ["strips a, b", "no control", "add control points"],
        ),
        (
            lambda: without_turns(simulated("surfaces").block),
            RankError,
            ["scanner.boresight", "known positions of the scanner", "fix the boresight"],
        ),
        (
            lambda: without_second_strip(simulated("surfaces").block),
            RankError,
            ["scanner[l2].shift", "no point lies on a surface", "fix the shift"],
        ),
    ],
    ids=[
        "drift",
        "drift-alone",
        "drift-at-once",
        "shift",
        "boresight",
        "lever-arm",
        "motion",
        "time-offset",
        "shifts",
        "scanner-boresight",
        "scanner-shift",
    ],
)
def test_what_cannot_be_seen_is_named_before_anything_is_compiled(make, error, words, monkeypatch):
    monkeypatch.setattr("jaxphoto.adjustment.adjust._layouts", LruCache(1))
    monkeypatch.setattr("jaxphoto.adjustment.adjust.structure_of", None)
    monkeypatch.setattr("jaxphoto.adjustment.adjust.run_compiled", None)
    block = make()
    with pytest.raises(error) as caught:
        solve(block, block.start.unknowns, block.priors)
    assert all(word in str(caught.value) for word in words), str(caught.value)
    assert "\n" not in str(caught.value)


class _Passed(Exception):
    pass


@pytest.mark.parametrize(
    "make",
    [
        lambda: lone({"shift": FREE, "drift": FIXED}),
        lambda: lone({"shift": FREE, "drift": Weighted(np.zeros(3), 0.1)}),
        lambda: without_attitudes(with_mount(lever_arm=FREE)),
        lambda: without_attitudes(with_mount(boresight=Weighted(np.zeros(3), 0.01))),
        lambda: moving(with_mount(time_offset=FREE)),
        lambda: with_strips(**BOTH_SHIFTS),
        lambda: dataclasses.replace(with_strips(a=StripBias(FREE, FIXED)), **NO_CONTROL),
        lambda: dataclasses.replace(with_strips(**BOTH_SHIFTS), **NO_CONTROL, datum=Datum("inner")),
        lambda: dataclasses.replace(
            with_strips(**BOTH_SHIFTS), **NO_CONTROL, surfaces=simulated("surfaces").block.surfaces
        ),
        lambda: simulated("surfaces").block,
    ],
    ids=[
        "shift",
        "weighted-drift",
        "lever-arm",
        "weighted-boresight",
        "time-offset",
        "control",
        "one-shift",
        "inner",
        "surfaces",
        "scanner",
    ],
)
def test_what_can_be_seen_or_is_weighted_is_let_through(make, monkeypatch):
    def stop(*_):
        raise _Passed

    monkeypatch.setattr("jaxphoto.adjustment.adjust._layouts", LruCache(1))
    monkeypatch.setattr("jaxphoto.adjustment.adjust.structure_of", stop)
    block = make()
    with pytest.raises(_Passed):
        solve(block, block.start.unknowns, block.priors)


# Arguments that do not belong together -----------------------------------------------------------------------


def _other_distortion(block):
    return eqx.tree_at(lambda b: b.start.unknowns.interior["one"].distortion, block, Smac())


def _nan(where):
    def changed(block):
        values = np.array(where(block), float)
        values.flat[4] = np.nan
        return eqx.tree_at(where, block, values)

    return changed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_other_distortion, r"interior\[one\].distortion: priors have Brown, start has Smac; .* block.with_distortion"),
        (_nan(lambda b: b.stations.value), "stations: the value of station of image .* is NaN"),
        (_nan(lambda b: b.image_points.xy), "image_points: the value of point .* in image .* is NaN"),
        (_nan(lambda b: b.control.sigma), "control_points: the sigma of control point .* is NaN"),
        (_nan(lambda b: b.start.unknowns.points), r"start.points\[1\]\[1\] \(of .*\) is NaN"),
    ],
)
def test_blocks_that_cannot_be_computed_are_named(change, message):
    block = change(simulated("cross").block)
    with pytest.raises(InputError, match=message):
        check_arguments(block, block.start.unknowns, block.priors)


def test_trees_of_another_kind_are_named():
    block = simulated("cross").block
    start = block.start.unknowns
    for wrong, message in (
        (block.start, "start is of the type Start: give Unknowns, such as adjusted.unknowns"),
        (dataclasses.replace(start, interior={"two": start.interior["one"]}), "start lacks camera 'one' .* two"),
        (dataclasses.replace(start, points=start.points[:-1]), r"start.points has the shape \(\d+, 3\), the block"),
    ):
        with pytest.raises(InputError, match=message):
            check_arguments(block, wrong, block.priors)


def test_lists_are_arrays():
    with unchecked():
        rows = ControlCoordinates([0, 1], [2, 2], [1.0, 2.0], [0.1, 0.1])
        assert rows.value.dtype == float and rows.who.dtype.kind == "i"
        assert Mount([0.1, 0.2, 0.3], [0.0, 0.0, 0.0]).lever_arm.shape == (3,)
