"""What was left out is told as what it is: single errors, or one that many rows have in common."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from jaxphoto import read_block, snoop
from jaxphoto.observations import Distances
from jaxphoto.report.findings import Level
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


def test_a_group_all_of_whose_rows_go_is_told(block):
    """A single scale bar, which nothing is left of."""
    control = block.control
    ends = np.array([block.points.index(name) for name in ("T1", "T3")])
    one, other = (np.asarray(control.value)[control.who == p] for p in ends)
    bar = Distances(ends[None], np.array([np.linalg.norm(one - other) + 5.0]), np.array([0.02]))
    found = snoop(dataclasses.replace(block, distances=bar))
    (left,) = found.left_out
    assert left.group == "distances" and abs(left.error - 5.0) < 1.0


def test_what_is_too_much_to_be_single_errors_is_an_alarm(block):
    """x and y of an image exchanged."""
    rows = block.image_points
    xy, mine = np.array(rows.xy), rows.image == block.images.index("A3")
    xy[mine] = xy[mine][:, ::-1]
    spoilt = block.with_observations({"image_points": dataclasses.replace(rows, xy=xy)})
    first = snooped_findings(snoop(spoilt), spoilt)[0]
    assert first.level == Level.ALARM and "most image points of image A3 (33 of 36) are left out" in first.text
