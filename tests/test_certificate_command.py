"""`jaxphoto certificate`: a document from results, the same bytes from the same inputs, that says what they say."""

import hashlib
import json
import shutil

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from jaxphoto import Tables
from jaxphoto.io import write_block
from jaxphoto.io.conditions import CONDITIONS, conditions_of, read_conditions, write_conditions
from jaxphoto.io.result_tables import block_inputs, read_inputs, write_inputs
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.report import verdict_of
from jaxphoto.report.results import write_results
from jaxphoto.statistics.block_geometry import coverage
from tests.blocks import simulated
from tests.commands import run


@pytest.fixture(scope="module")
def adjusted():
    return adjust_for_tables(simulated("cross").block)


@pytest.fixture(scope="module")
def results(adjusted, tmp_path_factory):
    folder = tmp_path_factory.mktemp("certified")
    write_block(adjusted.block, folder / "block")
    tables = Tables(adjusted)
    told = {"method": {"command": "adjust"}}
    seconds = dict.fromkeys(("read", "compile", "solve", "covariance"), 0.0)
    write_results(tables, verdict_of(tables), folder / "results", seconds, told)
    write_inputs(block_inputs(folder / "block"), folder / "results")
    return folder / "results"


def certified(results, out, monkeypatch, capsys, *options, pictures=False):
    code, _, error = run(monkeypatch, capsys, "certificate", results, "--out", out, *options, pictures=pictures)
    assert code == 0, error
    return out.read_bytes()


def test_the_same_inputs_make_the_same_bytes(results, tmp_path, monkeypatch, capsys):
    one = certified(results, tmp_path / "a.html", monkeypatch, capsys, pictures=True)
    assert certified(results, tmp_path / "b.html", monkeypatch, capsys, pictures=True) == one


def test_a_browser_prints_it_as_pdf(results, tmp_path, monkeypatch, capsys):
    if shutil.which("chromium"):
        assert certified(results, tmp_path / "a.pdf", monkeypatch, capsys).startswith(b"%PDF")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    code, _, error = run(monkeypatch, capsys, "certificate", results, "--out", tmp_path / "b.pdf")
    assert code == 2 and "no Chromium, Chrome or Edge" in error and not (tmp_path / "b.pdf").exists()


def test_it_says_what_the_results_say(results, tmp_path, monkeypatch, capsys):
    page = certified(results, tmp_path / "a.html", monkeypatch, capsys).decode()
    interior = pd.read_csv(results / "interior.csv").set_index("parameter")
    # Two digits of sigma, and the value to the same place.
    places = 1 - int(np.floor(np.log10(interior.loc["c_mm", "sigma"])))
    assert f"{interior.loc['c_mm', 'value']:.{places}f}" in page
    for file in (results.parent / "block").glob("*.csv"):
        assert hashlib.sha256(file.read_bytes()).hexdigest() in page
    for heading in ("Interior orientation", "Distortion", "Precision", "Correlations", "Inputs"):
        assert heading in page


def test_the_readout_of_a_rolling_shutter_is_in_the_interior_orientation(results, tmp_path, monkeypatch, capsys):
    own = tmp_path / "own"
    shutil.copytree(results, own)
    summary = json.loads((own / "summary.json").read_text())
    (camera,) = set(pd.read_csv(own / "interior.csv").camera)
    told = {"georeferencing": {f"shutters[{camera}].readout_ms": {"value": -30.21, "sigma": 0.52}}}
    (own / "summary.json").write_text(json.dumps(summary | told))
    page = certified(own, tmp_path / "a.html", monkeypatch, capsys).decode()
    assert page.index("readout_ms") < page.index("<h2>Distortion" if "<h2>Distortion" in page else "Distortion</h2>")
    assert "-30.21" in page


def test_check_points_that_are_shifted_are_told_at_the_head(results, tmp_path, monkeypatch, capsys):
    own = tmp_path / "own"
    shutil.copytree(results, own)
    summary = json.loads((own / "summary.json").read_text()) | {"verdict": "green", "findings": []}
    for mean, head in ((0.001, "all tests of the adjustment are passed"), (0.03, "check points are shifted in Z")):
        told = {"check_points": {"Z": {"n": 30, "mean_m": mean, "rmse_m": 0.04, "max_abs_m": 0.1}}}
        (own / "summary.json").write_text(json.dumps(summary | told))
        assert head in certified(own, tmp_path / "a.html", monkeypatch, capsys).decode()


def test_inputs_are_told_by_their_hashes(results):
    told = {f.file: f.sha256 for f in read_inputs(results / "inputs.csv")}
    block = results.parent / "block"
    assert told == {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in block.iterdir() if p.suffix != ".json"}


def test_nothing_is_claimed_of_inputs_without_hashes(results, tmp_path, monkeypatch, capsys):
    again = "The same inputs, options and software give the numbers"
    assert again in certified(results, tmp_path / "a.html", monkeypatch, capsys).decode()
    untold = tmp_path / "untold"
    shutil.copytree(results, untold)
    (untold / "inputs.csv").unlink()
    page = certified(untold, tmp_path / "b.html", monkeypatch, capsys).decode()
    assert again not in page and "Incomplete: the results have no hashes" in page and "inputs unknown" in page
    (tmp_path / "photographs").mkdir()
    Image.new("RGB", (32, 24)).save(tmp_path / "photographs" / "a.jpg")
    given = ("--photographs", tmp_path / "photographs")
    assert again not in certified(untold, tmp_path / "c.html", monkeypatch, capsys, *given).decode()


def test_bad_input_is_one_sentence(results, tmp_path, monkeypatch, capsys):
    code, _, error = run(monkeypatch, capsys, "certificate", results, "--out", tmp_path / "a.doc")
    assert code == 2 and "give a file that ends in .html or .pdf" in error
    code, _, error = run(monkeypatch, capsys, "certificate", tmp_path, "--out", tmp_path / "a.pdf")
    assert code == 2 and "interior.csv not found" in error
    open_end = tmp_path / "open"
    open_end.mkdir()
    for file in results.glob("*.*"):
        (open_end / file.name).write_bytes(file.read_bytes())
    summary = json.loads((open_end / "summary.json").read_text())
    (open_end / "summary.json").write_text(json.dumps(summary | {"converged": False, "outcome": "no"}))
    code, _, error = run(monkeypatch, capsys, "certificate", open_end, "--out", tmp_path / "a.pdf")
    assert code == 2 and error.count("\n") == 1
    assert not (tmp_path / "a.pdf").exists()


def test_conditions_come_from_exif_and_back_from_their_table(tmp_path):
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Maker", "Model 1"
    exif.get_ifd(0x8769).update(
        {0x9003: "2024:05:01 10:00:03", 0x9291: "25", 0x9011: "+02:00", 0xA431: "S-7", 0x829D: 4.0, 0x829A: 0.001}
    )
    packet = b'<rdf:Description drone-dji:CameraSerialNumber="C-9" drone-dji:DroneSerialNumber="D-3"/>'
    Image.new("RGB", (32, 24)).save(tmp_path / "a.jpg", exif=exif, xmp=packet)
    told = conditions_of(tmp_path / "a.jpg")
    assert (told.make, told.model, told.serial, told.f_number) == ("Maker", "Model 1", "S-7", 4.0)
    assert told.drone == "D-3"
    assert told.time == "2024-05-01 10:00:03.25+02:00" and told.exposure_s == pytest.approx(0.001)
    assert told.sha256 == hashlib.sha256((tmp_path / "a.jpg").read_bytes()).hexdigest()
    write_conditions([told], tmp_path, ["a"])
    assert read_conditions(tmp_path / CONDITIONS) == [told]


def test_what_photographs_see_is_what_points_in_them_say(adjusted):
    """Where image points are, their photographs see the ground; height and pixel are those of the rays."""
    found = coverage(adjusted)
    block, s = adjusted.block, adjusted.structure
    points = np.asarray(adjusted.unknowns.points)
    rays = np.bincount(s.point, minlength=len(points))
    column = np.abs(found.x - points[:, :1]).argmin(axis=1)
    row = np.abs(found.y - points[:, 1:2]).argmin(axis=1)
    # At least as many photographs as measured it, but for those in whose edge half a cell decides.
    assert np.mean(found.seen_by[row, column] >= rays) > 0.9
    position = np.asarray(adjusted.unknowns.exterior.position)
    own = points[s.point[s.image == 0]]
    assert found.height_m[0] == pytest.approx(position[0, 2] - np.median(own[:, 2]))
    camera = block.image_camera[0]
    pixel = block.sensors[camera].pixel_mm / float(adjusted.unknowns.interior[camera].c)
    assert found.gsd_m[0] == pytest.approx(pixel * found.height_m[0], rel=0.05)
    assert 0 < found.area_m2(2) < found.area_m2(1)
