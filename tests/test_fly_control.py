"""`jaxphoto fly` with control measured in rendered photographs, whose positions are 20 m too high."""

import hashlib
import json

import numpy as np
import pandas as pd
import pytest

from jaxphoto.extras.photos.rendered_photographs import SENSOR, ground_texture
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.io import read_block
from tests.commands import run
from tests.photos.ground import mapped, photograph
from tests.procedures.controlled import CODE, ORIGIN
from tests.test_fly_command import C_MM, PIXEL_MM, with_position

SURVEYED = np.array(
    [[-22.13, -17.31], [24.4, -15.87], [1.27, 2.33], [-20.2, 18.61], [21.05, 19.44], [9.31, -8.2], [-9.45, 9.06]]
)
FIRST_M = 30.0
"""Height of the ground above the ellipsoid by the survey; the receivers say 20 m more, and 1.5 m east."""


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Twelve photographs with positions, and the survey of what they show."""
    folder, rng = tmp_path_factory.mktemp("flown"), np.random.default_rng(4)
    (folder / "photographs").mkdir()
    frame = MapFrame(CODE, None, ORIGIN)
    ground = 0.7 * ground_texture(rng, 2400).astype(np.float32) + 40
    marks = []
    for k in range(12):
        at = np.array([14.0 * (k % 4) - 21, 14.0 * (k // 4) - 14, 60.0 + 8 * (k % 3)])
        path = folder / "photographs" / f"a{k:02}.png"
        matrix = photograph(path, ground, at, (*rng.uniform(-14, 14, 2), 90.0 * (k % 4)), rng)
        for p, xy in enumerate(mapped(matrix, SURVEYED) + 0.5):
            if (xy > 3).all() and (xy < (SENSOR.width_px - 3, SENSOR.height_px - 3)).all():
                marks.append((f"a{k:02}.jpg", f"P{p}", *(xy + rng.normal(0, 0.1, 2)), 0.1))
        recorded = at + rng.normal(0, 0.03, 3) + [1.5, 0, FIRST_M + 20.0]
        with_position(path, frame.place(frame.map(recorded[None]))[0])
    xyz = np.column_stack([SURVEYED, np.full(len(SURVEYED), FIRST_M)]) + rng.normal(0, 0.01, (len(SURVEYED), 3))
    table = pd.DataFrame(frame.map(xyz), columns=["X_m", "Y_m", "Z_m"])
    table.insert(0, "point", [f"P{k}" for k in range(len(xyz))])
    table["sigma_X_m"] = 0.01
    table["role"] = ["control"] * 5 + ["check"] * 2
    table.to_csv(folder / "survey.csv", index=False)
    names = ["image", "point", "x_px", "y_px", "sigma_px"]
    pd.DataFrame(marks, columns=names).to_csv(folder / "marks.csv", index=False)
    return folder


@pytest.mark.slow
def test_a_flight_is_brought_onto_its_control(flown, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    given = ("--c-mm", 3.7, "--pixel-mm", PIXEL_MM, "--features", 500, "--control", flown / "survey.csv")
    told = ("--control-epsg", CODE, "--marks", flown / "marks.csv")
    _, said, wrong = run(monkeypatch, capsys, "fly", flown / "photographs", "--out", out, *given, *told)
    assert "control points define the frame of the block" in said, said + wrong
    summary = json.loads((out / "summary.json").read_text())["parts"][0]
    assert summary["epsg"] == CODE and summary["control"]["control"]["points"] == 5, summary
    points = pd.read_csv(out / "result" / "surveyed_points.csv")
    check = points[points["state"] == "check"]
    assert len(check) == 2 and (check[["dX_m", "dY_m", "dZ_m"]].abs().max() < 0.1).all()
    assert (check[["w_X", "w_Y", "w_Z"]] < 4).all(axis=None)
    block = read_block(out / "block")
    assert len(block.control) == 15 and len(block.check) == 6
    interior = pd.read_csv(out / "result" / "interior.csv").set_index("parameter")
    assert abs(interior.loc["c_mm", "value"] - C_MM) < 4 * interior.loc["c_mm", "sigma"] + 0.01
    assert "P6" in (out / "report.html").read_text()
    # What was read besides photographs is among the inputs, and options among what the certificate tells.
    inputs = pd.read_csv(out / "result" / "inputs.csv").set_index("file")["sha256"]
    assert inputs["survey.csv"] == hashlib.sha256((flown / "survey.csv").read_bytes()).hexdigest() and len(inputs) == 14
    assert "marks.csv" in (out / "certificate.html").read_text()


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda t: t, (), "does not state the coordinate system of its points"),
        (lambda t: t.rename(columns={"X_m": "Y_m", "Y_m": "X_m"}), ("--control-epsg", CODE), "coordinates exchanged"),
        (lambda t: t, ("--control-epsg", CODE + 1), "if their system is EPSG:32634"),
        (lambda t: t.drop(columns="X_m"), ("--control-epsg", CODE), "row 1"),
    ],
)
def test_control_that_cannot_be_ends_before_anything_is_matched(
    flown, tmp_path, monkeypatch, capsys, change, options, message
):
    change(pd.read_csv(flown / "survey.csv")).to_csv(tmp_path / "survey.csv", index=False)
    given = ("fly", flown / "photographs", "--out", tmp_path / "o", "--control", tmp_path / "survey.csv")
    given += ("--marks", flown / "marks.csv", *options)
    code, _, wrong = run(monkeypatch, capsys, *given)
    assert code == 2 and message in wrong and not (tmp_path / "o").exists(), wrong
