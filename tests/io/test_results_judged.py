"""Warnings about results, by all their readers and in camera files."""

import json
import re
import warnings

import numpy as np
import pytest

from jaxphoto import InputError, adjust, compare, read_block, write_block
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.io.result_tables import read_summary, reservation
from jaxphoto.report import Tables
from tests.blocks import adjusted, simulated
from tests.commands import run
from tests.io.conftest import write_calibration

FAILED = {"passed": False, "expected_sigma0": 1.0}
AMBER = {"converged": True, "verdict": "amber", "sigma0": 0.53, "global_test": FAILED}
RED = {"verdict": "red", "findings": [{"severity": "error", "text": "T1 is off"}]}


@pytest.mark.parametrize(
    ("summary", "said"),
    [
        ({}, ""),
        ({"converged": True, "verdict": "green", "global_test": {"passed": True}}, ""),
        ({"converged": False, "outcome": "too few steps"}, "results are invalid: too few steps"),
        (RED, "the verdict on .* is red: T1 is off"),
        ({"verdict": "red", "findings": []}, "is red: see its report"),
        (AMBER, r"sigma naught of this adjustment is 0\.53, expected 1, a significant difference"),
    ],
)  # fmt: skip
def test_reservation_is_the_most_severe_warning(summary, said):
    assert re.search(said, reservation(summary)) if said else reservation(summary) == ""


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Results whose image sigmas were twice too large: amber, and no word of it in a table."""
    folder = tmp_path_factory.mktemp("judged")
    block = simulated("cross").block
    rows = block.image_points.with_sigmas_times(np.full(block.image_points.xy.shape, 2.0))
    block = block.with_observations({"image_points": rows})
    write_block(block, folder / "block")
    write_calibration(block, folder / "results")
    return folder


def test_a_failed_global_test_is_reported_and_kept_with_the_camera(results, monkeypatch, capsys, tmp_path):
    summary = read_summary(results / "results")
    test = summary["global_test"]
    assert summary["verdict"] == "amber" and not test["passed"] and test["p_value"] < 1e-3
    said = "a significant difference"
    assert said in read_camera_file(results / "results").note
    code, out, _ = run(monkeypatch, capsys, "camera", results / "results", tmp_path / "camera.toml")
    assert code == 0 and said in out
    assert said in read_camera_file(tmp_path / "camera.toml").note
    # As prior information of another block, from the results or the camera file.
    block = tmp_path / "later"
    write_block(simulated("cross").block, block)
    text = (block / "block.toml").read_text()
    begin, end = text.index("[cameras.one]"), text.index("\n[", text.index("[cameras.one.unknowns]"))
    for named in (results / "results", tmp_path / "camera.toml"):
        calibration = f"[cameras.one]\ncalibration = {json.dumps(str(named))}\n"
        (block / "block.toml").write_text(text[:begin] + calibration + text[end:])
        with pytest.warns(UserWarning, match=f"of the calibration that camera one is from: .*{said}"):
            read = read_block(block)
    # A copy of that block and its adjustment carry the warning, too.
    write_block(read, tmp_path / "copy")
    rests = tmp_path / "rests"
    with warnings.catch_warnings(action="default"):
        code, _, error = run(monkeypatch, capsys, "adjust", tmp_path / "copy", "--out", rests)
    assert code == 0 and said in " ".join(error.split())
    findings = read_summary(rests)["findings"]
    assert any(f["severity"] == "warning" and f["text"].endswith(read.prior_warnings[0]) for f in findings), findings
    note = read_camera_file(rests).note
    assert "this adjustment depends on an earlier one" in note and said in note


def test_a_block_that_contradicts_itself_is_reported_before_simulation(results, monkeypatch, capsys, tmp_path):
    block = results / "block"
    words = ("--bias", "station", "--sigma-m", "0.1", "--draws", "4")
    code, _, error = run(monkeypatch, capsys, "monte-carlo", block, *words, "--out", tmp_path / "draws")
    assert code == 0 and "input block: sigma naught" in " ".join(error.split())


def test_a_diverged_adjustment_has_no_sigmas_and_is_not_compared():
    block = simulated("cross").block
    short = adjust(block, max_steps=1)
    assert not bool(short.converged)
    with pytest.raises(InputError, match="did not converge: not converged"):
        compare(short, adjusted("cross"))
    table = Tables(short).interior
    assert table["sigma"].isna().all() and table["significant"].isna().all()
