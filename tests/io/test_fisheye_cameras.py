"""Fisheye cameras in files of OpenCV and COLMAP, and what other formats make of them."""

import struct

import cv2
import equinox as eqx
import numpy as np
import pytest

import jaxphoto
from jaxphoto.camera import (
    Equidistant,
    Equisolid,
    InteriorOrientation,
    OpenCv,
    OpenCvFisheye,
    Perspective,
    Sensor,
    get_parameter,
    parameter_names,
)
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import write_camera_file
from jaxphoto.extras.formats.colmap import MODELS
from jaxphoto.io.camera_files import read_camera_file

SENSOR = Sensor(1280, 960, 0.003)
K = {"k1": -0.012, "k2": 0.003, "k3": -0.0011, "k4": 0.00012}


def fisheye(**more):
    return InteriorOrientation(1.5, 0.01, -0.02, OpenCvFisheye(**(K | more)), projection=Equidistant())


CAMERAS = {
    "opencv": fisheye(b1=0.002),
    "SIMPLE_RADIAL_FISHEYE": fisheye(k2=0.0, k3=0.0, k4=0.0),
    "RADIAL_FISHEYE": fisheye(k3=0.0, k4=0.0),
    "OPENCV_FISHEYE": fisheye(b1=0.002),
    "THIN_PRISM_FISHEYE": fisheye(b1=0.002, p1=0.001, p2=-0.002, s1=0.003, s2=-0.004),
    "toml": fisheye(b1=0.002, b2=0.001, p1=0.001, p2=-0.002, s1=0.003, s2=-0.004),
}


@pytest.mark.parametrize("kind", CAMERAS)
def test_what_is_written_reads_back_as_the_same_camera(tmp_path, kind):
    camera = CAMERAS[kind]
    path = tmp_path / {"opencv": "a.yml", "toml": "a.toml"}.get(kind, "cameras.txt")
    assert write_camera_file(path, SENSOR, camera).max_px == 0
    if path.name == "cameras.txt":
        assert f"1 {kind} 1280 960 " in path.read_text()
    read = read_camera_file(path, pixel_mm=0.003)
    assert isinstance(read.interior.projection, Equidistant) and isinstance(read.interior.distortion, OpenCvFisheye)
    for name in parameter_names(camera):
        found, wanted = (float(get_parameter(c, name)) for c in (read.interior, camera))
        assert found == pytest.approx(wanted, rel=1e-13, abs=1e-15), name


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
    write_camera_file(tmp_path / "cameras.txt", SENSOR, CAMERAS[kind])
    values = list(map(float, (tmp_path / "cameras.txt").read_text().split()[-len(MODELS[kind]) :]))
    (tmp_path / "cameras.bin").write_bytes(struct.pack(f"<QIiQQ{len(values)}d", 1, 7, number, 1280, 960, *values))
    text, binary = (read_camera_file(tmp_path / f"cameras.{end}").interior for end in ("txt", "bin"))
    assert eqx.tree_equal(text, binary)


@pytest.mark.parametrize("kind", ["fisheye", "equidistant_fisheye"])
def test_a_fisheye_of_agisoft_is_the_same_camera(tmp_path, kind):
    camera, path = fisheye(b1=0.002, b2=0.001, p1=0.001, p2=-0.002), tmp_path / "a.xml"
    assert write_camera_file(path, SENSOR, camera).max_px == 0
    assert "<projection>fisheye</projection>" in path.read_text()
    path.write_text(path.read_text().replace(">fisheye<", f">{kind}<"))
    read = read_camera_file(path, pixel_mm=0.003).interior
    level, point = jaxphoto.ExteriorOrientation(np.zeros(3), np.eye(3)), np.array([0.7, -0.4, 0.1])
    seen = [np.asarray(jaxphoto.project(c, level, point)) for c in (camera, read)]
    np.testing.assert_allclose(*seen, rtol=0, atol=1e-12)


def test_another_fisheye_is_fitted(tmp_path):
    camera = InteriorOrientation(1.5, 0.01, -0.02, projection=Equisolid())
    done = write_camera_file(tmp_path / "cameras.txt", SENSOR, camera)
    assert 0 < done.max_px < 0.01
    assert isinstance(read_camera_file(tmp_path / "cameras.txt").interior.projection, Equidistant)


def test_a_perspective_camera_stays_one(tmp_path):
    write_camera_file(tmp_path / "a.yml", SENSOR, InteriorOrientation(3.0, 0.01, 0.0, OpenCv(k1=-0.1)))
    read = read_camera_file(tmp_path / "a.yml").interior
    assert isinstance(read.projection, Perspective) and isinstance(read.distortion, OpenCv)


@pytest.mark.parametrize("c_mm", [0.8, 5.0])  # 143 degrees in the corner, and less than 90
def test_a_format_of_planes_refuses_a_fisheye_and_names_those_that_have_one(tmp_path, c_mm):
    wide = InteriorOrientation(c_mm, 0.0, 0.0, projection=Equidistant())
    with pytest.raises(InputError, match=r"a\.txt: cameras of smac are perspective.* one of opencv, ros, colmap"):
        write_camera_file(tmp_path / "a.txt", SENSOR, wide)
    assert not (tmp_path / "a.txt").exists()
