"""What is written is there whole or not at all, and nothing of the user's is lost."""

import contextlib
import errno
import os
import resource
from pathlib import Path

import numpy as np
import pytest

from jaxphoto.camera import Brown, InteriorOrientation, Sensor
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import write_camera_file
from jaxphoto.io.clouds import write_cloud
from jaxphoto.writing import MARKER, check_file, check_folder, whole_file, whole_folder
from tests.commands import run

ROOT = Path(__file__).resolve().parents[1]


def write(folder, **files):
    with whole_folder(folder) as work:
        for name, text in files.items():
            (work / name).write_text(text)


def said(folder):
    return {path.name: path.read_text() for path in folder.iterdir() if path.name != MARKER}


@contextlib.contextmanager
def full_disk():
    """No file can have more than some bytes: what a write meets on a full disk, said by another number."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def camera(path):
    write_camera_file(path, Sensor(100, 80, 0.01), InteriorOrientation(5.0, 0.0, 0.0, Brown()))


def cloud(path):
    write_cloud(Cloud(np.random.default_rng(1).normal(size=(5000, 3))), path)


WRITERS = {
    "camera.yml": camera, "camera.json": camera, "camera.xml": camera,
    "cloud.las": cloud, "cloud.laz": cloud, "cloud.csv": cloud,
}  # fmt: skip


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_an_error_and_the_former_file_stays(name, tmp_path):
    path = tmp_path / name
    WRITERS[name](path)
    before = path.read_bytes()
    assert len(before) > 100
    with full_disk(), pytest.raises(OSError) as error:
        WRITERS[name](path)
    assert str(error.value.filename) == str(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_what_is_written_before_goes_and_what_is_the_users_stays(tmp_path):
    out = tmp_path / "out"
    write(out, a="1", b="1")
    (out / "notes").mkdir()
    (out / "notes" / "today.txt").write_text("mine")
    (out / "link").symlink_to("nowhere")
    write(out, a="2")
    assert (out / "a").read_text() == "2"
    assert not (out / "b").exists()
    assert (out / "notes" / "today.txt").read_text() == "mine"
    assert os.readlink(out / "link") == "nowhere"
    with pytest.raises(InputError, match="link was not written by jaxphoto"):
        write(out, link="3")
    assert (out / "a").read_text() == "2"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_folder_written_within_another_is_replaced_again(tmp_path):
    out = tmp_path / "out"
    for text in "12":
        with whole_folder(out) as work:
            write(work, a=text)
    assert said(out) == {"a": "2"}


@pytest.mark.parametrize("marker", [None, "{", "[]", '{"files": 1}', '{"files": {}}'])
def test_a_folder_that_jaxphoto_did_not_write_is_refused(tmp_path, marker):
    (tmp_path / "thesis").write_text("years")
    if marker is not None:
        (tmp_path / MARKER).write_text(marker)
    with contextlib.suppress(InputError):
        write(tmp_path, a="1")
    assert (tmp_path / "thesis").read_text() == "years"
    if marker != '{"files": {}}':
        with pytest.raises(InputError, match="was not written by jaxphoto"):
            check_folder(tmp_path)


def test_a_file_that_was_changed_since_is_not_lost(tmp_path):
    out = tmp_path / "out"
    write(out, a="1")
    (out / "a").write_text("mine")
    with pytest.raises(InputError, match="a was changed since jaxphoto wrote it"):
        write(out, a="2")
    assert said(out) == {"a": "mine"}


def test_what_cannot_be_written_is_said_before_anything_is_computed(tmp_path, monkeypatch, capsys):
    def fails(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("jaxphoto.writing.tempfile.mkdtemp", fails)
    for check in (check_folder, check_file):
        with pytest.raises(InputError, match=r"deeper cannot be written \(Read-only file system\)"):
            check(tmp_path / "deep" / "deeper")
    monkeypatch.setattr("jaxphoto.io.read_block", None)
    block = ROOT / "examples" / "cross_block"
    code, _, error = run(monkeypatch, capsys, "adjust", block, "--out", tmp_path / "x[b]")
    assert (code, error.count("\n")) == (2, 1)
    assert "x[b] cannot be written" in error
    monkeypatch.undo()
    with pytest.raises(InputError, match="cannot be written"):
        check_folder(tmp_path / ("long" * 100))
    assert not list(tmp_path.iterdir())


def test_what_can_be_no_folder_is_said_before_that_its_place_cannot_be_written(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise OSError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("jaxphoto.writing.tempfile.mkdtemp", fails)
    (tmp_path / "file").write_text("1")
    with pytest.raises(InputError, match="file is a file: give a folder"):
        check_folder(tmp_path / "file")
    with pytest.raises(InputError, match="cannot be written"):
        check_folder(tmp_path / "folder")


def test_links_stay_and_what_they_lead_to_is_written(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "out").symlink_to("real")
    (tmp_path / "file").symlink_to("real.txt")
    write(tmp_path / "out", a="1")
    with whole_file(tmp_path / "file") as work:
        work.write_text("2")
    assert (tmp_path / "out").is_symlink() and (tmp_path / "file").is_symlink()
    assert said(tmp_path / "real") == {"a": "1"}
    assert (tmp_path / "real.txt").read_text() == "2"


def test_only_files_are_replaced_by_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (Path("/dev/null"), tmp_path, tmp_path / "pipe"):
        with pytest.raises(InputError, match=r"not a regular file|cannot be written"), whole_file(path) as work:
            work.write_text("")
        with pytest.raises(InputError, match="exists already"):
            check_file(path)
