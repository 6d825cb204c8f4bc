"""`jaxphoto orient`: photographs to a block folder that `jaxphoto adjust` reads; bad input in one sentence."""

import json

import numpy as np
import pytest
from PIL import Image

from jaxphoto.camera import InteriorOrientation
from jaxphoto.extras.photos import matching
from jaxphoto.extras.photos.matching import MatchedPhotographs
from jaxphoto.io import read_block
from jaxphoto.io.photographs import CameraStart
from jaxphoto.procedures.orientation import orient_photographs
from tests.commands import run
from tests.procedures.orientable import PIXEL, SENSOR, convergent, photographed

pytest.importorskip("pycolmap", reason="pycolmap, which orients images, is not installed (extra photos)")


@pytest.fixture
def taken(tmp_path, monkeypatch):
    """Files of photographs that show nothing, and what would have been found in them: features and matches."""
    scene = photographed(convergent(n_images=7, n_points=220), false=0.1)
    paths = [tmp_path / f"{name}.png" for name in scene.names]
    for path in paths:
        Image.new("L", (SENSOR.width_px, SENSOR.height_px)).save(path)
    sigmas = [np.full(len(xy), 0.3 * PIXEL) for xy in scene.features]
    counts = np.array([(m.first, m.second, len(m.features) + 2, len(m.features)) for m in scene.matches])
    matched = MatchedPhotographs(scene.features, sigmas, 1.0, scene.matches, counts, {})
    monkeypatch.setattr(matching, "match_photographs", lambda *arguments, **options: matched)
    start = CameraStart(SENSOR, InteriorOrientation(8.6), "c as given.")
    monkeypatch.setattr("jaxphoto.io.photographs.sensor_and_interior", lambda *arguments: start)
    return paths


def test_photographs_become_a_block(taken, tmp_path, monkeypatch, capsys):
    out = tmp_path / "block"
    code, said, wrong = run(monkeypatch, capsys, "orient", *taken, "--out", out)
    assert code == 0, wrong
    for part in ("c as given.", "7 of 7 images oriented", "off the epipolar line", "estimated camera parameters: c_mm"):
        assert part in said
    block = read_block(out)
    assert block.images == tuple(p.stem for p in taken)
    assert block.start.image_known.all()
    assert block.start.point_known.all()
    summary = json.loads((out / "orientation.json").read_text())
    assert summary["n_images"] == len(summary["order"]) == 7
    assert summary["gross_errors"]["off_epipolar"] > 100
    assert summary["settled"] and summary["converged"]
    # Simulated rays err independently.
    assert all(0.8 < factor < 1.2 for factor in summary["sigma_factors"].values())
    assert summary["matching"] == {"n_gross": 2 * summary["n_pairs"], "sigma_factor": 1.0}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--model", "pinhole"], "pinhole"),
        (["--model", "brown", "--r0-mm", "3"], "R0 belongs to the model smac"),
        (["--r0-mm", "nan"], "R0 belongs to the model smac"),
        (["--model", "smac", "--r0-mm", "-1"], "R0 = -1 mm is outside the format"),
        (["--model", "smac", "--r0-mm", "nan"], "R0 = nan mm is outside the format"),
        (["--pairs", "nearest"], "unknown choice of pairs 'nearest'"),
    ],
)
def test_options_that_mean_nothing(arguments, message, taken, tmp_path, monkeypatch, capsys):
    code, _, wrong = run(monkeypatch, capsys, "orient", *taken, "--out", tmp_path / "block", *arguments)
    assert code == 2
    assert message in wrong
    assert wrong.count("\n") == 1


def test_a_folder_with_something_else_is_left_alone(taken, tmp_path, monkeypatch, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    code, _, wrong = run(monkeypatch, capsys, "orient", *taken, "--out", tmp_path / "full")
    assert code == 2
    assert "full is not empty" in wrong


def test_rounds_that_do_not_settle_are_said(taken, tmp_path, monkeypatch, capsys):
    # Not even an iteration that rejects nothing ends them.
    monkeypatch.setattr(orient_photographs, "_CONVERGED", -1.0)
    monkeypatch.setattr(orient_photographs, "_FEW", -1)
    monkeypatch.setattr(orient_photographs, "ITERATIONS", 2)
    out = tmp_path / "block"
    code, said, wrong = run(monkeypatch, capsys, "orient", *taken, "--out", out)
    assert code == 1, wrong
    assert "warning: the selection of image points did not converge" in said
    summary = json.loads((out / "orientation.json").read_text())
    assert not summary["settled"] and not summary["converged"]
    assert read_block(out).images


def test_photographs_that_show_nothing_are_named(taken, tmp_path, monkeypatch, capsys):
    """One that is blank is left out with its reason; its name is printed as it is, brackets and all."""
    blank = tmp_path / "wall[red].png"
    Image.new("L", (SENSOR.width_px, SENSOR.height_px)).save(blank)
    matched = matching.match_photographs()
    more = matched._replace(
        xy_mm=[*matched.xy_mm, np.zeros((0, 2))],
        sigma_mm=[*matched.sigma_mm, np.zeros(0)],
        left_out={"wall[red]": "no features: blank or out of focus"},
    )
    monkeypatch.setattr(matching, "match_photographs", lambda *arguments, **options: more)
    out = tmp_path / "block[1]"
    code, said, wrong = run(monkeypatch, capsys, "orient", *taken, blank, "--out", out)
    assert code == 0, wrong
    assert "7 of 8 images oriented" in said
    assert "not oriented: wall[red] (no features: blank or out of focus)" in said
    assert f"wrote {out}" in said
    summary = json.loads((out / "orientation.json").read_text())
    assert list(summary["unoriented"]) == ["wall[red]"]
