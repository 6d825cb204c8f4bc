"""`jaxphoto orient`: photographs to a block folder that `jaxphoto adjust` reads; bad input in one sentence."""

import json

import numpy as np
import pytest
from PIL import Image

from jaxphoto.camera import InteriorOrientation
from jaxphoto.cli import orient as command
from jaxphoto.io import read_block
from jaxphoto.io.matching import MatchedPhotographs
from jaxphoto.io.photographs import CameraStart
from tests.commands import run
from tests.procedures.orientable import PIXEL, SENSOR, convergent, photographed


@pytest.fixture
def taken(tmp_path, monkeypatch):
    """Files of photographs that show nothing, and what would have been found in them: features and matches."""
    scene = photographed(convergent(n_images=7, n_points=220), false=0.1)
    paths = [tmp_path / f"{name}.png" for name in scene.names]
    for path in paths:
        Image.new("L", (SENSOR.width_px, SENSOR.height_px)).save(path)
    sigmas = [np.full(len(xy), 0.3 * PIXEL) for xy in scene.features]
    counts = np.array([(m.first, m.second, len(m.features) + 2, len(m.features)) for m in scene.matches])
    matched = MatchedPhotographs(scene.features, sigmas, 1.0, scene.matches, counts)
    monkeypatch.setattr(command, "match_photographs", lambda *arguments, **options: matched)
    start = CameraStart(SENSOR, InteriorOrientation(8.6), "c as given.")
    monkeypatch.setattr(command, "sensor_and_interior", lambda *arguments: start)
    return paths


def test_photographs_become_a_block(taken, tmp_path, monkeypatch, capsys):
    out = tmp_path / "block"
    code, said, wrong = run(monkeypatch, capsys, "orient", *taken, "--out", out)
    assert code == 0, wrong
    for part in ("c as given.", "7 of 7 images oriented", "off the epipolar line", "free of the camera: c_mm"):
        assert part in said
    block = read_block(out)
    assert block.images == tuple(p.stem for p in taken)
    assert block.start.image_known.all()
    assert block.start.point_known.all()
    summary = json.loads((out / "orientation.json").read_text())
    assert summary["n_images"] == len(summary["order"]) == 7
    assert summary["gross_errors"]["off_epipolar"] > 100
    assert {p.name for p in out.glob("*.png")} == {"orientation_network.png", "orientation_residuals.png"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--model", "pinhole"], "--model pinhole: there are brown"),
        (["--model", "ebner"], "has constants of its own"),
        (["--pairs", "nearest"], "the choice of pairs is 'nearest'"),
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
    assert "is not empty and holds no block" in wrong


def test_a_block_that_has_a_beginning_is_handed_back(tmp_path, monkeypatch, capsys):
    code, _, wrong = run(monkeypatch, capsys, "orient", "examples/cross_block", "--out", tmp_path / "block")
    assert code == 2
    assert "needs no orientation" in wrong
