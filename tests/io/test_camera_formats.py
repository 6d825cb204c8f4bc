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
    get_parameter,
)
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import CAMERA_FORMATS, CAMERA_MODELS, write_camera_file
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


@pytest.mark.parametrize("c_mm", [0.8, 5.0])  # 143 degrees in the corner, and less than 90
def test_a_format_of_planes_refuses_a_fisheye_and_names_those_that_have_one(tmp_path, c_mm):
    wide = InteriorOrientation(c_mm, 0.0, 0.0, projection=Equidistant())
    with pytest.raises(
        InputError, match=r"a\.cameramodel: .* cameras of mrcal are perspective.* one of opencv, colmap"
    ):
        write_camera_file(tmp_path / "a.cameramodel", FISHEYE_SENSOR, wide)
    assert not (tmp_path / "a.cameramodel").exists()


FITTED_SENSOR = Sensor(1280, 960, 0.01)
RATIONAL_CAMERA = InteriorOrientation(
    11.0, 0.02, -0.03, OpenCv(k1=-0.1, k2=0.03, k3=-0.01, k4=0.2, k5=0.02, p1=1e-3, p2=-2e-3)
)
NAMES = {"opencv": "a.yml", "colmap": "cameras.txt", "mrcal": "a.cameramodel"}
EVERY = [(kind, name) for kind, known in CAMERA_FORMATS.items() for name in known.models]


def of_opencv(path):
    """Camera matrix and coefficients, as OpenCV itself reads them."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    return [storage.getNode(k).mat() for k in ("camera_matrix", "distortion_coefficients")]


def test_opencv_with_five_coefficients_has_the_reported_misfit(tmp_path):
    full, five = tmp_path / "full.yml", tmp_path / "five.yml"
    assert write_camera_file(full, FITTED_SENSOR, RATIONAL_CAMERA).max_px == 0
    done = write_camera_file(five, FITTED_SENSOR, RATIONAL_CAMERA, model="OPENCV5")
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
    done = write_camera_file(path, FITTED_SENSOR, RATIONAL_CAMERA, kind, model=model, loss_px=1e3)
    part = CAMERA_FORMATS[kind].models[model]
    back = read_camera_file(path, pixel_mm=FITTED_SENSOR.pixel_mm).interior
    assert type(back.distortion) is part.distortion and type(back.projection) is type(part.projection)
    assert all(float(get_parameter(back, name)) == 0 for name in part.lacks)
    assert float(back.c) == pytest.approx(float(done.interior.c), rel=1e-13)


def test_more_terms_lose_less(tmp_path):
    nested = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
    path = tmp_path / "cameras.txt"
    lost = [write_camera_file(path, FITTED_SENSOR, RATIONAL_CAMERA, model=name, loss_px=1e3).rms_px for name in nested]
    assert lost == sorted(lost, reverse=True) and lost[0] > 10 and lost[-1] == 0


def test_losses_beyond_the_limit_are_refused(tmp_path):
    path = tmp_path / "cameras.txt"
    with pytest.raises(InputError, match=r"would change the camera \(fitted .*at column .*--loss-px \d+\)") as e:
        write_camera_file(path, FITTED_SENSOR, RATIONAL_CAMERA, model="SIMPLE_PINHOLE")
    assert not path.exists()
    allowed = float(str(e.value).rsplit(maxsplit=1)[-1].rstrip(")"))
    assert (
        allowed - 1
        <= write_camera_file(path, FITTED_SENSOR, RATIONAL_CAMERA, model="SIMPLE_PINHOLE", loss_px=allowed).max_px
    )


def test_a_model_of_another_format_is_refused(tmp_path):
    with pytest.raises(InputError, match="unknown model RADIAL of format opencv; use one of OPENCV4, OPENCV5, OPENCV8"):
        write_camera_file(tmp_path / "a.yml", FITTED_SENSOR, RATIONAL_CAMERA, model="RADIAL")
    with pytest.raises(InputError, match="unknown model OPENCV5 of format agisoft; omit the model"):
        write_camera_file(tmp_path / "a.xml", FITTED_SENSOR, RATIONAL_CAMERA, model="OPENCV5")
    assert {name for _, name in EVERY} == set(CAMERA_MODELS)


def test_the_command_reports_loss_and_worst_point(tmp_path, monkeypatch, capsys):
    brown = InteriorOrientation(9.0, 0.02, -0.03, Brown(k1=-9e-4, k2=1e-6))
    write_camera_file(tmp_path / "block.toml", FITTED_SENSOR, brown)
    files = tmp_path / "block.toml", tmp_path / "a.yaml"
    code, out, _ = run(monkeypatch, capsys, "camera", *files, "--model", "OPENCV5")
    said = [line for line in out.splitlines() if "at column" in line]
    assert code == 0
    assert len(said) == 1
    text = (tmp_path / "a.yaml").read_text()
    assert said[0] in text and "rows: 5" in text
