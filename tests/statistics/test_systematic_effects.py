"""Systematic effects in residuals: uniform p-values for complete models, and names of missing terms."""

import dataclasses
import re
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy import stats

from jaxphoto import FIXED, Tables, adjust, covariance, read_block
from jaxphoto.camera import get_parameter, set_parameter
from jaxphoto.georeferencing import object_from_body
from jaxphoto.observations.priors import KnownParameters
from jaxphoto.report import verdict_of
from jaxphoto.simulation import remeasure
from jaxphoto.statistics import systematic_effect_tests, systematic_effects
from jaxphoto.statistics.hat_matrix import HatMatrix
from tests.blocks import Simulated, adjusted, calibration_flight, free_network, observed, simulated

KNOWN = ("interior[one].c_mm", "interior[one].k1")


def in_strips() -> Simulated:
    """The crossing strips with names and times."""
    block, truth = simulated("cross")
    time = np.concatenate([np.linspace(-6, 6, 5), np.linspace(20, 34, 5)])
    return Simulated(dataclasses.replace(block, image_strip=("a",) * 5 + ("b",) * 5, image_time=time), truth)


def effects_in(block) -> dict:
    a = adjust(block)
    return {t.pattern.what: t for t in systematic_effect_tests(a, np.asarray(covariance(a).shared_sigma))}


@pytest.mark.slow
def test_where_nothing_is_missing_p_values_are_uniform():
    block, truth = in_strips()
    rng, true = np.random.default_rng(1), truth.interior["one"]
    q = np.array([[4e-4, -3e-8], [-3e-8, 9e-12]])
    value = np.array([float(true.c), float(get_parameter(true, "k1"))])
    priors = (KnownParameters(KNOWN, value + np.linalg.cholesky(q) @ rng.normal(size=2), q) for _ in range(40))
    draw = jax.jit(lambda key: observed(remeasure(block, truth, key)))
    blocks = (
        dataclasses.replace(eqx.tree_at(observed, block, draw(jax.random.key(seed))), more=(prior,))
        for seed, prior in enumerate(priors)
    )
    p = [{what: test.p_value for what, test in effects_in(b).items()} for b in blocks]
    assert set(p[0]) == {
        "image points of camera one over the format", "image points of camera one over time",
        "prior information of camera one", "stations as a whole", "stations along the axes of the aircraft",
        "stations from strip to strip", "stations over time",
    }  # fmt: skip
    for what in p[0]:
        assert stats.kstest([each[what] for each in p], "uniform").pvalue > 1e-3, what


def test_a_lens_term_that_is_held_is_named():
    term = "k2"
    block, _ = in_strips()
    path = lambda b: (b.start.unknowns.interior["one"], b.priors.interior["one"])  # noqa: E731
    zero, fixed = (set_parameter(tree, term, value) for tree, value in zip(path(block), (0.0, FIXED), strict=True))
    a = adjust(eqx.tree_at(path, block, (zero, fixed)))
    tables = Tables(a)
    result = tables.tested_trends[0]
    assert result.p_value < 1e-10 and result.hints[0].term.name == term and result.hints[0].share > 0.8
    findings = verdict_of(tables).findings
    messages = [f.text for f in findings if f.code == "systematic" and "over the format" in f.subject]
    assert len(messages) == 1 and f"{term}, which is fixed: free it" in messages[0]


def test_what_stretches_the_image_may_be_a_rolling_shutter():
    (tested,) = (t for t in Tables(adjusted("cross")).tested_trends if "over the format" in t.pattern.what)
    cures = {term.name.split()[0]: term.cure for term in tested.pattern.terms}
    shutter = {name for name, cure in cures.items() if "rolling shutter" in cure}
    assert shutter == {"b1", "b2"} and cures["p1"] and not cures["c_mm"]


def test_stations_of_a_strip_that_are_off_are_named_with_their_shift():
    block, _ = in_strips()
    rows = block.stations
    error = np.where((np.asarray(rows.who) >= 5) & (rows.axis == 2), 1.5, 0.0)
    result = effects_in(dataclasses.replace(block, stations=dataclasses.replace(rows, value=rows.value + error)))
    test = result["stations from strip to strip"]
    best = test.hints[0]
    assert test.p_value < 1e-4 and best.term.name in ("Z of strip b", "Z of strip a")
    sign = 1 if best.term.name.endswith("b") else -1
    assert abs(best.amount - sign * 1.5) < 4 * best.sigma


def test_stations_that_are_all_off_alike_are_named_before_any_single_one():
    """As with another kind of height: c and the ground absorb nearly all of it, and single stations seem wrong."""
    block = read_block(Path(__file__).parents[2] / "examples" / "cross_block")
    rows = block.stations
    value = np.asarray(rows.value) + np.where(rows.axis == 2, 48.0, 0.0)
    tables = Tables(adjust(block.with_observations({"stations": dataclasses.replace(rows, value=value)})))
    assert tables.blunders.suspects
    alarm = verdict_of(tables).findings[0]
    assert alarm.severity == "error"
    assert "stations as a whole" in alarm.text and "flight_bias" in alarm.text
    # First-order theory gives 51.5 +- 2.2.
    size, sigma = map(float, re.search(r", Z \+([\d.]+) \+- ([\d.]+) m", alarm.text).groups())
    assert abs(size - 48.0) < 2 * sigma < 2.0
    (hint,) = [t.hints[0] for t in tables.tested_trends if t.pattern.what == "stations as a whole"]
    assert abs(hint.amount - 48.0) < 3 * hint.sigma


@pytest.mark.parametrize(
    ("arm_m", "offset_s"), [((0.0, 0.0, 0.0), 0.02), ((0.24, -0.7, 2.4), 0.0)], ids=["time offset", "lever arm"]
)
def test_an_error_along_the_axes_of_the_aircraft_is_named_with_its_size(arm_m, offset_s):
    """A time offset of 20 ms at 50 m/s; a lever arm of the wrong sign."""
    block, truth, *_ = calibration_flight()
    rows, mount = block.stations, truth.mounts["default"]
    body = jax.vmap(object_from_body, (0, None, None))(
        truth.exterior.camera_from_object, mount.boresight, mount.nominal
    )
    error = np.add(arm_m, [0.0, 50.0 * offset_s, 0.0])
    value = np.asarray(rows.value) + (np.asarray(body) @ error)[rows.who, rows.axis]
    tables = Tables(adjust(block.with_observations({"stations": dataclasses.replace(rows, value=value)})))
    (test,) = (t for t in tables.tested_trends if t.pattern.what == "stations along the axes of the aircraft")
    estimates = {h.term.name: h for h in test.hints}
    for name, size in zip(("right", "forward", "up"), error, strict=True):
        assert abs(estimates[name].amount - size) < 3 * estimates[name].sigma
    assert test.significant_terms[0].term.name == ("forward" if offset_s else "up")
    assert first_cause(tables) == test.pattern.what


def test_another_north_is_named_although_the_boresight_absorbs_most_of_it():
    """Yaw from magnetic north, clockwise: a rotation about the vertical of the opposite sign."""
    block, *_ = calibration_flight()
    turned = dataclasses.replace(
        block.attitudes, roll_pitch_yaw=block.attitudes.roll_pitch_yaw + np.deg2rad([0.0, 0.0, 3.5])
    )
    tables = Tables(adjust(block.with_observations({"attitudes": turned})))
    (test,) = (t for t in tables.tested_trends if t.pattern.what == "attitudes about the axes of the object frame")
    assert test.hints[0].term.name == "Z" and np.rad2deg(test.hints[0].amount) == pytest.approx(-3.5, abs=0.1)
    assert first_cause(tables) == test.pattern.what


def test_another_height_reference_of_a_second_flight_is_named_before_a_camera_that_changes():
    """The p-values of both underflow."""
    block, *_ = calibration_flight()
    rows = block.stations
    second = np.char.startswith(block.image_strip, "N")[rows.who] & (rows.axis == 2)
    value = np.asarray(rows.value) + 15.0 * second
    tables = Tables(adjust(block.with_observations({"stations": dataclasses.replace(rows, value=value)})))
    assert first_cause(tables) == "stations from strip to strip"
    cause = next(f for f in verdict_of(tables).findings if f.code == "systematic")
    strip, size, sigma = re.search(r"Z of strip (N\d) \+([\d.]+) \+- ([\d.]+) m", cause.text).groups()
    assert strip in block.image_strip and abs(float(size) - 15.0) < 3 * float(sigma) < 0.3


def first_cause(tables) -> str:
    """Subject of the first finding that names a cause of large residuals."""
    first = next(f for f in verdict_of(tables).findings if f.code in ("systematic", "blunder"))
    return first.subject.removeprefix("systematic residuals of ")


def test_blunders_have_no_part_in_patterns():
    block, _ = in_strips()
    rows = block.image_points
    row = int(np.argmax(np.bincount(rows.point)[rows.point]))
    xy, kept = np.array(rows.xy), np.arange(len(rows)) != row
    xy[row] += 0.1
    a = adjust(dataclasses.replace(block, image_points=dataclasses.replace(rows, xy=xy)))
    tables = Tables(a)
    assert [s.row for s in tables.blunders.suspects][:1] == [row]
    result = {
        t.pattern.what: t
        for t in systematic_effect_tests(a, np.asarray(tables.covariance.shared_sigma), [("image_points", row)])
    }
    # As if it had not been measured.
    without = effects_in(dataclasses.replace(block, image_points=rows.take(kept)))
    for what, t in result.items():
        assert t.freedom == without[what].freedom
        assert t.p_value == pytest.approx(without[what].p_value, rel=0.05), what


def test_where_there_is_nothing_to_look_for_nothing_is_found(monkeypatch):
    """More cameras than are tested one by one, and no stations; and no direction to solve for."""
    a = adjust(free_network(), simulated("cross").truth)
    monkeypatch.setattr(systematic_effects, "MAX_GROUPS", 0)
    assert systematic_effect_tests(a, np.asarray(covariance(a).shared_sigma)) == []
    assert list(HatMatrix.of(a).influence_on([])) == []
