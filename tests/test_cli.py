"""The command line: files written, exit codes, and one sentence for every mistake."""

import dataclasses
import html
import json
import re
import shlex
import subprocess
import sys

import jax
import numpy as np
import pandas as pd
import pytest

import jaxphoto
import jaxphoto_command
from jaxphoto.errors import InputError
from jaxphoto.io import write_block
from jaxphoto.writing import MARKER, check_folder
from tests.blocks import simulated
from tests.commands import run

FILES = {
    MARKER,
    "summary.json",
    "interior.csv",
    "exterior.csv",
    "object_points.csv",
    "residuals.csv",
    "trends.csv",
    "check_points.csv",
    "correlation.csv",
    "correlation_summary.csv",
    "correlation_ground.csv",
    "sigma_map.csv",
    "convergence.csv",
    "inputs.csv",
    "report.html",
}
XYZ = ["X_m", "Y_m", "Z_m"]
EOP = [*XYZ, "omega_deg", "phi_deg", "kappa_deg"]
COLUMNS = {
    "interior": ["camera", "parameter", "value", "sigma", "significant", "unit"],
    "exterior": ["image", *EOP, *(f"sigma_{n}" for n in EOP)],
    "object_points": ["point", *XYZ, *(f"sigma_{n}" for n in XYZ), "n_images", "angle_deg"],
    "residuals": [
        "group",
        "image",
        "point",
        "axis",
        "residual",
        "sigma",
        "unit",
        "redundancy_number",
        "w",
        "detectable",
        "c_moves",
        "xp_moves",
        "yp_moves",
        "most_moves",
    ],
    "trends": ["pattern", "freedom", "p_value", "rms", "unit", "term", "share", "amount", "sigma"],
    "check_points": ["point", "dX_m", "dY_m", "dZ_m", "sigma_dX_m", "sigma_dY_m", "sigma_dZ_m"],
    "correlation": ["parameter_a", "parameter_b", "rho"],
    "correlation_summary": ["camera", "exterior", "interior", "mean_abs_rho", "max_abs_rho"],
    "correlation_ground": ["camera", "ground", "sigma_m", "parameter", "rho"],
    "sigma_map": ["camera", "distance_m", "x_mm", "y_mm", "sigma_x_px", "sigma_y_px", "worst_px"],
    "convergence": ["step", "sigma0", "length", "damping", "bent", "taken"],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("cli") / "block"
    write_block(simulated("cross").block, path)
    return path


@pytest.fixture(scope="module")
def results(folder):
    """The results of one run as a user starts it: another process, no terminal."""
    out = folder.parent / "results"
    done = subprocess.run(
        [sys.executable, "-c", "from jaxphoto_command import main; main()", "adjust", folder, "--out", out],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not re.search("warning|error|Traceback", done.stderr, re.IGNORECASE), done.stderr
    return out, done.stdout


def test_exactly_the_promised_files_with_the_promised_columns(results):
    out, _ = results
    assert {p.name for p in out.iterdir()} == FILES
    for name, columns in COLUMNS.items():
        assert list(pd.read_csv(out / f"{name}.csv").columns) == columns, name


def test_files_say_what_the_adjustment_says(results, folder):
    out, screen = results
    adjusted = jaxphoto.adjust(jaxphoto.read_block(folder))
    tables = jaxphoto.Tables(adjusted)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["sigma0"] == pytest.approx(float(adjusted.sigma0), rel=1e-9)
    assert summary["redundancy"] == adjusted.redundancy
    assert summary["converged"] is True
    assert summary["verdict"] == jaxphoto.report.verdict_of(tables).colour != "red"
    assert [f["text"] for f in summary["findings"]] == jaxphoto.report.verdict_of(tables).texts
    assert summary["outcome"].startswith("converged")
    counts = summary["n_observations"]
    assert counts["total"] == sum(n for group, n in counts.items() if group != "total")
    assert counts["total"] - summary["n_unknowns"]["total"] == summary["redundancy"]
    assert list(summary["seconds"]) == ["read", "start", "compile", "solve", "covariance", "write"]
    assert all(s >= 0 for s in summary["seconds"].values())
    assert summary["versions"]["jaxphoto"] == jaxphoto.__version__
    for name in ("interior", "exterior", "object_points", "check_points", "correlation"):
        written, ours = pd.read_csv(out / f"{name}.csv"), getattr(tables, name)
        numbers = ours.select_dtypes("number").columns
        np.testing.assert_allclose(written[numbers], ours[numbers], rtol=1e-5, atol=1e-9)
    residuals = pd.read_csv(out / "residuals.csv")
    assert residuals["redundancy_number"].sum() == pytest.approx(adjusted.redundancy, abs=1e-6)
    weighted = residuals["residual"] / residuals["sigma"]
    assert (weighted**2).sum() == pytest.approx(float(adjusted.sum_of_squares), rel=1e-6)
    assert f"{float(adjusted.sigma0):.6g}" in screen
    for axis in "XYZ":
        off = tables.check_points[f"d{axis}_m"].dropna()
        if len(off):
            assert summary["check_points"][axis]["rmse_m"] == pytest.approx((off**2).mean() ** 0.5)
            row = re.search(rf"│ {axis} +│ *{len(off)} *│ *\S+ *│ *(\S+) *│ *(\S+) *│ *(\S+)", screen)
            assert float(row[1]) == pytest.approx((off**2).mean() ** 0.5, rel=6e-3)
            assert float(row[2]) == pytest.approx(off.abs().max(), rel=6e-3)
            assert row[3] == tables.check_points["point"][off.abs().idxmax()]
    assert re.search(r"│ c +│ +3", screen)


def test_report_opens_without_a_network(results):
    page = (results[0] / "report.html").read_text()
    assert page.startswith("<!DOCTYPE html>")
    assert not re.search(r'<(img|script|link)[^>]*(src|href)="(?!data:)', page)
    assert page.count('<figure role="img"') >= 3


def test_the_command_of_a_report_is_typed_again(results, folder, monkeypatch, capsys, tmp_path):
    page = (results[0] / "report.html").read_text()
    words = shlex.split(html.unescape(re.search(r"<th>command</th><td>(.*?)</td>", page)[1]))
    assert words[:3] == ["jaxphoto", "adjust", str(folder)] and "--out" not in words
    code, *_ = run(monkeypatch, capsys, *words[1:], "--out", tmp_path / "again")
    assert code == 0
    assert (tmp_path / "again" / "interior.csv").read_bytes() == (results[0] / "interior.csv").read_bytes()


def test_results_replace_earlier_results_and_nothing_else(results, folder, monkeypatch, capsys, tmp_path):
    other = tmp_path / "thesis"
    other.mkdir()
    (other / "chapter.txt").write_text("years of work")
    code, _, error = run(monkeypatch, capsys, "adjust", folder, "--out", other)
    assert code == 2
    assert "thesis" in error
    assert (other / "chapter.txt").read_text() == "years of work"
    (results[0] / "notes.txt").write_text("mine")
    code, _, _ = run(monkeypatch, capsys, "adjust", folder, "--out", results[0])
    assert code == 0
    assert {p.name for p in results[0].iterdir()} == FILES | {"notes.txt"}
    assert (results[0] / "notes.txt").read_text() == "mine"
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "summary.json").write_text("{}")
    code, _, error = run(monkeypatch, capsys, "adjust", folder, "--out", foreign)
    assert code == 2
    assert "foreign is not empty" in error
    assert [p.name for p in foreign.iterdir()] == ["summary.json"]


def test_not_converged_is_written_and_exit_code_one(folder, monkeypatch, capsys, tmp_path):
    code, screen, _ = run(monkeypatch, capsys, "adjust", folder, "--out", tmp_path / "out", "--max-steps", 1)
    assert code == 1
    assert "not converged" in screen
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["converged"] is False
    assert summary["verdict"] == "red"
    assert "step limit" in summary["outcome"]
    # What reads results takes no calibration from these.
    code, _, error = run(monkeypatch, capsys, "camera", tmp_path / "out", tmp_path / "camera.toml")
    assert code == 2
    assert "did not converge" in error


def test_blunders_are_left_out_and_written(folder, monkeypatch, capsys, tmp_path):
    spoilt, out = tmp_path / "spoilt", tmp_path / "out"
    block = jaxphoto.read_block(folder)
    rows, value = block.stations, np.array(block.stations.value)
    value[5] += 7.0
    write_block(block.with_observations({"stations": dataclasses.replace(rows, value=value)}), spoilt)
    code, screen, _ = run(monkeypatch, capsys, "adjust", spoilt, "--out", out)
    named = str(rows.words(block.images, block.points)[5])
    assert code == 1
    assert screen.splitlines()[1].startswith("red")
    assert named in screen
    code, screen, _ = run(monkeypatch, capsys, "adjust", spoilt, "--out", out, "--snoop")
    assert code == 0
    assert f"rejected: {named}" in " ".join(screen.split())
    left = pd.read_csv(out / "left_out.csv")
    assert left["observation"].tolist() == [named]
    assert abs(left["error"][0] - 7.0) < 5 * left["sigma"][0]
    assert len(jaxphoto.read_block(out / "block").stations) == len(rows) - 1


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: (f / "images.csv").unlink(), ["images.csv"]),
        (lambda f: _replace(f / "block.toml", 'distortion = "brown"', 'distortion = "brawn"'), ["block.toml", "brawn"]),
        (lambda f: [(f / n).unlink() for n in ("stations.csv", "control_points.csv")], ["datum", "7", "stations"]),
    ],
)
def test_bad_input_is_one_sentence_and_nothing_written(spoil, words, monkeypatch, capsys, tmp_path):
    folder, out = tmp_path / "block", tmp_path / "out"
    write_block(simulated("cross").block, folder)
    spoil(folder)
    code, screen, error = run(monkeypatch, capsys, "adjust", folder, "--out", out)
    assert code == 2
    assert screen == ""
    sentence = [line for line in error.splitlines() if line.startswith("jaxphoto: ")]
    assert len(sentence) == 1
    assert "Traceback" not in error
    assert all(word in sentence[0] for word in words), sentence[0]
    assert {p.name for p in tmp_path.iterdir()} == {"block"}


def test_unknowns_that_cannot_be_told_apart_are_named(monkeypatch, capsys, tmp_path):
    folder = tmp_path / "block"
    write_block(simulated("cross").block, folder)
    _replace(folder / "block.toml", 'distortion = "brown"', 'distortion = "smac"')
    text = (folder / "block.toml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith(("k3", "p1", "p2", "b1", "b2"))]
    text = "\n".join(lines).replace("unknowns]\n", 'unknowns]\nk0 = "free"\n')
    (folder / "block.toml").write_text(text)
    code, _, error = run(monkeypatch, capsys, "adjust", folder, "--out", tmp_path / "out")
    assert code == 2
    assert "interior[one].c_mm" in error
    assert "interior[one].k0" in error
    assert not (tmp_path / "out").exists()


def test_rotations_of_the_correlations(folder, monkeypatch, capsys, tmp_path):
    out = tmp_path / "out"
    assert run(monkeypatch, capsys, "adjust", folder, "--out", out, "--rotations", "object")[0] == 0
    summary = pd.read_csv(out / "correlation_summary.csv")
    assert set(summary["exterior"]) == {"X", "Y", "Z", "rX", "rY", "rZ"}
    assert run(monkeypatch, capsys, "adjust", folder, "--out", out, "--rotations", "gimbal")[0] == 2


@pytest.mark.parametrize("command", ["adjust", "boresight", "convert"])
def test_results_below_a_file_are_refused(folder, monkeypatch, capsys, tmp_path, command):
    (tmp_path / "notes").write_text("a file")
    out = tmp_path / "notes" / "out"
    code, _, error = run(monkeypatch, capsys, command, folder, *([] if command == "convert" else ["--out"]), out)
    assert code == 2
    assert error.startswith("jaxphoto: ") and error.count("\n") == 1 and "notes" in error
    assert [p.name for p in tmp_path.iterdir()] == ["notes"]


def test_convert_writes_a_block_that_reads_the_same(folder, monkeypatch, capsys, tmp_path):
    copy = tmp_path / "copy"
    code, screen, _ = run(monkeypatch, capsys, "convert", folder, copy)
    assert code == 0
    assert "copy" in screen
    one, two = jaxphoto.read_block(folder), jaxphoto.read_block(copy)
    np.testing.assert_array_equal(one.image_points.xy, two.image_points.xy)
    code, _, error = run(monkeypatch, capsys, "convert", folder, tmp_path / "else", "--format", "bingo")
    assert code == 2
    assert "bingo" in error


def test_other_programs_get_the_summary_and_who_asks_for_silence_gets_it(folder, monkeypatch, capsys):
    out = folder.parent / "silent"
    code, screen, errors = run(monkeypatch, capsys, "adjust", folder, "--out", out, "--json", "--quiet")
    assert code == 0 and errors == ""
    told = json.loads(screen)
    summary = {name: told[name] for name in ("verdict", "findings")} | told["summary"]
    assert summary == json.loads((out / "summary.json").read_text())
    assert run(monkeypatch, capsys, "adjust", folder, "--out", out, "-q") == (0, "", "")


def test_version_and_help(monkeypatch, capsys):
    assert run(monkeypatch, capsys, "--version")[1].strip() == f"jaxphoto {jaxphoto.__version__}"
    assert "adjust" in run(monkeypatch, capsys, "--help")[1]


@pytest.mark.parametrize(
    ("words", "ends"),
    [
        ("jaxphoto stab", ["stability"]),
        ("jaxphoto adjust --ro", ["--rotations", "--robust"]),
        ("jaxphoto adjust block --robust t", ["tukey"]),
        ("jaxphoto stability a b --method ", ["zrot", "rot", "spr"]),
    ],
)
def test_a_shell_completes_commands_options_and_what_they_take(words, ends, monkeypatch, capsys):
    monkeypatch.setenv("_JAXPHOTO_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split(" ")) - 1))
    assert run(monkeypatch, capsys)[1].split() == ends


def _replace(path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_results_never_take_the_place_of_what_they_are_made_of(tmp_path):
    results = tmp_path / "results"
    (results / "block").mkdir(parents=True)
    (results / "summary.json").write_text("{}")
    for given in (results, results / "block", results / "interior.csv"):
        with pytest.raises(InputError, match="would be lost"):
            check_folder(results, tmp_path / "another", given)


@pytest.mark.parametrize("make", [np.zeros, jax.numpy.zeros])
def test_too_little_memory_is_one_sentence(make, monkeypatch, capsys):
    monkeypatch.setattr("jaxphoto_command.application.app", lambda **_: make((10**7, 10**8)).sum())
    code, out, err = run(monkeypatch, capsys, "adjust")
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert err.startswith("jaxphoto: not enough memory. Close other programs")


def test_other_errors_of_xla_are_not_taken_for_it(monkeypatch, capsys):
    def broken(**_):
        raise jax.errors.JaxRuntimeError("INTERNAL: no such thing")

    monkeypatch.setattr("jaxphoto_command.application.app", broken)
    monkeypatch.setattr(sys, "argv", ["jaxphoto"])
    with pytest.raises(jax.errors.JaxRuntimeError):
        jaxphoto_command.main()
