"""`jaxphoto control`: a block folder and files of control to the block with it, tables and a verdict."""

import hashlib
import json

import pandas as pd
import pytest

from jaxphoto.camera.conditions import Conditions
from jaxphoto.io import adjusted_block, read_block, write_block
from jaxphoto.io.conditions import read_conditions, write_conditions
from jaxphoto.io.result_tables import read_inputs
from tests.commands import run
from tests.procedures.controlled import CHECK, CODE, CONTROL, marked_block


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The block, points and marks as files."""
    folder, marked = tmp_path_factory.mktemp("written"), marked_block()
    write_block(marked.block, folder / "block")
    write_conditions([Conditions(marked.block.images[0], "a.jpg", 64 * "0", model="Model 1")], folder / "block", ())
    points, marks = marked.control
    table = pd.DataFrame(points.coordinates, columns=["X_m", "Y_m", "Z_m"])
    table.insert(0, "point", points.ids)
    table = table.assign(sigma_m=0.02, role=["check" if check else "control" for check in points.check])
    table = table.rename(columns={"sigma_m": "sigma_X_m"})
    table.to_csv(folder / "points.csv", index=False)
    seen = pd.DataFrame({"image": marks.image, "point": marks.point})
    seen[["x_px", "y_px"]] = marks.column_row
    seen.assign(sigma_px=0.5).to_csv(folder / "marks.csv", index=False)
    return folder


@pytest.mark.slow
def test_a_block_is_adjusted_with_control(written, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    given = (written / "block", written / "points.csv", "--marks", written / "marks.csv", "--control-epsg", CODE)
    _, said, _ = run(monkeypatch, capsys, "control", *given, "--out", out)
    assert "6 of 6 control points define the frame of the block" in said
    assert "3 check points: RMSE" in said
    points = pd.read_csv(out / "surveyed_points.csv")
    assert (points["state"] == ["control"] * len(CONTROL) + ["check"] * len(CHECK)).all()
    assert (points[["w_X", "w_Y", "w_Z"]].max() < 4).all()
    assert len(pd.read_csv(out / "control_marks.csv")) == points["n_marks"].sum()
    block = read_block(out / "block")
    assert block.frame.code == CODE and len(block.control) == 18 and len(block.check) == 9
    page = (out / "result" / "report.html").read_text(encoding="utf-8")
    # The camera is held: no table without rows.
    assert "Correlation of exterior" not in page
    told = {f.file: f.sha256 for f in read_inputs(out / "result" / "inputs.csv")}
    for file in (*(written / "block").glob("[!.]*"), written / "points.csv", written / "marks.csv"):
        assert told[file.name] == hashlib.sha256(file.read_bytes()).hexdigest()
    (flown,) = read_conditions(out / "result" / "conditions.csv")
    assert flown.model == "Model 1" and (out / "block" / "conditions.csv").is_file()
    summary = json.loads((out / "result" / "summary.json").read_text())
    assert summary["method"]["command"] == "control" and summary["method"]["control_epsg"] == str(CODE)
    assert adjusted_block(out / "result").images == block.images
    assert "Provenance" in page and "jaxphoto control" in page and "points.csv" in page


def test_what_cannot_be_is_said(written, tmp_path, monkeypatch, capsys):
    for arguments, message in (
        ((written / "marks.csv",), "marks.csv has marks but no coordinates"),
        ((written / "none.csv",), "file not found"),
    ):
        given = (written / "block", *arguments, "--out", tmp_path / "o")
        code, _, wrong = run(monkeypatch, capsys, "control", *given)
        assert code == 2 and message in wrong and not (tmp_path / "o").exists()
