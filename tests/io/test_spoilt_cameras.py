"""Camera files and COLMAP models that are cut off or changed: read as they stand, or refused in one sentence."""

import json
import warnings

import numpy as np
import pytest

from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.extras.formats import read_source
from jaxphoto.io.camera_files import read_camera_file
from tests.io import test_cameras as good
from tests.io.test_colmap import write_binary, write_text

CUTS, FLIPS = 20, 40


def spoilt(content: bytes, seed: int):
    """The content cut off at some places, and with single bytes changed, left out and put in."""
    rng = np.random.default_rng(seed)
    for at in np.linspace(0, len(content), CUTS, endpoint=False).astype(int):
        yield content[:at]
    for at in rng.integers(0, len(content), FLIPS):
        kind, other = rng.integers(3), bytes([rng.integers(32, 127)])
        yield content[:at] + (b"" if kind == 1 else other) + content[at + (kind < 2) :]


def sound_or_refused(read, place):
    """Read; whatever is wrong has to be said in a sentence that names the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            camera = read()
        except JaxphotoError as error:
            assert "\n" not in str(error)
            assert any(name in str(error) for name in place), str(error)
            return None
    return camera


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.yml", good.OPENCV),
        ("a.xml", good.AGISOFT),
        ("cameras.txt", good.COLMAP.split("2 PINHOLE")[0]),
        ("a.txt", good.SMAC),
        ("b.txt", good.SMAC_TORN),
        ("a.toml", good.TOML),
    ],
)
def test_a_spoilt_camera_file_is_read_or_refused(tmp_path, name, text):
    refused = 0
    for content in spoilt(text.encode(), len(text)):
        (tmp_path / name).write_bytes(content)
        camera = sound_or_refused(lambda: read_camera_file(tmp_path / name), (name,))
        refused += camera is None
        if camera is not None:
            assert float(camera.interior.c) > 0
    assert refused > CUTS / 2


@pytest.mark.parametrize("name", ["interior.csv", "correlation.csv", "summary.json"])
def test_spoilt_results_are_read_or_refused(tmp_path, name):
    files = {"interior.csv": good.INTERIOR, "correlation.csv": good.CORRELATION}
    told = {"width_px": 4500, "height_px": 3000, "pixel_mm": 0.008, "distortion": "smac", "sign": "add"}
    files["summary.json"] = json.dumps({"cameras": {"nadir": told}})
    for key, text in files.items():
        (tmp_path / key).write_text(text)
    for content in spoilt(files[name].encode(), 3):
        (tmp_path / name).write_bytes(content)
        camera = sound_or_refused(lambda: read_camera_file(tmp_path), tuple(files))
        if camera is not None and camera.covariance is not None:
            assert np.linalg.eigvalsh(camera.covariance).min() > -1e-9


@pytest.mark.parametrize("write", [write_text, write_binary])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_spoilt_colmap_model_is_read_or_refused(tmp_path, write, name):
    folder = write(tmp_path / "model")
    (path,) = folder.glob(f"{name}.*")
    for content in spoilt(path.read_bytes(), 5):
        path.write_bytes(content)
        sound_or_refused(lambda: read_source(folder, "colmap"), ("model", "image", "point", "camera", "nothing"))


def table(rows):
    return "parameter_a,parameter_b,rho\n" + "".join(
        f"interior[nadir].{a},interior[nadir].{b},{r}\n" for a, b, r in rows
    )


PAIRS = [("c_mm", "xp_mm", 0.25), ("c_mm", "k1", 0.75), ("xp_mm", "k1", 0.5)]
IMPOSSIBLE = [("c_mm", "xp_mm", 0.9), ("c_mm", "k1", -0.9), ("xp_mm", "k1", 0.9)]


@pytest.mark.parametrize(
    "rows",
    [
        PAIRS,
        [*PAIRS, *[(b, a, r + 0.1) for a, b, r in PAIRS]],
        [*PAIRS, *[(b, a, r) for a, b, r in PAIRS[:2]], PAIRS[0]],
        [*PAIRS, *[(b, a, "much") for a, b, r in PAIRS]],
        [(*pair, r) for a, b, r in IMPOSSIBLE for pair in ((a, b), (b, a))],
        [(*pair, 1.5) for a, b, _ in PAIRS for pair in ((a, b), (b, a))],
    ],
    ids=["one way", "not alike", "twice", "text", "impossible together", "above 1"],
)  # fmt: skip
def test_correlations_that_are_none_are_refused(tmp_path, rows):
    block = good.written(tmp_path, good.TOML, "b.toml")
    folder = good.results_folder(tmp_path)
    good.written(tmp_path, table(rows), "correlation.csv")
    with pytest.raises(InputError, match=r"interior.csv: correlation.csv beside it is not of the same adjustment"):
        read_camera_file(folder, block=block)
    good.written(tmp_path, "a,b\n1,2\n", "correlation.csv")
    with pytest.raises(InputError, match=r"correlation.csv beside it is no table of parameter_a, parameter_b, rho"):
        read_camera_file(folder, block=block)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("nadir,yp_mm", "nadir,xp_mm", "row 4: xp_mm of camera nadir stands there twice"),
        ("0.002,True", "-0.002,True", "row 2: sigma is -0.002"),
        ("r0_mm,8.0", "r0_mm,-8.0", "r0_mm of camera nadir is -8; give it as a positive length"),
        ("r0_mm,8.0", "r0_mm,nan", "row 14: value is 'nan'; give a finite number"),
        ("35.5", "-35.5", "c_mm of camera nadir is -35.5; a principal distance is positive"),
    ],
)
def test_an_interior_csv_that_contradicts_itself_is_refused(tmp_path, old, new, message):
    block = good.written(tmp_path, good.TOML, "b.toml")
    folder = good.results_folder(tmp_path)
    good.written(tmp_path, good.INTERIOR.replace(old, new, 1), "interior.csv")
    with pytest.raises(InputError, match=message):
        read_camera_file(folder, block=block)
