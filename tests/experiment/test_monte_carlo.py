"""Monte Carlo runs on disk: files, and resumption after a stop."""

import dataclasses
import json
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pandas as pd
import pytest

from jaxphoto import InputError, bias
from jaxphoto.experiment import MonteCarlo
from jaxphoto.experiment.monte_carlo_run import _errors_line
from jaxphoto.io import write_block
from jaxphoto.sensitivity import Readjustment, noise
from jaxphoto.sensitivity.exact import sensitivity
from tests.blocks import adjusted, simulated
from tests.commands import run
from tests.levelling import HeightDifferences
from tests.marks import slow_but

NOMINAL = "strips"


def study(directory, draws=1100, seed=1, errors=None, precision=None) -> MonteCarlo:
    nominal = adjusted("cross")
    errors = bias(nominal.block, "station", 0.1, "block") if errors is None else errors
    run = Readjustment(nominal, errors.applied, errors.sigma[None])
    return MonteCarlo(nominal.block, run, errors, draws, seed, directory, precision)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of several parts that nobody stopped."""
    directory = tmp_path_factory.mktemp("draws") / "run"
    done = study(directory)
    done.draw()
    return directory, done.write()


def test_the_promised_files_and_columns(whole):
    directory, (summary, table) = whole
    assert {p.name for p in directory.iterdir()} == {
        "draws.parquet", "summary.csv", "summary.json", "effects.csv", "run.json",
    }  # fmt: skip
    draws = pd.read_parquet(directory / "draws.parquet")
    assert list(draws["draw"]) == list(range(1100))
    assert list(draws.columns[:4]) == ["draw", "converged", "iterations", "fallback"]
    assert {"bias.block.X_m", "bias.block.Y_m", "bias.block.Z_m", "one.c_mm", "one.k1"} <= set(draws.columns)
    assert draws["converged"].all()
    assert (summary["draws"], summary["fallbacks"], summary["converged"]) == (1100, 0, 1100)
    assert set(summary["seconds"]) == {"compile", "draws"}
    assert json.loads((directory / "summary.json").read_text()) == summary
    assert summary["draws_per_second"] > 0
    assert list(table.columns) == [
        "quantity", "nominal", "mean", "sd", "q025", "q50", "q975", "predicted_sigma", "ratio", "unit",
    ]  # fmt: skip
    rows = table.set_index("quantity")
    assert rows.loc["one.c_mm", "sd"] == pytest.approx(draws["one.c_mm"].std(), rel=1e-12)
    # The standard deviation of a sample of n is off by 1 / sqrt(2 n).
    assert np.abs(table["ratio"] - 1).max() < 5 / np.sqrt(2 * 1100)
    effects = pd.read_csv(directory / "effects.csv")
    assert rows.loc["one.c_mm", "predicted_sigma"] == pytest.approx(np.hypot.reduce(effects["one.c_mm"]), rel=1e-9)


class Stop(Exception):
    """Stands for whatever ends a process."""


@pytest.mark.parametrize("at", slow_but((1030,), (1, 1030, 1100)))
def test_a_stopped_run_continues_to_the_same_file(whole, tmp_path, at):
    def stop(done: int) -> None:
        if done >= at:
            raise Stop

    with pytest.raises(Stop):
        study(tmp_path / "run").draw(stop)
    assert not (tmp_path / "run" / "draws.parquet").exists()
    again = study(tmp_path / "run")
    again.draw()
    again.write()
    directory, _ = whole
    assert (tmp_path / "run" / "draws.parquet").read_bytes() == (directory / "draws.parquet").read_bytes()
    assert (tmp_path / "run" / "summary.csv").read_bytes() == (directory / "summary.csv").read_bytes()
    assert not (tmp_path / "run" / "parts").exists()


def test_of_a_large_block_every_batch_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxphoto.experiment.monte_carlo_run._PART_ROWS", 1)
    made = study(tmp_path / "run", draws=200)

    def stop(done: int) -> None:
        if done >= made.run.batch_size:
            raise Stop

    with pytest.raises(Stop):
        made.draw(stop)
    assert len(pd.read_parquet(tmp_path / "run" / "parts")) == made.run.batch_size


def test_a_finished_run_is_only_read(whole):
    directory, (summary, _) = whole
    before = (directory / "summary.json").stat().st_mtime_ns
    again = study(directory)
    again.draw()
    assert again.write()[0] == summary
    assert (directory / "summary.json").stat().st_mtime_ns == before


@pytest.mark.parametrize(("changed", "name"), [({"seed": 2}, "seed"), ({"draws": 5}, "draws")])
def test_another_run_is_not_overwritten(whole, changed, name):
    directory, _ = whole
    before = (directory / "draws.parquet").read_bytes()
    with pytest.raises(InputError, match=f"other settings .{name}"):
        study(directory, **changed)
    assert (directory / "draws.parquet").read_bytes() == before


def test_other_errors_of_the_same_names_are_another_run(whole):
    directory, _ = whole
    of_control = bias(adjusted("cross").block, "control", 0.1, "block")
    assert of_control.names == bias(adjusted("cross").block, "station", 0.1, "block").names
    with pytest.raises(InputError, match=r"other settings .errors"):
        study(directory, errors=of_control)
    laplace = bias(adjusted("cross").block, "station", 0.1, "block", distribution=jax.random.laplace)
    with pytest.raises(InputError, match=r"other settings .first_draws"):
        study(directory, errors=laplace)


def test_unreadable_settings_are_refused(tmp_path):
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(InputError, match=r"run\.json: not a JSON file"):
        study(tmp_path)


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(InputError, match="has no Monte Carlo run"):
        study(tmp_path)
    with pytest.raises(InputError, match="is a file"):
        study(tmp_path / "thesis.txt" / "run")
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.slow
def test_noise_is_predicted_by_the_observations_own_sigmas(tmp_path):
    nominal = adjusted("cross")
    made = study(tmp_path / "run", draws=4, errors=noise(nominal.block))
    made.draw()
    _, table = made.write()
    of = table.set_index("quantity")["predicted_sigma"]
    derivatives, block = sensitivity(nominal, curvature=False), nominal.block
    groups = {"image_points": block.image_points, "stations": block.stations, "control_points": block.control}
    variance = sum((derivatives.groups[name] ** 2) @ np.ravel(rows.sigma) ** 2 for name, rows in groups.items())
    for label in nominal.structure.labels:
        expected = np.sqrt(variance[derivatives.row(label)])
        assert of[label.replace("interior[one]", "one")] == pytest.approx(expected, rel=2e-3)


@pytest.mark.slow
def test_a_block_that_estimates_no_camera(tmp_path):
    nominal = adjusted("fixed_interior")
    wrong = bias(nominal.block, "interior", 0.02, parameter="c_mm")
    run = Readjustment(nominal, wrong.applied, wrong.sigma[None], points=True)
    made = MonteCarlo(nominal.block, run, wrong, 3, 0, tmp_path / "run")
    made.draw()
    summary, table = made.write()
    assert summary["converged"] == 3
    assert (table["quantity"].str.startswith("point.")).any()


@pytest.mark.slow
def test_a_block_that_estimates_a_scanner(tmp_path):
    nominal = adjusted("surfaces")
    wrong = bias(nominal.block, "station", 0.1, "block")
    made = MonteCarlo(nominal.block, Readjustment(nominal, wrong.applied, wrong.sigma[None]), wrong, 3, 0, tmp_path)
    made.draw()
    _, table = made.write()
    scanner = nominal.unknowns.scanner
    of = table.set_index("quantity")["nominal"]
    turn = [of[f"scanner.boresight_{axis}_deg"] for axis in ("right", "forward", "up")]
    assert np.radians(turn) == pytest.approx(np.asarray(scanner.boresight), rel=1e-9)
    for strip, shift in scanner.shifts.items():
        assert [of[f"scanner.{strip}.shift_{axis}_m"] for axis in "XYZ"] == pytest.approx(np.asarray(shift), rel=1e-9)


def test_errors_of_further_kinds_of_observations_are_listed(tmp_path):
    """They are found by their number in `Block.more`."""
    nominal = adjusted("cross")
    levelled = HeightDifferences(np.array([0]), np.array([1]), np.zeros(1), np.array([0.01]))
    drawn = noise(dataclasses.replace(nominal.block, more=(levelled,)))
    assert ("more", 0, "value") in drawn.targets
    assert _errors_line(drawn).startswith(f"{len(drawn.names)} of control, image_points, more, stations, ")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("block") / "block"
    write_block(simulated(NOMINAL).block, path)
    return path


def test_the_command(folder, monkeypatch, capsys, tmp_path):
    out = tmp_path / "run"
    options = ("--bias", "station", "--per", "strip", "--sigma-m", "0.05,0.05,0.1", "--draws", 20, "--seed", 3)
    command = ("monte-carlo", folder, *options, "--with", "exterior", "--with", "points", "--out", out)
    code, printed, _ = run(monkeypatch, capsys, *command)
    assert code == 0 and "20 draws, 20 converged" in printed
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "20 draws, 20 converged." in page and "--sigma-m 0.05,0.05,0.1" in page
    assert "Images, points and trajectory knots are in summary.csv." in page
    assert f"exterior.{simulated(NOMINAL).block.images[0]}" not in page
    draws = pd.read_parquet(out / "draws.parquet")
    block = simulated(NOMINAL).block
    strips = set(block.image_strip)
    assert {f"bias.{strip}.{axis}_m" for strip in strips for axis in "XYZ"} <= set(draws.columns)
    assert f"exterior.{block.images[0]}.kappa_deg" in draws.columns
    assert f"point.{block.points[0]}.Z_m" in draws.columns
    assert any(c.startswith("strips.") for c in draws.columns)


@pytest.mark.parametrize(
    "options, words",
    [
        (("--bias", "station", "--sigma-m", "0.1", "--on", "S9", "--per", "strip"), "unknown strip 'S9'"),
        (("--bias", "station", "--sigma-m", "0.1", "--draws", "0"), "must be positive, got 0"),
        (("--bias", "station", "--sigma-deg", "0.1"), "give --sigma-m"),
        (("--bias", "station", "--sigma-m", "much"), "--sigma-m much"),
        (("--bias", "station", "--sigma-m", "-1"), "above zero"),
        (("--bias", "wind", "--sigma-m", "1"), "'wind' is not one of 'station'"),
        (("--bias", "noise", "--sigma-m", "1"), "omit --sigma-m"),
        (("--bias", "noise", "--per", "strip"), "omit --per"),
        (("--bias", "station", "--sigma-m", "1", "--with", "all"), "--with all: choose from exterior, points"),
    ],
)
def test_a_mistake_is_one_sentence_and_nothing_written(folder, monkeypatch, capsys, tmp_path, options, words):
    code, _, error = run(monkeypatch, capsys, "monte-carlo", folder, "--out", tmp_path / "run", *options)
    assert code == 2 and words in error and "Traceback" not in error and not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_killed_run_continues_to_the_same_file(folder, tmp_path):
    program = [sys.executable, "-c", "from jaxphoto_command import main; main()", "monte-carlo", str(folder)]
    program += ["--bias", "station", "--per", "image", "--sigma-m", "0.1", "--draws", "10000"]
    subprocess.run([*program, "--out", str(tmp_path / "whole")], check=True, capture_output=True)
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    killed = subprocess.Popen([*program, "--out", str(tmp_path / "killed")], **silent)
    parts = tmp_path / "killed" / "parts"
    while not list(parts.glob("part-*.parquet")):
        assert killed.poll() is None
        time.sleep(0.02)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert not (tmp_path / "killed" / "draws.parquet").exists()
    subprocess.run([*program, "--out", str(tmp_path / "killed")], check=True, capture_output=True)
    for name in ("draws.parquet", "summary.csv"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_run_ends_when_the_standard_deviations_are_precise(tmp_path):
    """The uncertainty of a standard deviation is that of resampling; where the run ends depends on the draws alone."""
    ends = []
    for k, early in enumerate(([], [3, 1])):
        made = study(tmp_path / str(k), draws=4000, precision=0.04)
        # A run whose parts were written in another order ends at the same draw.
        for part, table in made._parts(early, None):
            made.folder.write_part(part, table)
        made.draw()
        ends.append(pd.read_parquet(tmp_path / str(k) / "draws.parquet"))
    assert ends[0].equals(ends[1])
    n = len(ends[0])
    assert 200 < n < 1000
    estimates = ends[0][[c for c in ends[0] if c.startswith("one.")]]
    resampled = [estimates.sample(n, replace=True, random_state=k).std() for k in range(300)]
    scatter = (pd.DataFrame(resampled).std() / estimates.std()).max()
    assert made.uncertainty <= 0.04
    assert made.uncertainty == pytest.approx(scatter, rel=0.25)
