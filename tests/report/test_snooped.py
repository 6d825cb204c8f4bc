"""What was left out is told as what it is: single errors, or one that many rows have in common."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from jaxphoto import read_block, snoop
from jaxphoto.report.snooped import snooped_findings


@pytest.fixture(scope="module")
def block():
    return read_block(Path(__file__).parents[2] / "examples" / "cross_block")


def test_the_shift_of_a_strip_is_told_as_one(block):
    rows = block.stations
    in_b = np.array(block.image_strip)[rows.who] == "B"
    value = np.asarray(rows.value) + np.where(in_b & (rows.axis == 2), 3.0, 0.0)
    spoilt = block.with_observations({"stations": dataclasses.replace(rows, value=value)})
    first, *others = snooped_findings(snoop(spoilt), spoilt)
    n = int((in_b & (rows.axis == 2)).sum())
    assert f"{n} of the {n} stations in strip B along Z" in first.text and "by +3" in first.text
    assert all("left out: station of image B" in f.text for f in others[:3])


def test_single_errors_are_no_shift(block):
    rows = block.stations
    wrong = np.flatnonzero((np.array(block.image_strip)[rows.who] == "B") & (rows.axis == 2))[:5]
    value = np.array(rows.value)
    value[wrong] += [4.0, -3.0, 6.0, -5.0, 3.0]
    spoilt = block.with_observations({"stations": dataclasses.replace(rows, value=value)})
    texts = [f.text for f in snooped_findings(snoop(spoilt), spoilt)]
    assert len(texts) == 5 and not any("alike" in text for text in texts)
