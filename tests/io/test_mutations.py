"""Files with random mistakes: read, or refused by an error without traceback."""

import re
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest

from jaxphoto.errors import JaxphotoError
from jaxphoto.extras.formats import read_control, read_source
from jaxphoto.io import read_block, read_recipe
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.io.exposures import read_exposures
from tests import sound_files
from tests.io import control_files, oriented_files, test_bal, test_cameras, test_colmap, test_reconstructions
from tests.io.conftest import FILES
from tests.io.test_camera_formats import KALIBR

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def written(**files):
    """A writer of text files; `__` in a name stands for a point."""

    def write(folder):
        for name, text in files.items():
            (folder / name.replace("__", ".")).write_text(text, encoding="utf-8")

    return write


def source(format):
    return lambda folder: read_source(folder, format)


def camera(name, **options):
    return lambda folder: read_camera_file(folder / name, **options)


READERS = {
    "block": (written(**FILES), read_block),
    "recipe": (written(a__toml=(EXAMPLES / "recipe.toml").read_text()), lambda folder: read_recipe(folder / "a.toml")),
    "camera opencv": (written(a__yml=test_cameras.OPENCV), camera("a.yml")),
    "camera agisoft": (written(a__xml=test_cameras.AGISOFT), camera("a.xml")),
    "camera colmap": (written(cameras__txt=test_cameras.COLMAP), camera("cameras.txt", camera="5")),
    "camera smac": (written(a__txt=test_cameras.SMAC), camera("a.txt")),
    "camera kalibr": (written(a__yaml=KALIBR), camera("a.yaml", camera="cam1")),
    "camera results": (
        written(interior__csv=test_cameras.INTERIOR, correlation__csv=test_cameras.CORRELATION), camera("")
    ),
    "aicon": (written(**sound_files.AICON), source("aicon")),
    "bal": (written(problem__txt="\n".join(test_bal.lines_of())), source("bal")),
    "dbat": (written(**sound_files.DBAT), source("dbat")),
    "photomodeler": (written(**sound_files.PHOTOMODELER), source("photomodeler")),
    "colmap": (test_colmap.write_text, source("colmap")),
    "opensfm": (test_reconstructions.write_open_sfm, source("opensfm")),
    "openmvg": (test_reconstructions.write_open_mvg, source("openmvg")),
    "blocksexchange": (test_reconstructions.write_blocks_exchange, source("blocksexchange")),
    "bundler": (test_reconstructions.write_bundler, source("bundler")),
    "pix4d": (test_reconstructions.write_pix4d, source("pix4d")),
    "metashape": (oriented_files.write_metashape, source("metashape")),
    "texts": (oriented_files.write_bingo, source("texts")),
    "nerfstudio": (oriented_files.write_nerfstudio, source("nerfstudio")),
    "orthority": (oriented_files.write_orthority, source("orthority")),
    "control gcp_list": (written(a=control_files.GCP_LIST), lambda folder: read_control(folder / "a")),
    "control markers": (written(a=control_files.MARKERS), lambda folder: read_control(folder / "a")),
    "control table": (written(a=control_files.OWN), lambda folder: read_control(folder / "a")),
    "exposures marks": (written(a__MRK=sound_files.MARKS), lambda folder: read_exposures(folder / "a.MRK")),
    "exposures pos": (written(a__pos=sound_files.POS), lambda folder: read_exposures(folder / "a.pos")),
    "exposures table": (written(a__csv=sound_files.EXPOSURES), lambda folder: read_exposures(folder / "a.csv", 32633)),
}  # fmt: skip


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


@pytest.mark.parametrize("reader", READERS)
def test_mistakes_are_read_or_refused(tmp_path, reader):
    write, read = READERS[reader]
    write(tmp_path)
    paths = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    texts = [path.read_text(encoding="utf-8") for path in paths]
    rng = np.random.default_rng(zlib.crc32(reader.encode()))
    for _ in range(8):
        k = int(rng.integers(len(paths)))
        paths[k].write_text(mistaken(texts[k], rng), encoding="utf-8")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                read(tmp_path)
            except JaxphotoError as error:
                assert str(error).isprintable()
        paths[k].write_text(texts[k], encoding="utf-8")
