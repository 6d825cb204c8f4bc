"""Cameras of mrcal, ROS and Kalibr: they project as OpenCV says, and what is written is the same camera."""

import cv2
import numpy as np
import pytest

from jaxphoto.camera import Equidistant, InteriorOrientation, OpenCv, OpenCvFisheye
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import write_camera_file
from jaxphoto.io.camera_files import read_camera_file
from tests.io.test_cameras import POINTS, SENSOR, columns_rows, same_numbers, written

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
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.21, 0.11, 0.0011, -0.0023]
  distortion_model: radtan
  intrinsics: [912.25, 910.75, 655.5, 471.25]
  resolution: [1280, 960]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.01, -0.003, 0.001]
  distortion_model: equidistant
  intrinsics: [912.25, 910.75, 655.5, 471.25]
  resolution: [1280, 960]
"""
MATRIX = np.array([[912.25, 0, 655.5], [0, 910.75, 471.25], [0, 0, 1]])


def mrcal(model, coefficients):
    return MRCAL.format(model=model, numbers=", ".join(map(repr, [912.25, 910.75, 655.5, 471.25, *coefficients])))


def plane(coefficients):
    return cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients))[0][:, 0] + 0.5


def fisheye(coefficients):
    given = POINTS[:, None], np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients)
    return cv2.fisheye.projectPoints(*given)[0][:, 0] + 0.5


@pytest.mark.parametrize(
    ("model", "n"), [("PINHOLE", 0), ("OPENCV4", 4), ("OPENCV5", 5), ("OPENCV8", 8), ("OPENCV12", 12)]
)
def test_a_camera_of_mrcal_projects_as_opencv(tmp_path, model, n):
    given = RATIONAL[:n] + [0.0] * (n - 8)
    camera = read_camera_file(written(tmp_path, mrcal(model, given), "a.cameramodel"))
    np.testing.assert_allclose(columns_rows(camera), plane(given or [0.0] * 4), rtol=0, atol=1e-9)


def test_cameras_of_a_chain_of_kalibr_project_as_opencv(tmp_path):
    path = written(tmp_path, KALIBR, "camchain.yaml")
    first, second = (read_camera_file(path, camera=name) for name in ("cam0", "cam1"))
    np.testing.assert_allclose(columns_rows(first), plane(RATIONAL[:4]), rtol=0, atol=1e-9)
    # As far from the axis as its angle, in the plane that `columns_rows` divides by.
    away = np.hypot(*POINTS[:, :2].T)
    equidistant = POINTS * np.stack(
        [(np.arctan2(away, POINTS[:, 2]) * POINTS[:, 2] / away)] * 2 + [np.ones(40)], axis=1
    )
    found = columns_rows(second, equidistant)
    np.testing.assert_allclose(found, fisheye([-0.02, 0.01, -0.003, 0.001]), rtol=0, atol=1e-9)
    with pytest.raises(InputError, match="name one of cam0, cam1"):
        read_camera_file(path)


@pytest.mark.parametrize(
    ("format", "distortion", "projection"),
    [
        ("mrcal", OpenCv(k1=-0.2, k2=0.1, p1=1e-3, p2=-2e-3, b1=1e-3), None),
        ("mrcal", OpenCv(k1=-0.2, k2=0.1, k3=0.01, k4=0.02, k5=-0.03, k6=0.04), None),
        ("ros", OpenCv(k1=-0.2, k2=0.1, k3=0.01, p1=1e-3, p2=-2e-3, b1=1e-3), None),
        ("ros", OpenCv(k1=-0.2, k4=0.02, k6=0.04), None),
        ("ros", OpenCvFisheye(-0.02, 0.01, -0.003, 0.001), Equidistant()),
    ],
)  # fmt: skip
def test_what_is_written_is_the_same_camera(tmp_path, format, distortion, projection):
    more = {} if projection is None else {"projection": projection}
    interior = InteriorOrientation(35.0, 0.065, 0.274, distortion, **more)
    conversion = write_camera_file(tmp_path / "a.yaml", SENSOR, interior, format, name="front: left")
    assert conversion.max_px == 0.0
    back = read_camera_file(tmp_path / "a.yaml", pixel_mm=SENSOR.pixel_mm)
    same_numbers(back.interior, interior)
    assert back.sensor == SENSOR and type(back.interior.projection) is type(interior.projection)


def test_a_file_of_ros_says_what_opencv_reads(tmp_path):
    interior = InteriorOrientation(35.0, 0.065, 0.274, OpenCv(k1=-0.2, k2=0.1, p1=1e-3, p2=-2e-3))
    write_camera_file(tmp_path / "a.yaml", SENSOR, interior, "ros", name="nadir")
    text = (tmp_path / "a.yaml").read_text()
    assert 'camera_name: "nadir"' in text and "distortion_model: plumb_bob" in text
    for key in ("rectification_matrix", "projection_matrix"):
        assert f"{key}:\n  rows: 3\n" in text


SPLINED = "SPLINED_STEREOGRAPHIC_order=3_Nx=30_Ny=20_fov_x_deg=170"
REFUSED = {
    "splined": ("a.cameramodel", mrcal(SPLINED, []), f"'LENSMODEL_{SPLINED}' is not known here"),
    "prism": ("a.cameramodel", mrcal("OPENCV12", [*RATIONAL, 0.1, 0.0, 0.0, 0.0]), "terms of a thin prism"),
    "few": ("a.cameramodel", mrcal("OPENCV8", RATIONAL[:7]), "12 numbers are needed"),
    "cut": ("a.cameramodel", mrcal("OPENCV4", RATIONAL[:4])[:-40], "damaged or no camera file"),
    "a word": ("a.cameramodel", mrcal("OPENCV4", RATIONAL[:4]).replace("655.5", "'x'"), "intrinsics .*'x'"),
    "omni": ("a.yaml", KALIBR.replace("camera_model: pinhole", "camera_model: omni"), "cam0 is a 'omni'"),
    "fov": ("a.yaml", KALIBR.replace("radtan", "fov"), "the distortion 'fov' of cam0"),
    "short": ("a.yaml", KALIBR.replace("912.25, ", ""), "intrinsics of cam0 .*4 numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_told_in_a_sentence(tmp_path, name):
    file, text, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        read_camera_file(written(tmp_path, text, file), camera="cam0" if file.endswith("yaml") else None)


def test_a_distortion_that_ros_has_and_opencv_not_is_refused(tmp_path):
    interior = InteriorOrientation(35.0, 0.065, 0.274, OpenCv(k1=-0.2))
    write_camera_file(tmp_path / "a.yaml", SENSOR, interior, "ros")
    text = (tmp_path / "a.yaml").read_text().replace("plumb_bob", "thin_prism_fisheye")
    with pytest.raises(InputError, match="distortion_model 'thin_prism_fisheye' is not known here"):
        read_camera_file(written(tmp_path, text, "b.yaml"))
