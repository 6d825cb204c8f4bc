"""The likeliest culprit stands first: what the model lacks accuses sound observations."""

import dataclasses
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import adjust, covariance, read_block
from jaxphoto.camera import get_parameter, set_parameter
from jaxphoto.observations.priors import KnownParameters
from jaxphoto.report import Tables, verdict_of
from jaxphoto.statistics.quantiles import beta_tail
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


@pytest.mark.slow
def test_a_term_that_is_held_is_told_before_the_observations_that_it_accuses(without_k2):
    assert without_k2.colour == "red"
    first = next(k for k, text in enumerate(without_k2.texts) if "k2, which is fixed: free it" in text)
    accused = [k for k, f in enumerate(without_k2.findings) if f.code == "blunder"]
    assert accused and first < min(accused)


@pytest.mark.slow
def test_parameters_are_called_as_people_call_them(without_k2):
    told = " ".join(without_k2.texts)
    assert "k1 of camera one would move by" in told or "c of camera one would move by" in told
    assert "interior[" not in told


def test_a_strip_that_is_off_is_told_before_its_stations():
    """By 3 m along X; most of its stations are suspects, each alone."""
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    rows = block.stations
    off = np.array([block.image_strip[k] == "A" for k in rows.who]) & (rows.axis == 0)
    spoilt = dataclasses.replace(rows, value=np.asarray(rows.value) + 3.0 * off)
    tables = Tables(adjust(block.with_observations({"stations": spoilt})))
    first, *others = verdict_of(tables).findings
    assert first.severity == "error" and "X of strip A" in first.text
    # Stations beyond the critical value there are, but the strip explains them all.
    n = len(tables.blunders.suspects)
    assert n > 2 and [f.value for f in others if f.code == "explained_suspects"] == [n]
    assert not any(f.code == "blunder" for f in others)


def test_stations_that_are_off_each_by_itself_are_no_strip():
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    rows = block.stations
    value = np.array(rows.value)
    for name, error in (("A2", 4.0), ("A3", -5.0), ("A5", 3.0), ("A6", -4.0)):
        value[(rows.who == block.images.index(name)) & (rows.axis == 0)] += error
    spoilt = block.with_observations({"stations": dataclasses.replace(rows, value=value)})
    first = verdict_of(Tables(adjust(spoilt))).findings[0]
    assert first.code == "blunder" and first.subject.startswith("station of image A")


def test_of_a_drift_the_strips_that_show_it_are_told():
    """3 m along Y from the first image to the last: no strip is most of it."""
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    rows, time = block.stations, np.asarray(block.flight_time)
    drift = 3.0 * (time - time.min()) / np.ptp(time)
    value = np.asarray(rows.value) + np.where(rows.axis == 1, drift[rows.who], 0.0)
    spoilt = block.with_observations({"stations": dataclasses.replace(rows, value=value)})
    (said,) = [f.text for f in verdict_of(Tables(adjust(spoilt))).findings if "from strip to strip" in f.subject]
    assert "each alone Y of strip D +2.5" in said and "Y of strip C" in said


def spoilt_control(block, axis, **errors):
    rows = block.control
    value = np.array(rows.value)
    for name, error in errors.items():
        value[(rows.who == block.points.index(name)) & (rows.axis == axis)] += error
    return block.with_observations({"control_points": dataclasses.replace(rows, value=value)})


def test_what_a_blunder_does_to_its_neighbours_is_no_alarm_of_theirs():
    """Of suspects those count that are still beyond the critical value when the worse ones are no more observed."""
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    spoilt = spoilt_control(block, 2, T11=2.0)
    tables = Tables(adjust(spoilt))
    assert [s.words for s in tables.culprits] == ["control point T11 in Z"]
    assert len(tables.blunders.suspects) == 2
    findings = verdict_of(tables).findings
    assert [f.subject for f in findings if f.code == "blunder"] == ["control point T11 in Z"]
    assert [f.value for f in findings if f.code == "explained_suspects"] == [1]
    # As the adjustment without it says.
    rows = spoilt.control
    kept = ~((rows.who == spoilt.points.index("T11")) & (rows.axis == 2))
    assert not Tables(adjust(spoilt.with_observations({"control_points": rows.take(kept)}))).blunders.suspects


def test_two_blunders_are_both_culprits():
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    tables = Tables(adjust(spoilt_control(block, 0, T11=1.5, T21=-2.0)))
    assert {s.words for s in tables.culprits} == {f"control point {name} in X" for name in ("T11", "T21")}
    assert len(tables.blunders.suspects) > 2


NAMES = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")


def calibration_by(adjusted):
    interior = adjusted.unknowns.interior["kodak"]
    value = np.array([float(get_parameter(interior, name)) for name in NAMES])
    q = covariance(adjusted).of_interior("kodak", NAMES)
    return KnownParameters([f"interior[kodak].{name}" for name in NAMES], value, q)


def test_a_camera_that_has_changed_since_its_calibration_is_told_first():
    """Stations that are all off in height would explain it about as well, and lead to the old c."""
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    known = calibration_by(adjust(block))
    larger = eqx.tree_at(lambda b: b.image_points.xy, block, np.asarray(block.image_points.xy) * 1.002)
    tables = Tables(adjust(dataclasses.replace(larger, more=(known,))))
    verdict = verdict_of(tables)
    assert verdict.colour == "red"
    assert "contradicts the prior information of camera kodak" in verdict.texts[0]
    assert "c_mm -0.06" in verdict.texts[0]
    # As surprising as the difference from the calibration by this block alone, by the covariances of both.
    (found,) = [t for t in tables.tested_trends if t.pattern.begins]
    alone = adjust(larger)
    by_it = calibration_by(alone)
    d, both = by_it.value - known.value, known.covariance + by_it.covariance / float(alone.sigma0) ** 2
    share = float(d @ np.linalg.solve(both, d)) / float(tables.adjusted.sum_of_squares)
    assert found.freedom == 5
    assert found.p_value == pytest.approx(beta_tail(share, 2.5, (tables.adjusted.redundancy - 5) / 2), rel=0.5)


def test_the_same_photographs_counted_twice_are_told():
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    known = calibration_by(adjust(block))
    verdict = verdict_of(Tables(adjust(dataclasses.replace(block, more=(known,)))))
    assert verdict.colour == "amber" and verdict.findings[0].code == "prior_counted_twice"


def test_standard_deviations_in_another_unit_are_an_alarm():
    """Micrometres for millimetres: sigma naught is a thousandth, and stations tell nothing any more."""
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    p = block.image_points
    vague = dataclasses.replace(p, sigma=1000 * np.asarray(p.sigma))
    verdict = verdict_of(Tables(adjust(block.with_observations({"image_points": vague}))))
    assert verdict.colour == "red" and verdict.findings[0].code == "sigma0_unit"
    twice = dataclasses.replace(p, sigma=2 * np.asarray(p.sigma))
    assert verdict_of(Tables(adjust(block.with_observations({"image_points": twice})))).colour == "amber"
