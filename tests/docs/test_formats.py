"""docs/formats.md names every reader and writer that the code declares; a new format fails here until it has a row."""

import importlib
import pkgutil
import re
from pathlib import Path

import pytest
from jaxphoto.io.cameras import camera_reader

from jaxphoto.extras.formats import CAMERA_FORMATS, EXPORTS, FORMATS
from jaxphoto.io import control_files
from jaxphoto.io.clouds import cloud_reader, copc
from jaxphoto.io.trajectory import is_sbet

PAGE = Path(__file__).resolve().parents[2] / "docs/formats.md"
COLUMNS = ["format", "read", "written", "signs and units", "lost", "source", "its own files"]


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


def control_forms():
    """The modules of control files that tell a form by its content, and the one of tables, which takes the rest."""
    modules = [name for _, name, _ in pkgutil.iter_modules(control_files.__path__)]
    told = [n for n in modules if hasattr(importlib.import_module(f"{control_files.__name__}.{n}"), "recognises")]
    return [*told, "tables"]


EXPOSURES = importlib.import_module("jaxphoto.io.exposures.located")
SBET = [("trajectory", end) for end in (".sbet", ".out") if is_sbet(Path(f"a{end}"))]
CLOUDS = [("cloud", end) for end in (*cloud_reader._OPENERS, copc._ENDING)]
DECLARED = {
    "read": [
        *(("convert", name) for name in FORMATS),
        *(("camera", name) for name in camera_reader._FORMATS),
        *(("control", name) for name in control_forms()),
        *(("exposures", name) for name in (*EXPOSURES._SUFFIXES, *EXPOSURES._TABLES)),
        *SBET,
        ("trajectory", ".csv"),
        *CLOUDS,
        ("raster", "dsm"),
    ],
    "written": [
        ("convert", "block"),
        *(("convert", name) for name in EXPORTS),
        *(("camera", name) for name in CAMERA_FORMATS),
        *SBET,
        ("trajectory", ".csv"),
        *CLOUDS,
        ("raster", "dsm"),
        ("raster", "orthophoto"),
    ],
}


@pytest.mark.parametrize("column", DECLARED)
def test_the_page_names_what_the_code_declares_and_nothing_else(column):
    found = named(column)
    missing = [" ".join(pair) for pair in DECLARED[column] if pair not in found]
    assert not missing, f"docs/formats.md, column {column}: add {', '.join(missing)}"
    surplus = [" ".join(pair) for pair in found if pair not in DECLARED[column]]
    assert not surplus, f"docs/formats.md, column {column}: there is no {', '.join(surplus)}"


def test_every_format_of_another_program_says_signs_losses_and_a_source():
    for row in rows():
        assert row["signs and units"].startswith("["), row["format"]
        assert row["lost"] and row["source"], row["format"]
        assert "](http" in row["source"] or row["source"] in ("here", "there") or ".md#" in row["source"], row["format"]
        if row["source"] not in ("here", "there"):
            assert row["its own files"], row["format"]
