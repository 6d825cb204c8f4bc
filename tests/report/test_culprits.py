"""The most probable cause is the first finding."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import Tables, adjust, covariance, significance, statistics
from jaxphoto.camera import get_parameter, set_parameter
from jaxphoto.observations.priors import KnownParameters
from jaxphoto.report import residual_findings, verdict_of
from jaxphoto.statistics.quantiles import beta_tail
from jaxphoto.statistics.reliability import LargestMdb
from tests.blocks import adjusted, adjusted_example, example, simulated


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
def test_a_missing_term_is_named_before_the_observations(without_k2):
    assert without_k2.colour == "red"
    first = next(k for k, text in enumerate(without_k2.texts) if "k2, which is fixed: free it" in text)
    accused = [k for k, f in enumerate(without_k2.findings) if f.code == "blunder"]
    assert accused and first < min(accused)


def test_a_shifted_strip_is_named_before_its_stations():
    """By 3 m along X; most of its stations are suspects, each alone."""
    block = example()
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


def test_single_station_errors_are_no_strip_shift():
    block = example()
    rows = block.stations
    value = np.array(rows.value)
    for name, error in (("A2", 4.0), ("A3", -5.0), ("A5", 3.0), ("A6", -4.0)):
        value[(rows.who == block.images.index(name)) & (rows.axis == 0)] += error
    spoilt = block.with_observations({"stations": dataclasses.replace(rows, value=value)})
    first = verdict_of(Tables(adjust(spoilt))).findings[0]
    assert first.code == "blunder" and first.subject.startswith("station of image A")


def test_a_drift_is_reported_with_its_strips():
    """3 m along Y from the first image to the last: no strip is most of it."""
    block = example()
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


def test_neighbours_of_a_blunder_are_not_reported():
    """Of suspects those count that are still beyond the critical value when the worse ones are no more observed."""
    block = example()
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
    block = example()
    tables = Tables(adjust(spoilt_control(block, 0, T11=1.5, T21=-2.0)))
    assert {s.words for s in tables.culprits} == {f"control point {name} in X" for name in ("T11", "T21")}
    assert len(tables.blunders.suspects) > 2


NAMES = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")


def calibration_by(adjusted):
    interior = adjusted.unknowns.interior["kodak"]
    value = np.array([float(get_parameter(interior, name)) for name in NAMES])
    q = covariance(adjusted).of_interior("kodak", NAMES)
    return KnownParameters([f"interior[kodak].{name}" for name in NAMES], value, q)


def test_a_changed_camera_is_the_first_finding():
    """Stations that are all off in height would explain it about as well, and lead to the old c."""
    block = example()
    known = calibration_by(adjusted_example())
    larger = eqx.tree_at(lambda b: b.image_points.xy, block, np.asarray(block.image_points.xy) * 1.002)
    tables = Tables(adjust(dataclasses.replace(larger, more=(known,))))
    verdict = verdict_of(tables)
    assert verdict.colour == "red"
    assert "contradicts the prior information of camera kodak" in verdict.texts[0]
    assert "c_mm about -0.06" in verdict.texts[0]
    # As surprising as the difference from the calibration by this block alone, by the covariances of both.
    (found,) = [t for t in tables.tested_trends if t.pattern.begins]
    alone = adjust(larger)
    by_it = calibration_by(alone)
    d, both = by_it.value - known.value, known.covariance + by_it.covariance / float(alone.sigma0) ** 2
    share = float(d @ np.linalg.solve(both, d)) / float(tables.adjusted.sum_of_squares)
    assert found.freedom == 5
    assert found.p_value == pytest.approx(beta_tail(share, 2.5, (tables.adjusted.redundancy - 5) / 2), rel=0.5)


def test_photographs_counted_twice_are_reported():
    block = example()
    known = calibration_by(adjusted_example())
    verdict = verdict_of(Tables(adjust(dataclasses.replace(block, more=(known,)))))
    assert verdict.colour == "amber" and verdict.findings[0].code == "prior_counted_twice"


def test_standard_deviations_in_another_unit_are_an_error():
    """Micrometres for millimetres: sigma naught is a thousandth, and stations tell nothing any more."""
    block = example()
    p = block.image_points
    vague = dataclasses.replace(p, sigma=1000 * np.asarray(p.sigma))
    verdict = verdict_of(Tables(adjust(block.with_observations({"image_points": vague}))))
    assert verdict.colour == "red" and verdict.findings[0].code == "sigma0_unit"
    twice = dataclasses.replace(p, sigma=2 * np.asarray(p.sigma))
    assert verdict_of(Tables(adjust(block.with_observations({"image_points": twice})))).colour == "amber"


@pytest.fixture(scope="module")
def block():
    return example()


def test_standard_deviations_of_few_are_judged_although_all_together_fit(block):
    """Those of control a thousand times too large: sigma naught is of image points, and does not show it."""
    control = block.control
    vague = dataclasses.replace(control, sigma=np.full(len(control), 30.0))
    verdict = adjust(block.with_observations({"control_points": vague})).verdict()
    assert verdict.colour == "amber"
    assert any(f.code == "group_sigma" and f.subject == "control points" for f in verdict.findings)
    assert adjusted_example().verdict().colour == "green"


def test_how_large_an_error_in_common_may_be_unseen_is_what_it_does(block):
    """1.5 m in the heights of all stations shows nowhere, and moves c by what the sentence says."""
    sound = adjusted_example()
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


def large(tables):
    return [f.subject for f in verdict_of(tables).findings if f.code == "blunder"]


def test_blunders_are_named_the_largest_first():
    assert not large(Tables(adjusted("cross")))
    block = simulated("cross").block
    rows, xy = block.image_points, np.array(block.image_points.xy)
    of_point = np.bincount(rows.point)
    # In points of many rays, else their other rays look as bad.
    first, second = (int(np.flatnonzero(rows.point == p)[2]) for p in np.argsort(-of_point, kind="stable")[:2])
    xy[first] += 0.08
    xy[second] -= [0.0, 0.05]
    spoilt = dataclasses.replace(block, image_points=dataclasses.replace(rows, xy=xy))
    found = large(Tables(adjust(spoilt)))
    names = [f"point {block.points[rows.point[k]]} in image {block.images[rows.image[k]]}" for k in (first, second)]
    assert found[0].startswith(names[0]) and found[1].startswith(names[1])


def test_uncontrolled_observations_are_reported(monkeypatch):
    hidden = [
        LargestMdb("stations", "station A in X", np.inf, 0.1, "m"),
        LargestMdb("stations", "station B in X", 2.0, 0.1, "m"),
    ]
    monkeypatch.setattr(statistics, "largest_mdbs", lambda adjusted, redundancy: hidden)
    *_, one, other = residual_findings.reliability_findings(Tables(adjusted("cross")))
    assert (one.code, one.subject) == ("unchecked", "station A in X")
    assert (other.code, other.subject) == ("mdb", "station B in X")
    assert other.value == 2.0 and "MDB 2 m (sigma 0.1 m" in other.text
