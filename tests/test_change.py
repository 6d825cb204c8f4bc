"""Has a camera changed? Two calibrations of one camera are told apart as seldom as said, and a changed one is found."""

import json

import numpy as np
import pandas as pd
import pytest

from jaxphoto.camera import parameter_names
from jaxphoto.camera.conditions import Conditions
from jaxphoto.errors import InputError
from jaxphoto.io.conditions import write_conditions
from jaxphoto.stability import change, parameter_vector, with_parameters
from tests.commands import run
from tests.test_stability import GRID, ONE, SIGMAS, TWO, covariance
from tests.test_stability_command import TARGET_1, TARGET_2, written_set

NAMES = parameter_names(ONE)


@pytest.mark.slow
def test_calibrations_of_one_camera_are_told_apart_in_one_of_twenty():
    """Drawn from their covariances: uniform p-values of both tests, and 5 % of the points beyond their limit."""
    rng, q = np.random.default_rng(8), covariance()
    p_values, beyond = [], []
    for _ in range(200):
        pair = [
            with_parameters(ONE, parameter_vector(ONE) + e)
            for e in rng.multivariate_normal(np.zeros(len(q)), q, 2, method="eigh")
        ]
        found = change(*pair, GRID, (q, q))
        assert found.degrees_of_freedom == len(SIGMAS)
        p_values.append((found.p_parameters, found.field.uncertainty.p_value))
        beyond.append(found.beyond.mean())
    for level in (0.05, 0.5):
        assert (np.array(p_values) < level).mean(axis=0) == pytest.approx(
            level, abs=4 * np.sqrt(level * (1 - level) / 200)
        )
    # Offsets over the format are smooth: their mean is that of few numbers.
    assert np.mean(beyond) == pytest.approx(0.05, abs=4 * np.std(beyond) / 200**0.5)


def test_a_change_is_found_and_what_explains_nothing_is_said():
    """Twenty standard deviations of c, beyond the limit at nearly all points but where nothing moves."""
    q = covariance()
    moved = with_parameters(ONE, parameter_vector(ONE) + 20 * np.sqrt(np.diag(q)) * (np.array(NAMES) == "c_mm"))
    found = change(ONE, moved, GRID, (q, q))
    assert found.p_parameters < 1e-10 and found.field.uncertainty.p_value < 1e-10
    assert found.beyond.mean() > 0.5
    (c,) = (one for one in found.parameters if one.parameter == "c_mm")
    assert c.difference / c.sigma == pytest.approx(20 / np.sqrt(2))
    with pytest.raises(InputError, match="neither calibration has a covariance"):
        change(ONE, TWO, GRID, (None, None))


def test_the_command_compares_two_results(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "140")
    a, b = (written_set(tmp_path / name, "gopro", values) for name, values in (("one", TARGET_1), ("two", TARGET_2)))
    out = tmp_path / "out"
    code, text, _ = run(monkeypatch, capsys, "compare", a, b, "--out", out)
    assert code == 0
    difference = np.array([TARGET_2[n] - TARGET_1[n] for n in SIGMAS]) / np.array(list(SIGMAS.values()))
    chi_square = (difference**2).sum() / 2
    assert f"parameters: chi-square {chi_square:.1f} with {len(SIGMAS)} degrees" in text
    assert "bundle of rays, aligned by rotation" in text
    parameters, cells = pd.read_csv(out / "parameters.csv"), pd.read_csv(out / "cells.csv")
    own = parameters.set_index("parameter").loc[list(SIGMAS), "ratio"]
    np.testing.assert_allclose(own, difference / np.sqrt(2), rtol=1e-9)
    units = dict(zip(parameters["parameter"], parameters["unit"], strict=True))
    assert (units["c_mm"], units["k1"], units["k2"]) == ("mm", "1/mm^2", "1/mm^4")
    assert len(cells) == 165
    summary = json.loads((out / "summary.json").read_text())
    assert summary["chi_square"] == pytest.approx(chi_square)
    assert summary["n_beyond"] == cells.beyond.sum()


def test_one_calibration_is_not_compared_with_itself_and_shared_image_points_are_said(tmp_path, monkeypatch, capsys):
    a, b = (written_set(tmp_path / name, "gopro", values) for name, values in (("one", TARGET_1), ("two", TARGET_2)))
    code, _, error = run(monkeypatch, capsys, "compare", a, a)
    assert code == 2 and "are the same calibration" in error
    for folder, key, shared in ((a, "0", False), (b, "1", False), (b, "0", True)):
        rows = f"x/image_points.csv,9,{64 * key}\ny.csv,9,{63 * key}9\n"
        (folder / "inputs.csv").write_text(f"file,n_bytes,sha256\n{rows}")
        code, _, error = run(monkeypatch, capsys, "compare", a, b)
        assert code == 0 and ("A and B share photographs or image points" in error) == shared
    # A block tells the photographs behind its image points, too.
    write_conditions([Conditions("i", "i.jpg", 64 * "1")], a, ())
    (b / "inputs.csv").write_text(f"file,n_bytes,sha256\ni.jpg,9,{64 * '1'}\n")
    assert "A and B share photographs or image points" in run(monkeypatch, capsys, "compare", a, b)[2]
