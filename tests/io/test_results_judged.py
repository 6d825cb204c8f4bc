"""What speaks against results is said by all that read them, and travels with a camera file."""

import json
import re
import warnings

import numpy as np
import pytest

from jaxphoto import InputError, adjust, compare, read_block, write_block
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.io.results_judged import read_summary, reservation
from jaxphoto.report import Tables
from tests.blocks import adjusted, simulated
from tests.commands import run

FAILED = {"passed": False, "expected_sigma0": 1.0}
AMBER = {"converged": True, "verdict": "amber", "sigma0": 0.53, "global_test": FAILED}
RED = {"verdict": "red", "findings": [{"severity": "error", "text": "T1 is off"}]}


@pytest.mark.parametrize(
    ("summary", "said"),
    [
        ({}, ""),
        ({"converged": True, "verdict": "green", "global_test": {"passed": True}}, ""),
        ({"converged": False, "outcome": "too few steps"}, "no results: too few steps"),
        (RED, "the verdict on .* is red: T1 is off"),
        ({"verdict": "red", "findings": "none"}, "is red: see its report"),
        ({"verdict": "red", "findings": [{"severity": "error", "text": "\x1b[2J"}]}, "is red: see its report"),
        (AMBER, r"sigma naught of this adjustment is 0\.53, expected 1, which is no chance"),
        (AMBER | {"sigma0": "half"}, "is nan, expected 1"),
    ],
)  # fmt: skip
def test_the_worst_is_said(summary, said):
    found = reservation(summary)
    assert re.search(said, found) if said else found == ""


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Results whose image sigmas were twice too large: amber, and no word of it in a table."""
    folder = tmp_path_factory.mktemp("judged")
    block = simulated("cross").block
    rows = block.image_points.with_sigmas_times(np.full(block.image_points.xy.shape, 2.0))
    write_block(block.with_observations({"image_points": rows}), folder / "block")
    patch = pytest.MonkeyPatch()
    with patch.context() as m:
        m.setattr("sys.argv", ["jaxphoto", "adjust", str(folder / "block"), "--out", str(folder / "results"), "-q"])
        import jaxphoto_command

        with pytest.raises(SystemExit) as stop:
            jaxphoto_command.main()
    assert not stop.value.code
    return folder


def test_sigma_naught_that_fails_its_test_is_said_and_travels_with_the_camera(results, monkeypatch, capsys, tmp_path):
    summary = read_summary(results / "results")
    test = summary["global_test"]
    assert summary["verdict"] == "amber" and not test["passed"] and test["p_value"] < 1e-3
    said = "which is no chance"
    assert said in read_camera_file(results / "results").note
    code, out, _ = run(monkeypatch, capsys, "camera", results / "results", tmp_path / "camera.toml")
    assert code == 0 and said in out
    assert said in read_camera_file(tmp_path / "camera.toml").note
    code, _, error = run(
        monkeypatch, capsys, "tables", results / "results", "--to", "csv", "--out", tmp_path / "tables"
    )
    assert code == 0 and said in " ".join(error.split())
    # As a prior of another year, by its results and by the camera file.
    for named in (results / "results", tmp_path / "camera.toml"):
        block = tmp_path / f"of_{named.name}"
        write_block(simulated("cross").block, block)
        text = (block / "block.toml").read_text()
        begin, end = text.index("[cameras.one]"), text.index("\n[", text.index("[cameras.one.unknowns]"))
        (block / "block.toml").write_text(
            text[:begin] + f"[cameras.one]\ncalibration = {json.dumps(str(named))}\n" + text[end:]
        )
        with pytest.warns(UserWarning, match=f"of the calibration that camera one is from: .*{said}"):
            read = read_block(block)
        # And so on: what rests on it is no better, nor is a block that is made of this one.
        write_block(read, tmp_path / f"copy_of_{named.name}")
        rests = tmp_path / f"rests_on_{named.name}"
        with warnings.catch_warnings(action="default"):
            code, _, error = run(monkeypatch, capsys, "adjust", tmp_path / f"copy_of_{named.name}", "--out", rests)
        assert code == 0 and said in " ".join(error.split())
        findings = read_summary(rests)["findings"]
        assert any(f["severity"] == "warning" and f["text"].endswith(read.prior_warnings[0]) for f in findings), (
            findings
        )
        assert "this adjustment rests on an earlier one" in read_camera_file(rests).note
        assert said in read_camera_file(rests).note


def test_a_block_that_contradicts_itself_is_told_before_anything_is_made_of_it(results, monkeypatch, capsys, tmp_path):
    block = results / "block"
    words = ("--bias", "station", "--sigma-m", "0.1", "--draws", "4")
    code, _, error = run(monkeypatch, capsys, "monte-carlo", block, *words, "--out", tmp_path / "draws")
    assert code == 0 and "the block itself: sigma naught" in " ".join(error.split())


def test_what_did_not_converge_is_not_compared_and_nothing_of_it_is_significant():
    block = simulated("cross").block
    short = adjust(block, max_steps=1)
    assert not bool(short.converged)
    with pytest.raises(InputError, match="is no calibration: not converged"):
        compare(short, adjusted("cross"))
    table = Tables(short).interior
    assert table["sigma"].isna().all() and table["significant"].isna().all()
