"""Boresight calibration in four steps: truth recovered, and a stop after a failed step."""

import dataclasses
import functools
import json
import sys

import equinox as eqx
import numpy as np
import pandas as pd
import pytest

from jaxphoto import FIXED, FREE, BlockError, boresight
from jaxphoto.georeferencing import Mount, StripBias
from jaxphoto.io import write_block
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates
from jaxphoto.procedures.boresight import step_block
from jaxphoto.writing import MARKER
from tests.blocks import BORESIGHT, BROWN, CONTROL, Simulated, aerial, all_attitudes, all_stations, bare, measured, rows
from tests.blocks import free as free_interior
from tests.commands import run

STATION = 0.05
ZERO = np.zeros(3)
ANGLES = [f"mounts[one].boresight_{axis}_deg" for axis in "xyz"]


@functools.cache
def block(shift: float = 0.0, image_sigma: float = 0.001):
    """Two crossing strips with stations, attitudes and control; the first strip shifted by `shift` (m) in X.

    The principal point is free and starts off its true value, so do shifts and boresight: at zero.
    """
    strips = {"a": StripBias(np.array([shift, 0.0, 0.0]), ZERO), "b": StripBias(ZERO, ZERO)}
    mounts = {"one": Mount(np.array([0.35, -0.52, 1.10]), BORESIGHT)}
    built, truth = bare(aerial(), {"one": BROWN}, ("one",) * 10, mounts=mounts, strips=strips)
    sigma = np.full_like(built.image_points.sigma, image_sigma)
    built = dataclasses.replace(
        built,
        image_points=dataclasses.replace(built.image_points, sigma=sigma),
        control=rows(CONTROL),
        stations=all_stations(built, STATION),
        attitudes=all_attitudes(built),
    )
    made = measured(Simulated(free_interior(built, "one", ("xp_mm", "yp_mm")), truth)).block
    start = ({"one": Mount(mounts["one"].lever_arm, ZERO)}, {name: StripBias(ZERO, ZERO) for name in strips})
    return eqx.tree_at(lambda b: (b.start.unknowns.mounts, b.start.unknowns.strips), made, start)


@functools.cache
def steps(shift: float = 0.0):
    return boresight(block(shift))


def values(step):
    return {e.parameter: (e.value, e.sigma) for e in step.estimates}


def said(step):
    return " | ".join(step.findings)


def blunder():
    """0.2 mm in one image point."""
    made = block()
    xy = np.array(made.image_points.xy)
    many = np.bincount(made.image_points.point)[made.image_points.point] > 6
    row = int(np.flatnonzero(many)[0])
    xy[row, 0] += 0.2
    name = f"point {made.points[made.image_points.point[row]]} in image {made.images[made.image_points.image[row]]}"
    return eqx.tree_at(lambda b: b.image_points.xy, made, xy), name


def recovered(step):
    known = values(step)
    true = np.degrees(BORESIGHT)
    return [abs(known[a][0] - t) / known[a][1] for a, t in zip(ANGLES, true, strict=True)]


def test_the_misalignment_is_recovered_with_and_without_control():
    made = steps()
    assert [s.number for s in made] == [1, 2, 3, 4]
    assert all(s.go_on for s in made)
    for step in made[2:]:
        assert max(recovered(step)) < 3
        assert "significant: d-omega, d-phi, d-kappa" in said(step)
        # Far from the zero it started at.
        assert all(abs(values(step)[a][0]) > 10 * values(step)[a][1] for a in ANGLES)
    assert not made[1].biases


def test_each_step_uses_what_the_paper_says():
    made = steps()
    counts = [s.adjusted.n_observations for s in made]
    assert [c["stations"] for c in counts] == [0, 30, 30, 30]
    assert [c["attitudes"] for c in counts] == [0, 0, 30, 30]
    assert [c["control_points"] for c in counts] == [15, 15, 15, 0]
    assert [s.adjusted.n_unknowns["mounts"] for s in made] == [0, 0, 3, 3]
    assert [s.adjusted.n_unknowns["strips"] for s in made] == [0, 12, 0, 0]
    assert [s.adjusted.n_unknowns["interior"] for s in made] == [2, 2, 2, 2]
    assert len(made[3].adjusted.block.check.who) == len(block().check.who) + 15
    assert "no previous problem" in said(made[0])
    assert "5 check points" in said(made[3])
    rho = [f for f in made[2].findings if f.startswith("largest correlation with the principal point")]
    assert len(rho) == 1
    assert "yp_mm" in rho[0] or "xp_mm" in rho[0]


def test_without_and_with_control_differ_by_what_their_sigmas_allow():
    """The variance of the difference is that of step 4 less that of step 3, whose observations include step 4's."""
    third, fourth = steps()[2:]
    before, after = values(third), values(fourth)
    for a in ANGLES:
        difference, sigma = after[f"step 4 - step 3: {a}"]
        assert difference == pytest.approx(after[a][0] - before[a][0], abs=1e-12)
        q = [(x[a][1] / float(s.adjusted.sigma0)) ** 2 for x, s in ((before, third), (after, fourth))]
        assert sigma == pytest.approx(float(fourth.adjusted.sigma0) * np.sqrt(q[1] - q[0]), rel=1e-6)
        assert abs(difference) < 3 * sigma
    assert "no systematic effect" in said(fourth)


def test_control_in_another_datum_biases_the_misalignment():
    """Control that leans against the stations, 2.5 m over the block: only step 4 shows what it does."""
    made = block()
    control = made.control
    points = np.asarray(made.start.unknowns.points)[control.who]
    lean = np.where(control.axis == 2, 3e-3 * points[:, 0], 0.0)
    made = eqx.tree_at(lambda b: b.control.value, made, np.asarray(control.value) + lean)
    found = boresight(made)
    assert [s.go_on for s in found] == [True, True, True, False]
    assert "a systematic effect of the control" in said(found[3])


def test_a_blunder_stops_at_the_first_step():
    made, name = blunder()
    found = boresight(made)
    assert [s.number for s in found] == [1]
    assert not found[0].go_on
    assert f"blunders, the largest first: {name}" in said(found[0])
    assert "continuing is pointless" in said(found[0])
    assert len(boresight(made, go_on=True)) == 4


def test_a_major_shift_stops_at_the_second_step():
    found = steps(2.0)
    assert [s.number for s in found] == [1, 2]
    assert [s.go_on for s in found] == [True, False]
    assert "major shift or drift: shift of strip a in X +" in said(found[1])
    assert "trajectory" in said(found[1])


@pytest.mark.slow
def test_a_moderate_shift_is_estimated():
    """Free in step 3, held at its value in step 4; nothing else of the strips is kept."""
    shift = 0.4
    found = steps(shift)
    assert len(found) == 4
    assert found[1].biases == (("a", "shift"),)
    assert "not major, which the next steps retain: shift of strip a in X +" in said(found[1])
    value, sigma = values(found[2])["strips[a].shift_X_m"]
    assert abs(value - shift) < 3 * sigma
    assert sigma < 0.2 * shift
    held = found[3].adjusted.unknowns.strips
    assert held["a"].shift[0] == pytest.approx(value, abs=1e-12)
    assert found[3].adjusted.n_unknowns["strips"] == 0
    assert not np.any([held["a"].drift, held["b"].shift, held["b"].drift])
    for step in found[2:]:
        assert max(recovered(step)) < 3


def test_sigma0_far_from_the_a_priori_sigmas_stops_the_first_step():
    """Image sigmas stated four times too small; those stated too large are estimated."""
    small, large = (
        eqx.tree_at(lambda b: b.image_points.sigma, block(), factor * np.asarray(block().image_points.sigma))
        for factor in (0.25, 4.0)
    )
    found = boresight(small)
    assert len(found) == 1
    assert "contradicts the a priori standard deviations" in said(found[0])
    first = boresight(large)[0]
    assert first.go_on
    assert float(first.adjusted.sigma0) == pytest.approx(1, abs=0.01)
    stated, estimated = (np.asarray(b.image_points.sigma) for b in (large, first.adjusted.block))
    assert estimated / stated == pytest.approx(0.25 * float(boresight(block())[0].adjusted.sigma0), rel=0.01)


def test_a_step_that_does_not_converge_is_the_last():
    found = boresight(block(), go_on=True, max_steps=1)
    assert len(found) == 1
    assert not found[0].go_on
    assert "not converged" in said(found[0])


def test_priors_of_each_step():
    made = block()
    second = step_block(made, 2)
    assert second.priors.strips["a"] == StripBias(FREE, FREE)
    assert second.priors.mounts["one"] == Mount(FIXED, FIXED, FIXED)
    third = step_block(made, 3, (("b", "drift"),))
    assert third.priors.strips["a"] == StripBias(FIXED, FIXED)
    assert third.priors.strips["b"] == StripBias(FIXED, FREE)
    assert third.priors.mounts["one"] == Mount(FIXED, FREE, FIXED)
    before = made.start.unknowns
    before = eqx.tree_at(lambda u: (u.strips["b"].drift, u.strips["a"].shift), before, (ZERO + 0.01, ZERO + 7.0))
    fourth = step_block(made, 4, (("b", "drift"),), before)
    assert fourth.priors.strips["b"] == StripBias(FIXED, FIXED)
    np.testing.assert_array_equal(fourth.start.unknowns.strips["b"].drift, 0.01)
    # What is not kept falls back to the block's own start.
    np.testing.assert_array_equal(fourth.start.unknowns.strips["a"].shift, 0.0)
    with pytest.raises(ValueError, match="choose 1, 2, 3 or 4"):
        step_block(made, 5)


def test_without_times_no_drift_is_estimated():
    made = eqx.tree_at(lambda b: b.image_time, block(), np.zeros(10))
    assert step_block(made, 2).priors.strips["a"] == StripBias(FREE, FIXED)


def lone_control():
    made = block()
    r = made.image_points
    keep = ~((r.point == CONTROL[0]) & (np.cumsum(r.point == CONTROL[0]) > 1))
    return dataclasses.replace(made, image_points=type(r)(r.image[keep], r.point[keep], r.xy[keep], r.sigma[keep]))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda: dataclasses.replace(block(), control=ControlCoordinates.none()), ["step 1", "control_points.csv"]),
        (lambda: dataclasses.replace(block(), stations=CameraPositions.none()), ["step 2", "stations.csv"]),
        (lambda: dataclasses.replace(block(), attitudes=Attitudes.none()), ["step 3", "attitudes.csv"]),
        (lambda: dataclasses.replace(block(), image_strip=("",) * 10), ["step 2", "column strip", "images.csv"]),
        (lambda: dataclasses.replace(block(), image_strip=("a",) * 10), ["strip a", "opposite direction"]),
        (lambda: dataclasses.replace(block(), image_mount=("",) * 10), ["[mounts.one]", "block.toml"]),
        (lone_control, ["step 4", f"control point p{CONTROL[0]}", "measure it in two"]),
    ],
    ids=["control", "stations", "attitudes", "strips", "one-strip", "mount", "lone-control"],
)
def test_missing_data_of_any_step_are_reported_first(spoil, words, monkeypatch):
    monkeypatch.setattr(sys.modules["jaxphoto.procedures.boresight"], "adjust", None)
    with pytest.raises(BlockError) as caught:
        boresight(spoil())
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_the_command_writes_all_four_steps(monkeypatch, capsys, tmp_path):
    folder, out = tmp_path / "block", tmp_path / "out"
    write_block(block(), folder)
    code, screen, _ = run(monkeypatch, capsys, "boresight", folder, "--out", out)
    assert code == 0
    names = {MARKER, "steps.csv", "summary.json", "report.html", "step_1", "step_2", "step_3", "step_4"}
    assert {p.name for p in out.iterdir()} == names
    assert all((out / f"step_{k}" / "exterior.csv").is_file() for k in (1, 2, 3, 4))
    table = pd.read_csv(out / "steps.csv")
    assert list(table.columns) == ["step", "parameter", "value", "sigma", "unit"]
    for step in steps():
        mine = table[table["step"] == step.number].set_index("parameter")
        assert mine.loc["sigma0", "value"] == pytest.approx(float(step.adjusted.sigma0), rel=1e-6)
        assert (mine.loc["sigma0", "sigma"] / mine.loc["sigma0", "value"]) ** -2 == pytest.approx(
            2 * step.adjusted.redundancy
        )
        for e in step.estimates:
            assert abs(mine.loc[e.parameter, "value"] - e.value) < 1e-3 * e.sigma
            assert mine.loc[e.parameter, "sigma"] == pytest.approx(e.sigma, rel=1e-4)
    assert mine.loc[ANGLES[0], "unit"] == "deg"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["passed"] is True
    assert [s["step"] for s in summary["steps"]] == [1, 2, 3, 4]
    page = (out / "report.html").read_text()
    assert page.index("is usable") < page.index("Step 1")
    # The verdict in its colour, misalignments and shifts as pictures, links to each step, and how it was made.
    assert '<p class="verdict green">' in page and page.count("<svg") == 2
    assert all(f'href="step_{k}/report.html"' in page for k in (1, 2, 3, 4)) and "<th>command</th>" in page
    assert "misalignment of mount one" in screen
    # Earlier results are replaced whole, and exit code 1 says that a step is not passed.
    write_block(block(2.0), folder)
    code, screen, _ = run(monkeypatch, capsys, "boresight", folder, "--out", out)
    assert code == 1
    assert "stopped at step 2" in screen
    assert {p.name for p in out.iterdir()} == names - {"step_3", "step_4"}
    assert {p.name for p in tmp_path.iterdir()} == {"block", "out"}


def test_a_block_without_attitudes_is_refused(monkeypatch, capsys, tmp_path):
    folder = tmp_path / "block"
    write_block(dataclasses.replace(block(), attitudes=Attitudes.none()), folder)
    code, screen, error = run(monkeypatch, capsys, "boresight", folder, "--out", tmp_path / "out")
    assert (code, screen) == (2, "")
    assert "attitudes.csv" in error
    assert not (tmp_path / "out").exists()
