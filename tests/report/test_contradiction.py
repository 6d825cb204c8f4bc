"""Files by another convention: the group that contradicts all others, and the correction that restores it."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import Tables, adjust
from jaxphoto.procedures.contradiction import contradicting_group
from jaxphoto.report import verdict_of
from tests.blocks import calibration_flight

# By name: group, its values by the convention, from the true ones (degrees, metres), and what the finding must name.
ATTITUDES = {
    "radians": (np.deg2rad, ["radians"]),
    "counter-clockwise": (lambda a: a * [1, 1, -1], ["yaw_deg"]),
    "from east": (lambda a: [0, 0, 90] - a * [-1, -1, 1], ["yaw_deg", "+90 deg"]),
    "pitch": (lambda a: a * [1, -1, 1], ["pitch_deg"]),
    "exchanged": (lambda a: a[:, [1, 0, 2]], ["roll_deg and pitch_deg"]),
}
NAMES = ("roll_deg", "pitch_deg", "yaw_deg")


@pytest.mark.parametrize("name", ATTITUDES)
def test_a_convention_of_the_attitudes_is_named(name):
    change, words = ATTITUDES[name]
    block, *_ = calibration_flight()
    rows = block.attitudes
    changed = np.deg2rad(np.asarray(change(np.rad2deg(np.asarray(rows.roll_pitch_yaw))), float))
    adjusted = adjust(block.with_observations({"attitudes": dataclasses.replace(rows, roll_pitch_yaw=changed)}))
    found = contradicting_group(adjusted)
    assert found.groups == ("attitudes",) and found.others == () and found.sigma0 == pytest.approx(1.0, abs=0.15)
    assert all(word in found.explanation for word in words)
    assert {n for n in NAMES if n in found.explanation} == {n for n in NAMES if any(n in word for word in words)}
    # Nothing else is accused.
    findings = [f for f in verdict_of(Tables(adjusted)).findings if f.severity == "error"]
    assert {f.code for f in findings} <= {"contradicting_group", "not_converged"} and findings[0].subject == "attitudes"


def with_positions(change):
    block, *_ = calibration_flight()
    rows = block.stations
    table = np.full((len(block.images), 3), np.nan)
    table[rows.who, rows.axis] = rows.value
    value = change(table, block)[rows.who, rows.axis]
    return adjust(block.with_observations({"stations": dataclasses.replace(rows, value=value)}))


def placeholders(table, block):
    wrong = [block.images.index(name) for name in ("E1_03", "N2_02")]
    table[wrong] = -9999.0
    return table


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (placeholders, ["E1_03", "N2_02"]),
        (lambda table, block: table * [1, 1, 0], ["Z_m, which is 0 in all rows"]),
        (lambda table, block: np.roll(table, 1, axis=0), ["1 image before"]),
        (lambda table, block: table[:, [1, 0, 2]], ["X and Y exchanged"]),
    ],
    ids=["placeholders", "no heights", "missing event", "exchanged"],
)
def test_wrong_positions_are_named(change, words):
    found = contradicting_group(with_positions(change))
    assert found.groups == ("stations",) and found.sigma0 == pytest.approx(1.0, abs=0.15)
    assert all(word in found.explanation for word in words)


def test_positions_and_attitudes_on_a_wrong_clock_are_named_together():
    block, *_ = calibration_flight()
    stations, attitudes = block.stations, block.attitudes
    rng = np.random.default_rng(4)
    order = rng.permutation(len(block.images))
    wrong = {
        "stations": dataclasses.replace(stations, who=order[stations.who]),
        "attitudes": dataclasses.replace(attitudes, image=order[attitudes.image]),
    }
    found = contradicting_group(adjust(block.with_observations(wrong)))
    assert found.groups == ("stations", "attitudes") and found.sigma0 == pytest.approx(1.0, abs=0.15)


def test_observations_that_agree_contradict_nothing():
    """A group without which the others agree is reported only if the whole does not."""
    block, *_ = calibration_flight()
    assert not any(f.code == "contradicting_group" for f in verdict_of(Tables(adjust(block))).findings)
