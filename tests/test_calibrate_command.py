"""`jaxphoto calibrate`: rendered photographs in, a folder of results out; bad input in one sentence."""

import json
import shutil

import cv2
import numpy as np
import pandas as pd
import pytest

import jaxphoto
from jaxphoto.extras.photos.rendered_photographs import board_view
from jaxphoto.extras.photos.targets import read_board, rendered
from jaxphoto.procedures.calibration import target_calibration
from tests.commands import run
from tests.photos.test_targets import LENS, SENSOR

BOARD = "chessboard:8x5:square_mm=22"
IMAGES = 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Photographs of a board, one of nothing."""
    out = tmp_path_factory.mktemp("photographs")
    pattern = read_board(BOARD)
    for k in range(IMAGES):
        picture = rendered(pattern, SENSOR, LENS, board_view(pattern.board, k), noise=3.0, rays=13, seed=k)
        cv2.imwrite(str(out / f"p{k}.png"), picture)
    cv2.imwrite(str(out / "wall.png"), np.full((SENSOR.height_px, SENSOR.width_px), 120, np.uint8))
    return out


def test_calibrates_and_writes_everything(folder, monkeypatch, capsys, tmp_path):
    out, images = tmp_path / "out", sorted(folder.glob("*.png"))
    pixel = ("--pixel-mm", SENSOR.pixel_mm)
    code, screen, error = run(monkeypatch, capsys, "calibrate", *images, "--board", BOARD, "--out", out, *pixel)
    assert code == 0, error
    summary = json.loads((out / "summary.json").read_text())
    assert summary["converged"] is True
    assert summary["n_images_used"] == IMAGES
    assert list(summary["left_out"]) == ["wall"]
    assert summary["rms_px"] < 0.15
    assert "wall" in screen
    interior = pd.read_csv(out / "interior.csv").set_index("parameter")
    assert abs(interior.loc["c_mm", "value"] - float(LENS.c)) < 4 * interior.loc["c_mm", "sigma"]
    photographs = pd.read_csv(out / "photographs.csv")
    assert len(photographs) == IMAGES + 1
    assert photographs["used"].sum() == IMAGES
    pictures = {path.name for path in (out / "photographs").iterdir()}
    assert pictures == {"wall.png"} | {f"p{k}.png" for k in range(IMAGES)}
    assert "photographs/wall.png" in (out / "photographs.html").read_text()
    assert summary["settled"] is True
    assert "pixel size as given" in summary["start"]
    assert not any("pixel size" in finding["text"] for finding in summary["findings"])
    assert "photographs/p0.png" in (out / "photographs.html").read_text()
    assert (out / "report.html").is_file()
    block = jaxphoto.read_block(out / "block")
    assert block.images == tuple(f"p{k}" for k in range(IMAGES))
    assert float(block.start.unknowns.interior["camera"].distortion.r0) == 0.0


@pytest.mark.slow
def test_two_calibrations_are_compared(folder, monkeypatch, capsys, tmp_path):
    """The same photographs under names with brackets and dollars, with another R0, and no size of a pixel given."""
    named = [tmp_path / f"[x]{k}$a$ #1 [bold].png" for k in range(IMAGES)]
    for k, path in enumerate(named):
        shutil.copy(folder / f"p{k}.png", path)
    shutil.copy(folder / "wall.png", tmp_path / "[red]wall.png")
    outs = tmp_path / "[a]", tmp_path / "b"
    for out, r0 in zip(outs, (0, 2), strict=True):
        arguments = (*named, tmp_path / "[red]wall.png", "--board", BOARD, "--r0-mm", r0, "--out", out)
        code, screen, error = run(monkeypatch, capsys, "calibrate", *arguments, pictures=out == outs[0])
        assert code == 0, error
        assert "[red]wall" in screen
    summary = json.loads((outs[0] / "summary.json").read_text())
    assert "pixel size nominal" in summary["start"]
    assert "pixel size nominal" in (outs[0] / "report.html").read_text()
    assert "%5Bx%5D0" in (outs[0] / "photographs.html").read_text()
    code, screen, error = run(monkeypatch, capsys, "stability", *outs, "--out", tmp_path / "stability")
    assert code == 0, error
    rows = pd.read_csv(tmp_path / "stability" / "stability.csv").set_index("method")
    assert (rows["rmse_offset_mm"] < 1e-8).all()
    assert (rows["p_value"] > 0.99).all()


def test_rounds_that_do_not_settle_end_with_exit_code_1(folder, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(target_calibration, "_ROUNDS", 1)
    arguments = (*sorted(folder.glob("p*.png")), "--board", BOARD, "--out", tmp_path / "out", "--pixel-mm", 0.008)
    code, screen, _ = run(monkeypatch, capsys, "calibrate", *arguments)
    assert code == 1
    assert "did not converge" in " ".join(screen.split())
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["settled"] is False
    assert "did not converge" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--board", "chess"], ["chess", "chessboard:8x6:square_mm=30"]),
        (["--board", "chessboard:7x4:square_mm=22"], ["not found in any", "1 photographs"]),
        (["--board", BOARD, "--model", "pinhole"], ["pinhole", "smac"]),
        (["--board", BOARD, "--free", "c,q"], ["'q'", "c_mm"]),
        (["--board", BOARD, "--board-sigma-mm", "-1"], ["--board-sigma-mm", "positive"]),
        (["--board", BOARD], ["1 of 1 photographs", "3"]),
    ],
)
def test_bad_input_is_one_sentence_and_nothing_written(arguments, words, folder, monkeypatch, capsys, tmp_path):
    out = tmp_path / "out"
    image = folder / ("wall.png" if "7x4" in arguments[1] else "p0.png")
    code, _, error = run(monkeypatch, capsys, "calibrate", image, "--out", out, *arguments)
    assert code == 2
    assert all(word in error for word in words) and "Traceback" not in error
    assert not out.exists()


def test_no_picture_and_another_size_are_named(folder, monkeypatch, capsys, tmp_path):
    (tmp_path / "notes.jpg").write_text("not a picture")
    options = ("--board", BOARD, "--out", tmp_path / "out")
    code, _, error = run(monkeypatch, capsys, "calibrate", folder / "p0.png", tmp_path / "notes.jpg", *options)
    assert (code, "notes.jpg" in error) == (2, True)
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((100, 100), np.uint8))
    code, _, error = run(monkeypatch, capsys, "calibrate", folder / "p0.png", tmp_path / "small.png", *options)
    assert code == 2
    assert "small.png" in error
    assert "100 x 100" in error
