"""Cameras in models of fewer terms than they have: fitted over the format, and what that loses is told."""

import cv2
import numpy as np
import pytest

from jaxphoto.camera import Brown, InteriorOrientation, OpenCv, Sensor, get_parameter
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import CAMERA_FORMATS, CAMERA_MODELS, write_camera_file
from jaxphoto.io.camera_files import read_camera_file
from tests.commands import run

SENSOR = Sensor(1280, 960, 0.01)
RATIONAL = InteriorOrientation(
    11.0, 0.02, -0.03, OpenCv(k1=-0.1, k2=0.03, k3=-0.01, k4=0.2, k5=0.02, p1=1e-3, p2=-2e-3)
)
NAMES = {"opencv": "a.yml", "colmap": "cameras.txt", "mrcal": "a.cameramodel", "ros": "ros.yaml"}
EVERY = [(kind, name) for kind, known in CAMERA_FORMATS.items() for name in known.models]


def of_opencv(path):
    """Camera matrix and coefficients, as OpenCV itself reads them."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    return [storage.getNode(k).mat() for k in ("camera_matrix", "distortion_coefficients")]


def test_opencv_with_five_coefficients_misses_by_what_the_file_says(tmp_path):
    full, five = tmp_path / "full.yml", tmp_path / "five.yml"
    assert write_camera_file(full, SENSOR, RATIONAL).max_px == 0
    done = write_camera_file(five, SENSOR, RATIONAL, model="OPENCV5")
    # Points of the whole format, not those of the fit: to rays by the one file, and back by the other, by OpenCV.
    wanted = np.stack(np.meshgrid(np.linspace(0, 1280, 80), np.linspace(0, 960, 60)), axis=-1).reshape(-1, 2)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    rays = cv2.undistortPoints(wanted[:, None] - 0.5, *of_opencv(full), criteria=until)[:, 0]
    given = np.column_stack([rays, np.ones(len(rays))]), np.zeros(3), np.zeros(3)
    here, there = (cv2.projectPoints(*given, *of_opencv(path))[0][:, 0] + 0.5 for path in (full, five))
    np.testing.assert_allclose(here, wanted, atol=1e-6)
    assert [len(of_opencv(path)[1]) for path in (full, five)] == [8, 5]
    apart = np.linalg.norm(there - wanted, axis=1)
    assert 1e-3 < done.rms_px < done.max_px < 1
    np.testing.assert_allclose(done.rms_px, np.sqrt(np.mean(apart**2)), rtol=0.15)
    np.testing.assert_allclose(done.max_px, apart.max(), rtol=0.02)
    # Near the worst point it is as bad.
    near = np.linalg.norm(wanted - np.array(done.worst_px), axis=1) < 20
    assert apart[near].max() > 0.9 * done.max_px
    assert f"# {done.lost}\n" in five.read_text()
    assert "fitted" not in full.read_text()


@pytest.mark.parametrize(("kind", "model"), EVERY)
def test_a_model_has_no_more_terms_than_are_its_own(tmp_path, kind, model):
    path = tmp_path / NAMES[kind]
    done = write_camera_file(path, SENSOR, RATIONAL, kind, model=model, loss_px=1e3)
    part = CAMERA_FORMATS[kind].models[model]
    back = read_camera_file(path, pixel_mm=SENSOR.pixel_mm).interior
    assert type(back.distortion) is part.distortion and type(back.projection) is type(part.projection)
    assert all(float(get_parameter(back, name)) == 0 for name in part.lacks)
    assert float(back.c) == pytest.approx(float(done.interior.c), rel=1e-13)


def test_more_terms_lose_less(tmp_path):
    nested = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
    path = tmp_path / "cameras.txt"
    lost = [write_camera_file(path, SENSOR, RATIONAL, model=name, loss_px=1e3).rms_px for name in nested]
    assert lost == sorted(lost, reverse=True) and lost[0] > 10 and lost[-1] == 0


def test_a_loss_that_nobody_wants_is_refused_until_it_is_allowed(tmp_path):
    path = tmp_path / "cameras.txt"
    with pytest.raises(InputError, match=r"not be this camera any more \(fitted .*at column .*--loss-px \d+\)") as e:
        write_camera_file(path, SENSOR, RATIONAL, model="SIMPLE_PINHOLE")
    assert not path.exists()
    allowed = float(str(e.value).rsplit(maxsplit=1)[-1].rstrip(")"))
    assert allowed - 1 <= write_camera_file(path, SENSOR, RATIONAL, model="SIMPLE_PINHOLE", loss_px=allowed).max_px


def test_a_model_of_another_format_is_refused(tmp_path):
    with pytest.raises(InputError, match="RADIAL is no model of the format opencv; it has OPENCV4, OPENCV5, OPENCV8"):
        write_camera_file(tmp_path / "a.yml", SENSOR, RATIONAL, model="RADIAL")
    with pytest.raises(InputError, match="OPENCV5 is no model of the format agisoft; leave the model out"):
        write_camera_file(tmp_path / "a.xml", SENSOR, RATIONAL, model="OPENCV5")
    assert {name for _, name in EVERY} == set(CAMERA_MODELS)


def test_the_command_says_what_is_lost_and_where(tmp_path, monkeypatch, capsys):
    brown = InteriorOrientation(9.0, 0.02, -0.03, Brown(k1=-9e-4, k2=1e-6))
    write_camera_file(tmp_path / "block.toml", SENSOR, brown)
    files = tmp_path / "block.toml", tmp_path / "a.yaml"
    code, out, _ = run(monkeypatch, capsys, "camera", *files, "--format", "ros", "--model", "plumb_bob")
    said = [line for line in out.splitlines() if "at column" in line]
    assert code == 0
    assert len(said) == 1
    text = (tmp_path / "a.yaml").read_text()
    assert said[0] in text and "distortion_model: plumb_bob" in text
