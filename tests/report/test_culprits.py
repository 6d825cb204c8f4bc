"""The likeliest culprit stands first: what the model lacks accuses sound observations."""

import dataclasses
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import adjust, read_block
from jaxphoto.camera import set_parameter
from jaxphoto.report import Tables, verdict_of
from jaxphoto.report.findings import Level
from tests.blocks import simulated


@pytest.fixture(scope="module")
def without_k2():
    """k2 of another lens, held at zero, and one image point that is far off."""
    block = simulated("cross").block
    xy = np.array(block.image_points.xy)
    xy[20] += 60 * np.asarray(block.image_points.sigmas)[20]
    interior = set_parameter(block.start.unknowns.interior["one"], "k2", 0.0)
    block = eqx.tree_at(lambda b: (b.image_points.xy, b.start.unknowns.interior["one"]), block, (xy, interior))
    return verdict_of(Tables(adjust(block.fix("k2"))))


def test_a_term_that_is_held_is_told_before_the_observations_that_it_accuses(without_k2):
    assert without_k2.colour == "red"
    first = next(k for k, text in enumerate(without_k2.texts) if "k2, which is held: free it" in text)
    accused = [k for k, text in enumerate(without_k2.texts) if "contradicts the other observations" in text]
    assert accused and first < min(accused)


def test_parameters_are_called_as_people_call_them(without_k2):
    told = " ".join(without_k2.texts)
    assert "k1 of camera one would move by" in told or "c_mm of camera one would move by" in told
    assert "interior[" not in told


def test_a_strip_that_is_off_is_told_before_its_stations():
    """By 3 m along X; most of its stations are suspects, each alone."""
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    rows = block.stations
    off = np.array([block.image_strip[k] == "A" for k in rows.who]) & (rows.axis == 0)
    spoilt = dataclasses.replace(rows, value=np.asarray(rows.value) + 3.0 * off)
    first, second, *_ = verdict_of(Tables(adjust(block.with_observations({"stations": spoilt})))).findings
    assert first.level == second.level == Level.ALARM
    assert "X of strip A" in first.text and "station of image A" in second.text


def test_stations_that_are_off_each_by_itself_are_no_strip():
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    rows = block.stations
    value = np.array(rows.value)
    for name, error in (("A2", 4.0), ("A3", -5.0), ("A5", 3.0), ("A6", -4.0)):
        value[(rows.who == block.images.index(name)) & (rows.axis == 0)] += error
    spoilt = block.with_observations({"stations": dataclasses.replace(rows, value=value)})
    first = verdict_of(Tables(adjust(spoilt))).findings[0]
    assert "station of image A" in first.text and "contradicts" in first.text


def test_of_a_drift_the_strips_that_show_it_are_told():
    """3 m along Y from the first image to the last: no strip is most of it."""
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    rows, time = block.stations, np.asarray(block.flight_time)
    drift = 3.0 * (time - time.min()) / np.ptp(time)
    value = np.asarray(rows.value) + np.where(rows.axis == 1, drift[rows.who], 0.0)
    spoilt = block.with_observations({"stations": dataclasses.replace(rows, value=value)})
    (said,) = [t for t in verdict_of(Tables(adjust(spoilt))).texts if "from strip to strip follow a pattern" in t]
    assert "each alone Y of strip D +2.5" in said and "Y of strip C" in said
