"""docs/formats.md names every registered reader and writer, and each sample is recognised by one reader only."""

import re
from pathlib import Path

import pytest

from jaxphoto.extras.formats import CAMERAS_WRITTEN, CONTROL_FORMATS, EXPORTS, FORMATS, export, read_source, recognise
from jaxphoto.io import exposures
from jaxphoto.io.camera_files import CAMERA_READERS
from jaxphoto.io.text_files import decoded
from jaxphoto.io.trajectory import is_sbet
from tests import sound_files
from tests.io import (
    control_files,
    oriented_files,
    test_bal,
    test_camera_formats,
    test_cameras,
    test_colmap,
    test_reconstructions,
)
from tests.io.conftest import FILES

PAGE = Path(__file__).resolve().parents[2] / "docs/formats.md"
COLUMNS = ["format", "read", "written", "lost when read", "source", "own files"]


def rows():
    """The cells of every row of the tables of formats, by the names of the columns."""
    found = []
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and len(cells) == len(COLUMNS) and set(line) - set("|- "):
            found.append(dict(zip(COLUMNS, cells, strict=True)))
    return [row for row in found if row["format"] != "format"]


def named(column):
    """(what reads or writes it, name there) of all rows: "convert `colmap`, `colmap-binary`; camera `colmap`"."""
    parts = [part.split(maxsplit=1) for row in rows() for part in row[column].split(";") if part.strip()]
    return [(command, name) for command, names in parts for name in re.findall("`([^`]+)`", names)]


SBET = [("trajectory", end) for end in (".sbet", ".out") if is_sbet(Path(f"a{end}"))]
CLOUDS = [("cloud", suffix) for suffix in (".las", ".laz", ".csv")]
DECLARED = {
    "read": [
        *(("convert", name) for name in FORMATS),
        *(("camera", name) for name in CAMERA_READERS),
        *(("control", name) for name in (*CONTROL_FORMATS, "tables")),
        *(("exposures", name) for name in (*exposures.SUFFIXES, *exposures.NAMES)),
        *SBET,
        ("trajectory", ".csv"),
        *CLOUDS,
        ("cloud", ".copc.laz"),
    ],
    "written": [
        ("convert", "block"),
        *(("convert", name) for name in EXPORTS),
        *(("camera", name) for name in CAMERAS_WRITTEN),
        *SBET,
        ("trajectory", ".csv"),
        *CLOUDS,
    ],
}


@pytest.mark.parametrize("column", DECLARED)
def test_the_page_names_what_the_code_declares_and_nothing_else(column):
    found = named(column)
    missing = [" ".join(pair) for pair in DECLARED[column] if pair not in found]
    assert not missing, f"docs/formats.md, column {column}: add {', '.join(missing)}"
    surplus = [" ".join(pair) for pair in found if pair not in DECLARED[column]]
    assert not surplus, f"docs/formats.md, column {column}: there is no {', '.join(surplus)}"


def test_every_format_of_another_program_has_losses_and_a_source():
    for row in rows():
        assert row["lost when read"] and row["source"], row["format"]
        if row["source"] != "here":
            assert "](http" in row["source"] and row["own files"], row["format"]


def _texts(files):
    def write(folder):
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")

    return write


def _exported(format):
    def write(folder):
        p = oriented_files.inside("opencv", "local")
        export(p._replace(files=tuple(name.replace(" ", "_") for name in p.files)), folder / "out", format)

    return write


PROJECTS = {
    "block": [_texts(FILES)],
    "dbat": [_texts(sound_files.DBAT)],
    "photomodeler": [_texts(sound_files.PHOTOMODELER)],
    "bal": [_texts({"problem.txt": "\n".join(test_bal.lines_of())}), _exported("bal")],
    "colmap": [test_colmap.write_text, test_colmap.write_binary, _exported("colmap")],
    "opensfm": [test_reconstructions.write_open_sfm, _exported("opensfm")],
    "blocksexchange": [test_reconstructions.write_blocks_exchange, _exported("blocksexchange")],
    "bundler": [test_reconstructions.write_bundler],
    "pix4d": [test_reconstructions.write_pix4d],
    "metashape": [oriented_files.write_metashape, _exported("metashape")],
    "texts": [oriented_files.write_angles, oriented_files.write_patb, oriented_files.write_bingo, _exported("opk")],
}
CAMERAS = {
    "interior": ("interior.csv", test_cameras.INTERIOR), "block": ("a.toml", test_cameras.TOML),
    "agisoft": ("a.xml", test_cameras.AGISOFT), "smac": ("a.txt", test_cameras.SMAC),
    "colmap": ("cameras.txt", test_cameras.COLMAP), "opencv": ("a.yml", test_cameras.OPENCV),
    "mrcal": ("a", test_camera_formats.mrcal("OPENCV8", test_camera_formats.RATIONAL)),
}  # fmt: skip
CONTROL = {"gcp_list": control_files.GCP_LIST, "metashape": control_files.MARKERS}
TABLES = (control_files.REFERENCE, control_files.PIX4D, control_files.PIX4D_MARKS, control_files.OWN)


OTHERS = {
    "image_points.txt": oriented_files.text_of_points(oriented_files.inside("opencv", "local"), oriented_files.BINGO),
    "trajectory.csv": "time_s,X_m,Y_m,Z_m,roll_deg,pitch_deg,yaw_deg\n1,2,3,4,5,6,7\n2,2,3,4,5,6,7\n",
    "cloud.csv": "X_m,Y_m,Z_m\n1,2,3\n2,3,4\n",
    "points.txt": "x y z\n1 2 3\n2 3 4\n",
    "note.txt": "flown in May\nwith two batteries\n",
}
"""Text files that none of these readers reads."""


def _folder(source):
    """The folder in which a writer put the project."""
    return source / "out" if (source / "out").is_dir() else source


def _claims(path):
    """The project, camera and control formats that claim a file."""
    text = decoded(path.read_bytes())
    return [
        recognise(path),
        [name for name, reader in CAMERA_READERS.items() if reader.recognise(path, text)],
        [name for name, format in CONTROL_FORMATS.items() if format.recognise(path, text)],
    ]


# Programs that write several kinds of content into one file, by the names of their formats.
SAME_PROGRAM = [{"metashape", "agisoft"}]


@pytest.mark.parametrize("name", FORMATS)
def test_every_project_is_recognised_by_its_format_alone(tmp_path, name):
    """As a folder and by its main file; a camera or control format may claim that file only for its own content."""
    for k, write in enumerate(PROJECTS[name]):
        (tmp_path / str(k)).mkdir()
        write(tmp_path / str(k))
        folder = _folder(tmp_path / str(k))
        assert recognise(folder) == [name]
        (main,) = FORMATS[name].find(folder)
        projects, cameras, control = _claims(main)
        assert projects == [name]
        for others in (cameras, control):
            assert all(other == name or {name, other} in SAME_PROGRAM for other in others), (main, others)


@pytest.mark.parametrize("name", CAMERA_READERS)
def test_every_camera_is_recognised_by_its_format_alone(tmp_path, name):
    file, text = CAMERAS[name]
    (tmp_path / file).write_text(text, encoding="utf-8")
    assert _claims(tmp_path / file) == [[], [name], []]
    assert recognise(tmp_path) == []


@pytest.mark.parametrize("name", CONTROL_FORMATS)
def test_every_control_file_is_recognised_by_its_format_alone(tmp_path, name):
    path = tmp_path / "a.txt"
    path.write_text(CONTROL[name], encoding="utf-8")
    projects, cameras, control = _claims(path)
    assert (cameras, control) == ([], [name]) and projects in ([], [name])


@pytest.mark.parametrize("text", [*TABLES, *OTHERS])
def test_other_texts_are_recognised_by_none(tmp_path, text):
    path = tmp_path / (text if text in OTHERS else "a.txt")
    path.write_text(OTHERS.get(text, text), encoding="utf-8")
    assert _claims(path) == [[], [], []]


@pytest.mark.filterwarnings("ignore:.*fewer than")
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-16"])
@pytest.mark.parametrize("name", [*sorted(FORMATS.keys() & EXPORTS.keys() - {"bal"}), "opk"])
def test_names_that_are_not_ascii_are_read_in_every_encoding(tmp_path, name, encoding):
    p = oriented_files.inside("opencv", "local")
    named = [[f"Flüge/{name.replace(' ', '_')}" for name in names] for names in (p.files, p.images)]
    p = p._replace(files=tuple(named[0]), images=named[1])
    export(p, tmp_path / "out", name)
    for path in (tmp_path / "out").iterdir():
        path.write_text(path.read_text(encoding="utf-8"), encoding=encoding)
    images = read_source(tmp_path / "out").images
    assert len(images) == 4 and all("ü" in image for image in images), images
