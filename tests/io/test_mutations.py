"""Files with random mistakes: read, or refused by an error without traceback."""

import re
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest

from jaxphoto.errors import JaxphotoError
from jaxphoto.extras.formats import read_control, read_source
from jaxphoto.io import read_recipe
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.io.exposures import read_exposures
from tests import sound_files
from tests.docs.test_formats import CAMERAS, CONTROL, PROJECTS, TABLES

RECIPE = Path(__file__).resolve().parents[2] / "examples" / "recipe.toml"
EXPOSURES = {"a.MRK": sound_files.MARKS, "a.pos": sound_files.POS, "a.csv": sound_files.EXPOSURES}
CHOSEN = {"colmap": "5"}


def project(format, write):
    return write, lambda folder: read_source(folder / "out" if (folder / "out").is_dir() else folder, format)


def camera(kind, name, content):
    return text(name, content, lambda path: read_camera_file(path, camera=CHOSEN.get(kind)))


def text(name, content, read):
    return lambda folder: (folder / name).write_text(content, encoding="utf-8"), lambda folder: read(folder / name)


READERS = {
    "recipe": text("a.toml", RECIPE.read_text(), read_recipe),
    **{f"{format} {k}": project(format, w) for format, writers in PROJECTS.items() for k, w in enumerate(writers)},
    **{f"camera {kind}": camera(kind, name, content) for kind, (name, content) in CAMERAS.items()},
    **{f"control {kind}": text("a", content, read_control) for kind, content in CONTROL.items()},
    **{f"table {k}": text("a", content, read_control) for k, content in enumerate(TABLES)},
    **{name: text(name, content, lambda path: read_exposures(path, 32633)) for name, content in EXPOSURES.items()},
}


def mistaken(text, rng):
    """The text with a number or a word replaced, a piece deleted, a line moved, or its end cut off."""
    at, lines = int(rng.integers(len(text) + 1)), text.split("\n")
    kind = rng.integers(5)
    if kind < 2:
        pattern = (r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?", r"[^\s,;=\[\]{}<>\"']+")[kind]
        match = next(re.compile(pattern).finditer(text, at), None)
        words = [["nan", "-1", "0", "1e30", "1,5", "", "x", "1.2.3"], ["", '"', "default", "[", "1.5", *lines[:3]]]
        return text if match is None else text[: match.start()] + str(rng.choice(words[kind])) + text[match.end() :]
    if kind == 2:
        return text[:at] + text[at + int(rng.integers(1, 100)) :]
    if kind == 3:
        line = lines.pop(int(rng.integers(len(lines))))
        lines[(k := int(rng.integers(len(lines) + 1))) : k] = [line] * int(rng.integers(3))
        return "\n".join(lines)
    return text[:at]


@pytest.mark.parametrize("count", [8, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("reader", READERS)
def test_mistakes_are_read_or_refused(tmp_path, reader, count):
    write, read = READERS[reader]
    write(tmp_path)
    paths = sorted(path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".bin")
    if not paths:
        pytest.skip("binary")
    texts = [path.read_text(encoding="utf-8") for path in paths]
    rng = np.random.default_rng(zlib.crc32(reader.encode()))
    for _ in range(count):
        k = int(rng.integers(len(paths)))
        paths[k].write_text(mistaken(texts[k], rng), encoding="utf-8")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                read(tmp_path)
            except JaxphotoError as error:
                assert str(error).isprintable()
        paths[k].write_text(texts[k], encoding="utf-8")
