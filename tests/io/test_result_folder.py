"""Results of an adjustment read with their block, and refusals."""

import json
import re
import shutil

import numpy as np
import pandas as pd
import pytest

from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import Project, read_source
from jaxphoto.io import adjusted_block, read_block, write_block
from jaxphoto.io.result_folder import photograph_files
from jaxphoto.report import Tables, Verdict, write_results
from tests.blocks import adjusted
from tests.commands import run
from tests.io.test_colmap import write_text


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A block and its results, side by side as in a flight."""
    folder, found = tmp_path_factory.mktemp("flown"), adjusted("cross")
    write_block(found.block, folder / "block")
    write_results(Tables(found), Verdict(()), folder / "result", {}, {"block": "../block"})
    return folder


@pytest.fixture
def own(folders, tmp_path):
    return shutil.copytree(folders, tmp_path / "own")


def same_unknowns(found, truth):
    np.testing.assert_allclose(found.exterior.position, truth.exterior.position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.exterior.camera_from_object, truth.exterior.camera_from_object, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.points, truth.points, rtol=0, atol=1e-9)
    for name, interior in truth.interior.items():
        for parameter in parameter_names(interior):
            assert get_parameter(found.interior[name], parameter) == get_parameter(interior, parameter)


def test_a_result_is_read_with_the_values_that_were_adjusted(folders):
    block, truth = adjusted_block(folders / "result"), adjusted("cross")
    same_unknowns(block.start.unknowns, truth.unknowns)
    assert block.start.image_known.all() and block.start.point_known.all()
    p = Project.of(truth)
    again = Project.of_block(block, block.start.unknowns)
    assert (again.files, again.image_camera) == (p.files, p.image_camera)
    np.testing.assert_allclose(again.column_row, p.column_row, rtol=0, atol=1e-9)
    for of, rows in (("image", p.rows_of_images), ("point", p.rows_of_points)):
        assert all((getattr(p, of)[own] == k).all() for k, own in enumerate(rows))
        assert sum(map(len, rows)) == len(p.image)


def test_the_block_of_a_result_in_a_flight_is_that_of_its_part(own):
    summary = json.loads((own / "result" / "summary.json").read_text())
    del summary["block"]
    (own / "result" / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match="has no reference to its block; give the block folder by"):
        adjusted_block(own / "result")
    assert adjusted_block(own / "result", own / "block").images == adjusted("cross").block.images
    parts = [{"result": "result", "block": "block"}, {"result": "../result", "block": "block"}]
    (own / "summary.json").write_text(json.dumps({"parts": parts}))
    for folder in (own, own / "result"):
        same_unknowns(adjusted_block(folder).start.unknowns, adjusted("cross").unknowns)
    with pytest.raises(InputError, match="has no folder for part 2"):
        adjusted_block(own, part=2)
    with pytest.raises(InputError, match=r"has 2 part\(s\); unknown part 3"):
        adjusted_block(own, part=3)
    with pytest.raises(InputError, match="only the folder of a flight has a part 2"):
        adjusted_block(own / "result", part=2)


def changed(path, change):
    table = pd.read_csv(path, dtype={"image": str, "point": str})
    change(table).to_csv(path, index=False)


def renamed(folder):
    changed(folder / "result" / "exterior.csv", lambda t: t.assign(image=["new", *t.image[1:]]))


def shortened(folder):
    changed(folder / "result" / "object_points.csv", lambda t: t[1:])


def diverged(folder):
    path = folder / "result" / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"converged": False}))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (renamed, r"exterior\.csv is not of the block .*: image i0; name the block that was adjusted by --block"),
        (shortened, r"object_points\.csv is not of the block .*: point p0"),
        (diverged, "the adjustment did not converge"),
        (lambda f: shutil.rmtree(f / "block"), r"should be .*block, but block\.toml is missing"),
        (lambda f: (f / "result" / "exterior.csv").unlink(), r"exterior\.csv is missing in the results"),
        (lambda f: (f / "result" / "interior.csv").unlink(), r"has no interior\.csv; give a folder that"),
    ],
)  # fmt: skip
def test_results_of_another_block_are_refused(own, spoil, message):
    spoil(own)
    with pytest.raises(InputError, match=message):
        adjusted_block(own / "result")


def test_a_red_verdict_is_said(own):
    path = own / "result" / "summary.json"
    alarm = {"verdict": "red", "findings": [{"severity": "error", "text": "the test of sigma naught fails"}]}
    path.write_text(json.dumps(json.loads(path.read_text()) | alarm))
    with pytest.warns(UserWarning, match="the verdict on this adjustment is red: the test of sigma naught fails"):
        adjusted_block(own / "result")


def test_photographs_are_called_by_their_files(tmp_path):
    for name in ("left/a.JPG", "left/b.tif", "left/c.txt", "right/b.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    images = ("a", "b", "c")
    assert photograph_files(images, [tmp_path / "left"]) == {"a": "a.JPG", "b": "b.tif"}
    with pytest.raises(InputError, match=r"b\.tif and .*b\.jpg both have the image name b; give one"):
        photograph_files(images, [tmp_path / "left", tmp_path / "right"])
    with pytest.raises(InputError, match="folder not found: "):
        photograph_files(images, [tmp_path / "none"])
    (tmp_path / "photographs.csv").write_text("image,file\na,a.png\nc,c.png\n")
    assert photograph_files(images, [tmp_path / "right"], tmp_path) == {"a": "a.png", "b": "b.jpg", "c": "c.png"}
    with pytest.raises(InputError, match="two images have the photograph a"):
        block = read_source(write_text(tmp_path / "model"))
        Project.of_block(block, block.start.unknowns, {"b": "a"})


def test_the_command_writes_adjusted_values(own, tmp_path, monkeypatch, capsys):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "i0.jpg").touch()
    out = tmp_path / "block"
    given = ("--photographs", tmp_path / "pictures", "--to")
    code, said, _ = run(monkeypatch, capsys, "convert", own / "result", tmp_path / "opk", *given, "opk")
    assert code == 0 and "adjusted values\ncamera one: the conversion is exact\n" in said
    # What a format has no place for is not called written.
    assert "image points\n" in said and not re.search(r"images, \d+ points", said)
    lines = (tmp_path / "opk" / "exterior.txt").read_text().splitlines()
    position = np.asarray(adjusted("cross").unknowns.exterior.position)
    assert lines[3].split("\t")[:4] == ["i0.jpg", *map(repr, position[0].tolist())]
    # As start values of a block, but for points that are control: these start where they were surveyed.
    assert run(monkeypatch, capsys, "convert", own / "result", out)[0] == 0
    start = read_block(out).start.unknowns
    np.testing.assert_allclose(start.exterior.position, position, rtol=0, atol=1e-9)
    assert start.interior["one"].c == adjusted("cross").unknowns.interior["one"].c
    code, said, _ = run(monkeypatch, capsys, "convert", own / "block", tmp_path / "start", "--to", "opk")
    assert code == 0 and "initial values of the block" in said
    for arguments, message in (
        ((own / "result", tmp_path / "no", "--to", "opk", "--adjust"), "--adjust applies to a block that is exported"),
        ((own / "block", tmp_path / "no", "--adjust"), "--adjust applies to a block that is exported"),
        ((own / "block", tmp_path / "no", "--to", "opk", "--part", 2), "--block and --part apply to results only"),
        ((own / "result", tmp_path / "no.xml", "--to", "metashape"), "omit .xml"),
    ):
        code, _, wrong = run(monkeypatch, capsys, "convert", *arguments)
        assert code == 2 and message in wrong and not list(tmp_path.glob("no*"))


def test_the_command_adjusts_first(own, tmp_path, monkeypatch, capsys):
    code, said, _ = run(monkeypatch, capsys, "convert", own / "block", tmp_path / "out", "--to", "opk", "--adjust")
    found = adjusted("cross")
    assert code == 0 and f"adjusted values, sigma naught {float(found.sigma0):.3g}" in said
    cells = (tmp_path / "out" / "exterior.txt").read_text().splitlines()[3].split("\t")
    np.testing.assert_allclose(np.array(cells[1:4], float), found.unknowns.exterior.position[0], rtol=0, atol=1e-5)
