"""Cameras of mrcal, ROS and COLMAP, of fisheyes, and in models of fewer terms: projection, conversion, loss."""

import struct

import cv2
import equinox as eqx
import numpy as np
import pytest

import jaxphoto
from jaxphoto.camera import (
    Brown,
    Equidistant,
    Equisolid,
    InteriorOrientation,
    OpenCv,
    OpenCvFisheye,
    Perspective,
    Sensor,
)
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import write_camera_file
from jaxphoto.extras.formats.colmap import MODELS
from jaxphoto.io.camera_files import read_camera_file
from tests.commands import run
from tests.io.test_cameras import POINTS, columns_rows, written

RATIONAL = [-0.21, 0.11, 1.1e-3, -2.3e-3, 0.02, 0.03, -0.01, 0.004]
MRCAL = """# generated on a board
{{
    'lensmodel':  'LENSMODEL_{model}',
    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ {numbers},],
    'extrinsics': [ 0.1, -0.2, 0.3, 1.0, 2.0, 3.0,],
    'imagersize': [ 1280, 960,],
    'icam_intrinsics': 0,
}}
"""
ROS = """image_width: 1280
image_height: 960
camera_name: nadir
camera_matrix:
  rows: 3
  cols: 3
  data: [912.25, 0.0, 655.5, 0.0, 910.75, 471.25, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.21, 0.11, 0.0011, -0.0023, 0.02]
"""
MATRIX = np.array([[912.25, 0, 655.5], [0, 910.75, 471.25], [0, 0, 1]])


def mrcal(model, coefficients):
    return MRCAL.format(model=model, numbers=", ".join(map(repr, [912.25, 910.75, 655.5, 471.25, *coefficients])))


def plane(coefficients):
    return cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients))[0][:, 0] + 0.5


@pytest.mark.parametrize(
    ("model", "n"), [("PINHOLE", 0), ("OPENCV4", 4), ("OPENCV5", 5), ("OPENCV8", 8), ("OPENCV12", 12)]
)
def test_a_camera_of_mrcal_projects_as_opencv(tmp_path, model, n):
    given = RATIONAL[:n] + [0.0] * (n - 8)
    camera = read_camera_file(written(tmp_path, mrcal(model, given), "a.cameramodel"))
    np.testing.assert_allclose(columns_rows(camera), plane(given or [0.0] * 4), rtol=0, atol=1e-9)


SPLINED = "SPLINED_STEREOGRAPHIC_order=3_Nx=30_Ny=20_fov_x_deg=170"
REFUSED = {
    "splined": ("a.cameramodel", mrcal(SPLINED, []), f"'LENSMODEL_{SPLINED}' is not supported"),
    "prism": ("a.cameramodel", mrcal("OPENCV12", [*RATIONAL, 0.1, 0.0, 0.0, 0.0]), "terms of a thin prism"),
    "a word": ("a.cameramodel", mrcal("OPENCV4", RATIONAL[:4]).replace("655.5", "'x'"), "intrinsics .*'x'"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_camera_files_are_refused(tmp_path, name):
    file, text, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        read_camera_file(written(tmp_path, text, file))


def test_a_distortion_that_ros_has_and_opencv_not_is_refused(tmp_path):
    text = ROS.replace("plumb_bob", "thin_prism_fisheye")
    with pytest.raises(InputError, match="distortion_model 'thin_prism_fisheye' is not supported"):
        read_camera_file(written(tmp_path, text, "b.yaml"))


@pytest.mark.parametrize(("model", "kind"), [("plumb_bob", OpenCv), ("equidistant", OpenCvFisheye)])
def test_a_file_of_ros_is_read(tmp_path, model, kind):
    text = ROS.replace("plumb_bob", model)
    if model == "equidistant":
        text = text.replace("cols: 5", "cols: 4").replace(", 0.02]", "]")
    distortion = read_camera_file(written(tmp_path, text, "b.yaml")).interior.distortion
    assert type(distortion) is kind and (float(distortion.k1), float(distortion.k2)) == (-0.21, 0.11)


FISHEYE_SENSOR = Sensor(1280, 960, 0.003)
K = {"k1": -0.012, "k2": 0.003, "k3": -0.0011, "k4": 0.00012}


def fisheye_camera(**more):
    return InteriorOrientation(1.5, 0.01, -0.02, OpenCvFisheye(**(K | more)), projection=Equidistant())


FISHEYES = {
    "SIMPLE_RADIAL_FISHEYE": fisheye_camera(k2=0.0, k3=0.0, k4=0.0),
    "RADIAL_FISHEYE": fisheye_camera(k3=0.0, k4=0.0),
    "OPENCV_FISHEYE": fisheye_camera(b1=0.002),
    "THIN_PRISM_FISHEYE": fisheye_camera(b1=0.002, p1=0.001, p2=-0.002, s1=0.003, s2=-0.004),
}


def test_a_file_of_colmap_projects_as_opencv(tmp_path):
    # One set of numbers, as COLMAP writes it and as OpenCV takes it.
    fx, fy, cx, cy = 510.5, 508.25, 645.5, 478.25
    (tmp_path / "cameras.txt").write_text(
        f"7 OPENCV_FISHEYE 1280 960 {fx} {fy} {cx} {cy} " + " ".join(map(repr, K.values()))
    )
    read = read_camera_file(tmp_path / "cameras.txt", pixel_mm=0.003)
    point = np.array([[[0.7, -0.4, 0.6]]])
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    wanted = (
        cv2.fisheye.projectPoints(point, np.zeros(3), np.zeros(3), matrix, np.array(list(K.values())))[0][0, 0] + 0.5
    )
    level = jaxphoto.ExteriorOrientation(np.zeros(3), np.eye(3))
    xy = np.asarray(jaxphoto.project(read.interior, level, point[0, 0] * [1, -1, -1]))
    np.testing.assert_allclose(read.sensor.px_from_mm(xy[None])[0], wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "number"),
    [("OPENCV_FISHEYE", 5), ("SIMPLE_RADIAL_FISHEYE", 8), ("RADIAL_FISHEYE", 9), ("THIN_PRISM_FISHEYE", 10)],
)
def test_a_binary_file_is_the_same_camera(tmp_path, kind, number):
    write_camera_file(tmp_path / "cameras.txt", FISHEYE_SENSOR, FISHEYES[kind])
    values = list(map(float, (tmp_path / "cameras.txt").read_text().split()[-len(MODELS[kind]) :]))
    (tmp_path / "cameras.bin").write_bytes(struct.pack(f"<QIiQQ{len(values)}d", 1, 7, number, 1280, 960, *values))
    for name in ("images", "points3D"):
        (tmp_path / f"{name}.bin").write_bytes(struct.pack("<Q", 0))
    text, binary = (read_camera_file(tmp_path / f"cameras.{end}").interior for end in ("txt", "bin"))
    assert eqx.tree_equal(text, binary)


@pytest.mark.parametrize("kind", ["fisheye", "equidistant_fisheye"])
def test_a_fisheye_of_agisoft_is_the_same_camera(tmp_path, kind):
    camera, path = fisheye_camera(b1=0.002, b2=0.001, p1=0.001, p2=-0.002), tmp_path / "a.xml"
    assert write_camera_file(path, FISHEYE_SENSOR, camera).max_px == 0
    assert "<projection>fisheye</projection>" in path.read_text()
    path.write_text(path.read_text().replace(">fisheye<", f">{kind}<"))
    read = read_camera_file(path, pixel_mm=0.003).interior
    level, point = jaxphoto.ExteriorOrientation(np.zeros(3), np.eye(3)), np.array([0.7, -0.4, 0.1])
    seen = [np.asarray(jaxphoto.project(c, level, point)) for c in (camera, read)]
    np.testing.assert_allclose(*seen, rtol=0, atol=1e-12)


def test_another_fisheye_is_fitted(tmp_path):
    camera = InteriorOrientation(1.5, 0.01, -0.02, projection=Equisolid())
    done = write_camera_file(tmp_path / "cameras.txt", FISHEYE_SENSOR, camera)
    assert 0 < done.max_px < 0.01
    assert isinstance(read_camera_file(tmp_path / "cameras.txt").interior.projection, Equidistant)


def test_a_perspective_camera_stays_one(tmp_path):
    write_camera_file(tmp_path / "a.yml", FISHEYE_SENSOR, InteriorOrientation(3.0, 0.01, 0.0, OpenCv(k1=-0.1)))
    read = read_camera_file(tmp_path / "a.yml").interior
    assert isinstance(read.projection, Perspective) and isinstance(read.distortion, OpenCv)


FITTED_SENSOR = Sensor(1280, 960, 0.01)


FAR = InteriorOrientation(11.0, 0.02, -0.03, Brown(k1=-9e-3, k2=-1e-3, p1=4e-3))


def test_losses_beyond_the_limit_are_refused(tmp_path):
    path = tmp_path / "cameras.txt"
    with pytest.raises(InputError, match=r"would change the camera \(fitted .*at column .*--loss-px \d+\)") as e:
        write_camera_file(path, FITTED_SENSOR, FAR)
    assert not path.exists()
    allowed = float(str(e.value).rsplit(maxsplit=1)[-1].rstrip(")"))
    assert allowed - 1 <= write_camera_file(path, FITTED_SENSOR, FAR, loss_px=allowed).max_px


def test_the_command_reports_loss_and_worst_point(tmp_path, monkeypatch, capsys):
    brown = InteriorOrientation(9.0, 0.02, -0.03, Brown(k1=-9e-4, k2=1e-6))
    write_camera_file(tmp_path / "block.toml", FITTED_SENSOR, brown)
    files = tmp_path / "block.toml", tmp_path / "a.yaml"
    code, out, _ = run(monkeypatch, capsys, "camera", *files)
    said = [line for line in out.splitlines() if "at column" in line]
    assert code == 0
    assert len(said) == 1
    text = (tmp_path / "a.yaml").read_text()
    assert said[0] in text
