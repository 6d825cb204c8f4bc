"""What a whole group of observations gets wrong: its standard deviations, and an error that all have in common."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from jaxphoto import adjust, covariance, read_block, significance


@pytest.fixture(scope="module")
def block():
    return read_block(Path(__file__).parents[2] / "examples" / "cross_block")


def test_standard_deviations_of_few_are_judged_although_all_together_fit(block):
    """Those of control a thousand times too large: sigma naught is of image points, and does not show it."""
    control = block.control
    vague = dataclasses.replace(control, sigma=np.full(len(control), 30.0))
    verdict = adjust(block.with_observations({"control_points": vague})).verdict()
    assert verdict.colour == "amber"
    assert any(f.code == "group_sigma" and f.subject == "control points" for f in verdict.findings)
    assert adjust(block).verdict().colour == "green"


def test_how_large_an_error_in_common_may_be_unseen_is_what_it_does(block):
    """1.5 m in the heights of all stations shows nowhere, and moves c by what the sentence says."""
    sound = adjust(block)
    (finding,) = [f for f in sound.verdict().findings if f.code == "common_bias"]
    assert finding.subject == "stations as a whole" and finding.numbers["term"] == "Z"
    seen, moved = finding.value, finding.numbers["moved"]
    rows, shift = block.stations, 0.2 * seen
    value = np.asarray(rows.value) + np.where(rows.axis == 2, shift, 0.0)
    off = adjust(block.with_observations({"stations": dataclasses.replace(rows, value=value)}))
    assert off.verdict().colour == "green"
    c, other = (float(a.unknowns.interior["kodak"].c) for a in (sound, off))
    (sigma,) = [s.sigma for s in significance(sound, covariance(sound)) if s.parameter == "c_mm"]
    assert abs(other - c) / sigma == pytest.approx(0.2 * moved, rel=0.1)
