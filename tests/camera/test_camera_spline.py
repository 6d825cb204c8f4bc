"""A camera that wanders along a spline of time: its basis, recovered, tested, in words and from files."""

import dataclasses
import functools

import numpy as np
import pytest
from scipy import stats

from jaxphoto import InputError, Outcome, RankError, Weighted, adjust, covariance
from jaxphoto.camera import CameraSpline
from jaxphoto.georeferencing import StripSpline
from jaxphoto.io import read_block, write_block
from jaxphoto.report.verdict import differences_finding
from jaxphoto.statistics import camera_spline_differences
from tests.camera.test_camera_rates import TRUE, at, changing_block

STRAIGHT = dataclasses.replace(TRUE, k1_rate=0.0)
KNOTS, INTERVAL_S = 6, 1200.0
ZERO = CameraSpline(*np.zeros((3, KNOTS)), KNOTS, INTERVAL_S)


def wandering(walk=1.0):
    """The camera that changes along a straight line, to a model that knows only by how much (mm) it may wander."""
    block = changing_block(STRAIGHT)
    known = Weighted(np.zeros(KNOTS), covariance=walk**2 * ZERO.walk)
    start = dataclasses.replace(block.start.unknowns, more={"camera_splines": {"one": ZERO}})
    more = {"camera_splines": {"one": CameraSpline(known, known, known, KNOTS, INTERVAL_S)}}
    return dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=start),
        priors=dataclasses.replace(block.priors, more=more),
    )


@functools.cache
def found():
    adjusted = adjust(wandering())
    assert adjusted.outcome is Outcome.CONVERGED
    return adjusted, covariance(adjusted)


def test_weights_are_those_of_the_splines_of_trajectories():
    strip = StripSpline(0, KNOTS, -1.5 * INTERVAL_S, INTERVAL_S)
    np.testing.assert_allclose(ZERO.times, strip.times)
    times = np.linspace(-2500.0, 2500.0, 41)
    own = np.array([ZERO.weights(t) for t in times])
    np.testing.assert_allclose(own, strip.all_weights(times)[1], atol=1e-12)
    np.testing.assert_allclose(own.sum(1), 1.0)


def test_a_walk_goes_both_ways_from_the_middle():
    hours = ZERO.times / 3600
    np.testing.assert_allclose(np.diagonal(ZERO.walk), np.abs(hours))
    assert ZERO.walk[2, 3] == 0.0 and ZERO.walk[3, 5] == pytest.approx(hours[3])
    steps = np.diff(np.eye(KNOTS), axis=0)[[0, 1, 3, 4]]
    np.testing.assert_allclose(steps @ ZERO.walk @ steps.T, np.eye(4) / 3, atol=1e-12)


def test_a_straight_line_is_recovered():
    adjusted, cov = found()
    own, seconds = adjusted.unknowns.more["camera_splines"]["one"], np.array([-1500.0, 1500.0])
    change = np.diff(np.array([own.weights(t) for t in seconds]), axis=0)[0]
    for field, rate in (("c_spline", TRUE.c_rate), ("xp_spline", TRUE.xp_rate), ("yp_spline", TRUE.yp_rate)):
        name = field.removesuffix("_spline")
        at_ = [cov.labels.index(f"camera_splines[one].{name}_{k + 1}_mm") for k in range(KNOTS)]
        sigma = np.sqrt(change @ np.asarray(cov.matrix)[np.ix_(at_, at_)] @ change)
        estimated, true = float(change @ np.asarray(getattr(own, field))), rate * np.diff(seconds)[0] / 3600
        assert abs(estimated - true) < 3 * sigma < 1.5 * abs(true), field


def test_the_interior_orientation_is_bent_by_the_spline():
    own = dataclasses.replace(ZERO, c_spline=np.arange(6.0), yp_spline=-np.arange(6.0))
    camera = changing_block().start.unknowns.interior["one"]
    bent = own.interior(camera, at(600.0))
    assert float(bent.c - camera.c) == pytest.approx(3.0) and float(bent.yp - camera.yp) == pytest.approx(-3.0)
    assert float(bent.xp) == float(camera.xp)


def test_it_is_tested_without_what_was_known():
    """Of the changes as the photographs alone have them; what all knots have in common is the camera's own."""
    adjusted, cov = found()
    (wander,) = camera_spline_differences(adjusted, cov)
    at_ = [k for k, label in enumerate(cov.labels) if label.startswith("camera_splines[")]
    value = np.concatenate(
        [np.asarray(v) for v in adjusted.unknowns.more["camera_splines"]["one"].__dict__.values()][:3]
    )
    own = np.linalg.inv(np.asarray(cov.matrix)[np.ix_(at_, at_)])
    shown = own - np.kron(np.eye(3), np.linalg.inv(ZERO.walk))
    sigma = np.sqrt(np.diagonal(np.asarray(cov.matrix)))[at_]
    values, vectors = np.linalg.eigh(shown * np.outer(sigma, sigma))
    kept = values > 1e-6
    assert kept.sum() == 15
    right = (sigma * (own @ value)) @ vectors[:, kept]
    f = np.sum(right**2 / values[kept]) / kept.sum() / float(cov.variance_factor)
    assert wander.more.p_value == pytest.approx(stats.f.sf(f, kept.sum(), adjusted.redundancy), rel=1e-5)
    assert wander.more.rejected and wander.at[:2] == ("-50", "-30")


def test_words():
    (wander,) = camera_spline_differences(*found())
    finding = differences_finding(wander)
    assert (finding.code, finding.subject) == ("drift", "camera one") and " mm at -50 min to " in finding.text
    still = wander._replace(more=wander.more._replace(p_value=0.4))
    assert differences_finding(still).code == "no_drift"


def test_it_comes_back_from_a_block_folder(tmp_path):
    write_block(wandering(), tmp_path / "block")
    again = read_block(tmp_path / "block")
    own, known = again.start.unknowns.more["camera_splines"]["one"], again.priors.more["camera_splines"]["one"]
    assert (own.knots, own.interval_s) == (KNOTS, INTERVAL_S)
    np.testing.assert_allclose(known.c_spline.covariance, ZERO.walk, rtol=1e-14)
    toml = tmp_path / "block/block.toml"
    lines = [line for line in toml.read_text().splitlines() if not line.startswith("xp_spline")]
    toml.write_text("\n".join(lines).replace("[unknowns.camera_splines.one]", WALKED))
    walked = read_block(tmp_path / "block").priors.more["camera_splines"]["one"]
    np.testing.assert_allclose(walked.xp_spline.covariance, 4e-6 * ZERO.walk, rtol=1e-14)
    for wrong, words in (
        ("knots = 5", r"\[unknowns\.camera_splines\.one\]: knots = 5 is not an even number from 4 to 100; correct it"),
        ("interval_s = -1.0", r"interval_s = -1\.0 is not a positive number"),
        ("interval_s = 1e308", r"interval_s = 1e\+308 is not a positive number of seconds up to 1e\+09"),
        ("yp_spline = { walk_mm = 1, sigma = 2 }", r"yp_spline\] sigma: unknown key; use walk_mm"),
        ("c_spline_mm = [1.0]", r"c_spline_mm: \[1\.0\] has 1 entries; give 6"),
    ):
        key = wrong.split(" = ")[0]
        toml.write_text(
            "\n".join(wrong if line.startswith(f"{key} =") else line for line in toml.read_text().splitlines())
        )
        with pytest.raises(InputError, match=words):
            read_block(tmp_path / "block")
        toml.write_text("\n".join(lines))


WALKED = "[unknowns.camera_splines.one]\nxp_spline = { walk_mm = 0.002 }"


def test_a_spline_that_is_too_short_is_refused():
    short = dataclasses.replace(wandering(), flight_time=3 * changing_block().flight_time)
    with pytest.raises(RankError, match=r"6 knots, which reach 1800 s .* an image is 5400 s from it: give it 12 knots"):
        adjust(short)
