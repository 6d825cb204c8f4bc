"""Findings on rejected observations: single errors, or one common error of many rows."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import snoop
from jaxphoto.initial.approximate import in_front, looking_away
from jaxphoto.observations import Distances
from jaxphoto.procedures.snooping import Snooped
from jaxphoto.report import Tables, verdict_of
from jaxphoto.report.residual_findings import snooped_findings
from jaxphoto.statistics import Suspect, covariance
from jaxphoto.statistics.systematic_effects import truncated_inverse
from tests.blocks import adjusted, adjusted_example, example


@pytest.fixture(scope="module")
def block():
    return example()


def test_the_shift_of_a_strip_is_one_finding(block):
    rows = block.stations
    in_b = np.array(block.image_strip)[rows.who] == "B"
    value = np.asarray(rows.value) + np.where(in_b & (rows.axis == 2), 3.0, 0.0)
    spoilt = block.with_observations({"stations": dataclasses.replace(rows, value=value)})
    first, *others = snooped_findings(snoop(spoilt), spoilt)
    n = int((in_b & (rows.axis == 2)).sum())
    assert first.code == "rejected_bias" and first.subject == "stations in strip B along Z"
    assert first.value == first.numbers["n"] == n and first.numbers["bias"] == pytest.approx(3.0, abs=0.5)
    assert all(f.subject.startswith("station of image B") for f in others[:3])


def test_single_errors_are_no_shift(block):
    rows = block.stations
    wrong = np.flatnonzero((np.array(block.image_strip)[rows.who] == "B") & (rows.axis == 2))[:5]
    value = np.array(rows.value)
    value[wrong] += [4.0, -3.0, 6.0, -5.0, 3.0]
    spoilt = block.with_observations({"stations": dataclasses.replace(rows, value=value)})
    codes = [f.code for f in snooped_findings(snoop(spoilt), spoilt)]
    assert codes == ["rejected_observation"] * 5


def test_a_wholly_rejected_group_is_reported(block):
    """A single scale bar, which nothing is left of."""
    control = block.control
    ends = np.array([block.points.index(name) for name in ("T1", "T3")])
    one, other = (np.asarray(control.value)[control.who == p] for p in ends)
    bar = Distances(ends[None], np.array([np.linalg.norm(one - other) + 5.0]), np.array([0.02]))
    found = snoop(dataclasses.replace(block, distances=bar))
    (left,) = found.left_out
    assert left.group == "distances" and abs(left.error - 5.0) < 1.0


def mirrored(block, name):
    """Exchange x and y of an image."""
    rows = block.image_points
    xy, mine = np.array(rows.xy), rows.image == block.images.index(name)
    xy[mine] = xy[mine][:, ::-1]
    return block.with_observations({"image_points": dataclasses.replace(rows, xy=xy)}), np.flatnonzero(mine)


def assert_mirrored(snooped, block, name):
    first = snooped_findings(snooped, block)[0]
    assert (first.code, first.severity) == ("rejected_images", "error") and first.subject.startswith(name)


def test_a_mostly_rejected_image_is_an_error():
    block, mine = mirrored(adjusted("cross").block, "i3")
    rejected = tuple(Suspect("image_points", int(k), 0, "", 99.0, 1.0, 0.01, "mm") for k in mine)
    assert_mirrored(Snooped(adjusted("cross"), rejected, (), ()), block, "i3")


@pytest.mark.slow
def test_a_mirrored_image_is_an_error(block):
    spoilt, _ = mirrored(block, "A3")
    assert_mirrored(snoop(spoilt), spoilt, "A3")


@pytest.mark.slow
def test_an_image_that_is_mirrored_is_an_alarm(block):
    """Collinearity holds behind a camera, too: from below nothing but one station would contradict it."""
    rows = block.image_points
    mine = (rows.image == block.images.index("D4"))[:, None]
    xy = np.where(mine, np.asarray(rows.xy) * [-1.0, 1.0], np.asarray(rows.xy))
    spoilt = block.with_observations({"image_points": dataclasses.replace(rows, xy=xy)})
    found = snoop(spoilt)
    alarms = [f.text for f in snooped_findings(found, spoilt) if f.severity == "error"]
    verdict = verdict_of(Tables(found.adjusted))
    assert any("image D4" in text for text in (*alarms, *(verdict.texts if verdict.colour == "red" else ())))
    # Of the block as it is, no point is behind its image.
    sound = adjusted_example()
    seen = in_front(block, sound.unknowns)
    assert seen.all() and not len(looking_away(block, seen))


def test_numbers_that_overflow_are_no_pattern():
    """As where every image is mirrored and nothing fits: no direction shows, and no traceback."""
    inverse, freedom = truncated_inverse(np.full((3, 3), np.nan), np.eye(3), 1e-3)
    assert freedom == 0 and not inverse.any()


@pytest.mark.slow
def test_a_file_in_wrong_units_is_rejected_with_its_cause(block):
    """Heights of control in feet: the stations are right, and the search begins without control."""
    rows = block.control
    value = np.asarray(rows.value) / np.where(rows.axis == 2, 0.3048, 1.0)
    spoilt = block.with_observations({rows.group: dataclasses.replace(rows, value=value)})
    found = snoop(spoilt)
    assert {(s.group, int(rows.axis[s.row])) for s in found.left_out} == {(rows.group, 2)} and not found.points
    first = snooped_findings(found, spoilt)[0]
    assert (first.code, first.severity) == ("rejected_group", "error")
    # Each is predicted by what is in, and not by others that are out: as well as the others place the point.
    adjusted = found.adjusted
    height, sigma0 = np.asarray(adjusted.unknowns.points)[:, 2], float(adjusted.sigma0)
    variance = np.asarray(covariance(adjusted).points)[:, 2, 2]
    for s in found.left_out:
        who = rows.who[s.row]
        assert s.error == pytest.approx(value[s.row] - height[who], abs=1e-4)
        assert s.sigma == pytest.approx(sigma0 * np.sqrt(rows.sigma[s.row] ** 2 + variance[who]), rel=1e-3)
