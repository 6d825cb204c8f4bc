"""Camera files of OpenCV, Agisoft, COLMAP, SMAC reports, results and blocks: projection, round trips, refusals."""

import json

import cv2
import jax
import numpy as np
import pytest

from jaxphoto.camera import (
    Agisoft,
    Balanced,
    Brown,
    InteriorOrientation,
    OpenCv,
    Sensor,
    Smac,
    get_parameter,
    parameter_names,
)
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import write_camera_file
from jaxphoto.io.camera_files import ASSUMED_PIXEL_MM, read_camera_file
from jaxphoto_command import main
from tests.derivatives import compiled

# Points before a camera that looks along +z with y down, as computer vision has it, to the corners of its format.
RNG = np.random.default_rng(3)
POINTS = np.column_stack([RNG.uniform(-0.7, 0.7, 40), RNG.uniform(-0.5, 0.5, 40), np.ones(40)]) * RNG.uniform(
    2, 9, (40, 1)
)

OPENCV = """%YAML:1.0
---
image_width: 1280
image_height: 960
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 912.25, 0., 655.5, 0., 910.75, 471.25, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 8
   cols: 1
   dt: d
   data: [ -0.21, 0.11, 1.1e-3, -2.3e-3, 0.02, 0.03, -0.01, 0.004 ]
avg_reprojection_error: 0.3125
"""
AGISOFT = """<?xml version="1.0" encoding="UTF-8"?>
<calibration>
  <projection>frame</projection>
  <width>4032</width>
  <height>3024</height>
  <f>3268.30117351641</f>
  <cx>-44.6362088</cx>
  <cy>17.5452248329602</cy>
  <b1>1.75</b1>
  <b2>-4.25145544487403</b2>
  <k1>-0.118322055927498</k1>
  <k2>0.093632083518507</k2>
  <k3>-0.0123</k3>
  <k4>0.0021</k4>
  <p1>0.000330080086304322</p1>
  <p2>-0.00182154893322038</p2>
  <date>2017-01-27T03:43:29Z</date>
</calibration>
"""
COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 6
1 SIMPLE_PINHOLE 3072 2304 2559.81 1536 1152
2 PINHOLE 3072 2304 2560.56 2561.56 1530.5 1158.25
3 SIMPLE_RADIAL 3072 2304 2559.69 1536 1152 -0.0218531
4 RADIAL 3072 2304 2559.69 1536 1152 -0.0218531 0.0123
5 OPENCV 3072 2304 2559.69 2561.7 1536 1152 -0.0218531 0.0123 0.0011 -0.0007
6 FULL_OPENCV 3072 2304 2559.69 2561.7 1536 1152 -0.0218531 0.0123 0.0011 -0.0007 0.01 0.02 -0.03 0.004
"""
# Numbers of OSSIM's self-test, "grabbed from a sample calibration report".
SMAC = """USGS Report No. OSL/0000
I. Calibrated Focal Length: 153.358 mm
Symmetric radial distortion parameters    Decentering distortion parameters    Calibrated principal point
  K0 = -0.2165E-03     P1 = -0.1483 x 10-6    xp = 0.003 mm
  K1 = 0.4230 x 10^-7  P2 = 0.1558 × 10-6     yp = −0.001 mm
  K2 = -0.1652 x 10-11 P3 = -0.1464 x 10-18
  K3 = 0.2860 x 10-19  P4 = 0.1233 x 10-38
  K4 = 0.5690 x 10-26
"""


def written(folder, text, name="camera.txt"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@compiled
def _images(interior, ideal):
    return jax.vmap(interior.measured_from_ideal)(ideal)


def columns_rows(camera, points=POINTS):
    """(column, row) of points in the camera frame of computer vision, by jaxphoto."""
    ideal = float(camera.interior.c) * points[:, :2] / points[:, 2:] * [1, -1]
    numbers = jax.tree.map(lambda v: np.asarray(v, float), camera.interior)
    return camera.sensor.px_from_mm(np.asarray(_images(numbers, ideal)))


def distorted(x, y, k, p1, p2, denominator=(0, 0, 0)):
    """OpenCV's formula, written out."""
    r2 = x * x + y * y
    q = (1 + sum(v * r2 ** (i + 1) for i, v in enumerate(k))) / (
        1 + sum(v * r2 ** (i + 1) for i, v in enumerate(denominator))
    )
    return np.stack([x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])


def same_numbers(a, b):
    assert type(a.distortion) is type(b.distortion)
    values = [[float(get_parameter(i, n)) for n in parameter_names(a)] for i in (a, b)]
    np.testing.assert_allclose(*values, rtol=1e-13, atol=1e-16)


# Truth ------------------------------------------------------------------------------------------------------


def test_opencv_file_projects_as_opencv(tmp_path):
    camera = read_camera_file(written(tmp_path, OPENCV, "calib.yml"))
    storage = cv2.FileStorage(str(tmp_path / "calib.yml"), cv2.FileStorage_READ)
    matrix, coefficients = (storage.getNode(k).mat() for k in ("camera_matrix", "distortion_coefficients"))
    expected = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    # OpenCV's first pixel has its centre at (0, 0).
    np.testing.assert_allclose(columns_rows(camera), expected + 0.5, rtol=0, atol=1e-9)
    assert camera.name == "calib"
    assert (camera.sensor.width_px, camera.sensor.height_px, camera.sensor.pixel_mm) == (1280, 960, ASSUMED_PIXEL_MM)
    assert "avg_reprojection_error 0.3125 px" in camera.note
    assert "0.001 mm was assumed" in camera.note
    sized = read_camera_file(tmp_path / "calib.yml", pixel_mm=0.0048)
    np.testing.assert_allclose(float(sized.interior.c), 910.75 * 0.0048, rtol=1e-15)
    np.testing.assert_allclose(columns_rows(sized), expected + 0.5, rtol=0, atol=1e-9)
    assert "assumed" not in sized.note


def test_agisoft_file_projects_by_the_equations_of_its_manual(tmp_path):
    camera = read_camera_file(written(tmp_path, AGISOFT, "lens.xml"))
    x, y = POINTS[:, 0] / POINTS[:, 2], POINTS[:, 1] / POINTS[:, 2]
    k = (-0.118322055927498, 0.093632083518507, -0.0123, 0.0021)
    # Its P1 and P2 are p2 and p1 of OpenCV.
    u, v = distorted(x, y, k, p1=-0.00182154893322038, p2=0.000330080086304322)
    f, b1, b2 = 3268.30117351641, 1.75, -4.25145544487403
    expected = np.column_stack([2016 - 44.6362088 + u * (f + b1) + v * b2, 1512 + 17.5452248329602 + v * f])
    np.testing.assert_allclose(columns_rows(camera), expected, rtol=0, atol=1e-9)
    assert isinstance(camera.interior.distortion, Agisoft)


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_opencv_files_have_as_many_coefficients_as_opencv_may_give(tmp_path, count):
    given = [-0.21, 0.11, 1.1e-3, -2.3e-3, 0.02, 0.03, -0.01, 0.004][:count] + [0.0] * (count - 8)
    text = OPENCV.split("distortion_coefficients")[0] + (
        f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: {count}\n   dt: d\n   data: {given}\n"
    )
    camera = read_camera_file(written(tmp_path, text, "a.yml"))
    matrix = np.array([[912.25, 0, 655.5], [0, 910.75, 471.25], [0, 0, 1]])
    expected = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), matrix, np.array(given))[0][:, 0]
    np.testing.assert_allclose(columns_rows(camera), expected + 0.5, rtol=0, atol=1e-9)


def test_opencv_5_writes_a_list_as_one_of_n_dimensions(tmp_path):
    text = OPENCV.split("distortion_coefficients")[0]
    given = "dt: d\n   data: [ -0.21, 0.11, 1.1e-3, -2.3e-3, 0.02 ]\n"
    new, old = (
        read_camera_file(written(tmp_path, f"{text}distortion_coefficients: !!{kind}\n   {sizes}\n   {given}", "a.yml"))
        for kind, sizes in (("opencv-nd-matrix", "sizes: [ 5 ]"), ("opencv-matrix", "rows: 5\n   cols: 1"))
    )
    assert jax.tree.all(jax.tree.map(np.array_equal, new.interior, old.interior))
    assert float(new.interior.distortion.k3) == 0.02


@pytest.mark.parametrize("number", range(1, 7))
def test_colmap_cameras_project_as_colmap(tmp_path, number):
    camera = read_camera_file(written(tmp_path, COLMAP, "cameras.txt"), camera=str(number))
    values = [float(v) for v in COLMAP.splitlines()[number + 2].split()[4:]]
    fx, fy, rest = (values[0], values[1], values[2:]) if number in (2, 5, 6) else (values[0], values[0], values[1:])
    cx, cy, *d = [*rest, *([0.0] * 8)]
    radial, p, rational = (d[0], d[1], d[4]), (d[2], d[3]), d[5:8]
    u, v = distorted(POINTS[:, 0] / POINTS[:, 2], POINTS[:, 1] / POINTS[:, 2], radial, *p, rational)
    np.testing.assert_allclose(columns_rows(camera), np.column_stack([fx * u + cx, fy * v + cy]), rtol=0, atol=1e-9)
    assert camera.name == str(number)


def test_smac_report_and_the_usgs_self_test(tmp_path):
    camera = read_camera_file(written(tmp_path, SMAC))
    # The measured point of the self-test and the one it has to come to, in mm.
    ideal = np.asarray(camera.interior.ideal_from_measured(np.array([62.142, -62.336])))
    np.testing.assert_allclose(ideal, [62.136, -62.332], rtol=0, atol=1e-3)
    values = {n: float(get_parameter(camera.interior, n)) for n in parameter_names(camera.interior)}
    assert values["c_mm"] == 153.358
    assert (values["xp_mm"], values["yp_mm"]) == (0.003, -0.001)
    assert (values["k1"], values["k4"], values["p2"]) == (0.4230e-7, 0.5690e-26, 0.1558e-6)
    assert camera.interior.distortion.sign == "add"
    assert "228.6 mm square" in camera.note
    assert camera.sensor.width_mm == pytest.approx(228.6)
    assert read_camera_file(tmp_path / "camera.txt", size_px=(4500, 3000), pixel_mm=0.008).sensor.width_px == 4500


# Back and forth ---------------------------------------------------------------------------------------------

SENSOR = Sensor(4500, 3000, 0.008)


@pytest.mark.parametrize(
    ("kind", "file"),
    [
        ("opencv", "a.yml"),
        ("colmap", "cameras.txt"),
        ("agisoft", "a.xml"),
    ],
)
def test_reservations_are_comments_of_camera_files(tmp_path, kind, file):
    interior = InteriorOrientation(35.0, 0.065, 0.274, OpenCv(k1=-0.2, k2=0.1, p1=1e-3, p2=-2e-3))
    said = "the verdict is red: T1 -- and 3 <others> are off"
    for name, against in (("plain", ""), ("marked", said)):
        (tmp_path / name).mkdir()
        write_camera_file(tmp_path / name / file, SENSOR, interior, kind, name="7", reservation=against)
    assert said.replace("--", "- -") in (tmp_path / "marked" / file).read_text()
    plain, marked = (read_camera_file(tmp_path / name / file, pixel_mm=SENSOR.pixel_mm) for name in ("plain", "marked"))
    same_numbers(marked.interior, plain.interior)
    assert (marked.name, marked.sensor) == (plain.name, plain.sensor)


def test_json_has_no_comment(tmp_path):
    interior = InteriorOrientation(35.0, 0.065, 0.274, OpenCv(k1=-0.2, p1=1e-3))
    write_camera_file(tmp_path / "a.json", SENSOR, interior, reservation="it is red")
    assert "it is red" not in (tmp_path / "a.json").read_text()
    same_numbers(read_camera_file(tmp_path / "a.json", pixel_mm=SENSOR.pixel_mm).interior, interior)


def test_colmap_camera_is_the_simplest_sufficient_model(tmp_path):
    models = []
    for distortion in (OpenCv(), OpenCv(b1=1e-3), OpenCv(k1=0.1), OpenCv(k2=0.1), OpenCv(p2=0.1), OpenCv(k3=0.1)):
        write_camera_file(tmp_path / "cameras.txt", SENSOR, InteriorOrientation(35.0, 0.1, 0.2, distortion))
        models.append((tmp_path / "cameras.txt").read_text().splitlines()[-1].split()[1])
    assert models == ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"]


def test_fitted_conversion_states_its_true_residual(tmp_path):
    brown = InteriorOrientation(35.0, 0.065, -0.2, Brown(k1=-9e-5, k2=1e-7, p1=1e-5, p2=-2e-5))
    conversion = write_camera_file(tmp_path / "a.yml", SENSOR, brown)
    back = read_camera_file(tmp_path / "a.yml", pixel_mm=SENSOR.pixel_mm).interior
    # Rays of the whole format through the file's camera, against where they come from: not the points of the fit.
    points = np.stack(np.meshgrid(np.linspace(-18, 18, 60), np.linspace(-12, 12, 40)), -1).reshape(-1, 2)
    rays = np.asarray(jax.vmap(brown.ideal_from_measured)(points)) / 35.0
    numbers = jax.tree.map(lambda v: np.asarray(v, float), back)
    apart = np.linalg.norm(np.asarray(_images(numbers, float(back.c) * rays)) - points, axis=1) / SENSOR.pixel_mm
    np.testing.assert_allclose(conversion.rms_px, np.sqrt(np.mean(apart**2)), rtol=0.15)
    np.testing.assert_allclose(conversion.max_px, apart.max(), rtol=0.02)
    assert 0 < conversion.max_px < 0.5


# jaxphoto's own ---------------------------------------------------------------------------------------------

TOML = """
[cameras.nadir]
width_px = 4500
height_px = 3000
pixel_mm = 0.008
distortion = "smac"
sign = "add"

[cameras.nadir.interior]
c_mm = 35.0
k1 = 1e-4
r0_mm = 8.0
"""
INTERIOR = (
    """camera,parameter,value,sigma,significant
nadir,c_mm,35.5,0.002,True
nadir,xp_mm,0.01,0.001,True
nadir,yp_mm,-0.02,,
nadir,k0,0.0,,
nadir,k1,9e-05,1e-07,True
"""
    + "".join(f"nadir,{n},0.0,,\n" for n in ("k2", "k3", "k4", "p1", "p2", "p3", "p4"))
    + "nadir,r0_mm,8.0,,\n"
)
CORRELATION = """parameter_a,parameter_b,rho
interior[nadir].c_mm,interior[nadir].xp_mm,0.25
interior[nadir].c_mm,interior[nadir].k1,0.75
interior[nadir].xp_mm,interior[nadir].c_mm,0.25
interior[nadir].xp_mm,interior[nadir].k1,0.5
interior[nadir].k1,interior[nadir].c_mm,0.75
interior[nadir].k1,interior[nadir].xp_mm,0.5
exterior[1].X_m,interior[nadir].k1,0.9
"""


def results_folder(tmp_path):
    written(tmp_path, INTERIOR, "interior.csv")
    written(tmp_path, CORRELATION, "correlation.csv")
    return tmp_path


def test_results_give_the_camera_and_its_covariance(tmp_path):
    block = written(tmp_path, TOML, "other.toml")
    folder = results_folder(tmp_path)
    camera = read_camera_file(folder, block=block)
    smac = Smac(k1=9e-5, r0=8.0, sign="add")
    same_numbers(camera.interior, InteriorOrientation(35.5, 0.01, -0.02, smac))
    assert camera.interior.distortion.sign == "add"
    assert float(camera.interior.distortion.r0) == 8.0
    assert camera.sensor == SENSOR
    expected = np.zeros((12, 12))
    free, sigma = [0, 1, 4], np.array([2e-3, 1e-3, 1e-7])
    expected[np.ix_(free, free)] = [[1, 0.25, 0.75], [0.25, 1, 0.5], [0.75, 0.5, 1]] * np.outer(sigma, sigma)
    np.testing.assert_allclose(camera.covariance, expected, rtol=1e-15)
    # Without the block, where the results say themselves what camera they are of.
    told = {"width_px": 4500, "height_px": 3000, "pixel_mm": 0.008, "distortion": "smac", "sign": "add"}
    written(tmp_path, json.dumps({"cameras": {"nadir": told}}), "summary.json")
    own = read_camera_file(folder / "interior.csv")
    np.testing.assert_array_equal(own.covariance, camera.covariance)
    same_numbers(own.interior, camera.interior)
    (folder / "correlation.csv").unlink()
    assert read_camera_file(folder).covariance is None


def test_camera_of_a_block(tmp_path):
    camera = read_camera_file(written(tmp_path, TOML, "block.toml"))
    same_numbers(camera.interior, InteriorOrientation(35.0, 0.0, 0.0, Smac(k1=1e-4, r0=8.0, sign="add")))
    assert read_camera_file(tmp_path).name == "nadir"


def test_a_block_may_get_another_model(tmp_path):
    interior = InteriorOrientation(35.0, 0.1, 0.2, Balanced(a1=-1e-4, a2=1e-7))
    assert write_camera_file(tmp_path / "b.toml", SENSOR, interior, distortion=OpenCv).max_px == 0
    back = read_camera_file(tmp_path / "b.toml").interior
    expected = OpenCv(k1=-1e-4 * 35**2, k2=1e-7 * 35**4)
    same_numbers(back, InteriorOrientation(35.0, 0.1, 0.2, expected))


# Bad input --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        (OPENCV[:300], "a.yml", "OpenCV cannot read it: it is truncated"),
        (OPENCV.replace("camera_matrix", "matrix"), "a.yml", "camera_matrix is missing"),
        (OPENCV.replace("image_width: 1280\n", ""), "a.yml", "image_width or image_height is missing"),
        (OPENCV.replace("912.25", "-912.25"), "a.yml", "-912.25 and 910.75 px are not positive"),
        (OPENCV + "fisheye_model: 1\n", "a.yml", "8 distortion_coefficients; OpenCV's model has 4"),
        (AGISOFT.replace("frame", "spherical"), "a.xml", "projection 'spherical' is not supported; use one of frame"),
        (AGISOFT.replace("<f>3268.30117351641</f>", ""), "a.xml", "<f> is missing"),
        (AGISOFT.replace("-0.0123", "-0,0123"), "a.xml", "k3 is '-0,0123', not a finite number"),
        (COLMAP, "cameras.txt", "6 cameras in the file; choose one of 1, 2, 3, 4, 5, 6"),
        (
            "1 FOV 100 100 80 50 50 0.1\n",
            "cameras.txt",
            "model FOV of camera 1 is not supported; use one of SIMPLE",
        ),
        (
            "1 RADIAL 100 100 80 50 50 0.1\n",
            "cameras.txt",
            "camera 1 has 4 parameters instead of the 5 of RADIAL: f, cx, cy, k1, k2",
        ),
        (SMAC.replace("0.1558 × 10-6", "0.1558 × 10-"), "a.txt", "P2 is '0.1558e-', not a finite number"),
        (SMAC.replace("P1 =", "P1").replace("153.358 mm", ""), "a.txt", "P1 not found in this SMAC report"),
        (INTERIOR, "interior.csv", "the model of camera nadir is in neither summary.json nor a block; give the block"),
        (COLMAP.replace("2 PINHOLE", "1 PINHOLE"), "cameras.txt", "duplicate camera 1"),
        ("# Camera list\n", "cameras.txt", "no camera in"),
        (OPENCV.replace("0.03", "x"), "a.yml", "distortion_coefficients is not a matrix of finite numbers"),
        ("", "a.txt", "the file is empty"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(tmp_path, text, name, message):
    path = written(tmp_path, text, name)
    with pytest.raises(InputError) as error:
        read_camera_file(path)
    assert message in str(error.value)
    assert name in str(error.value)
    assert "\n" not in str(error.value)


def test_wrong_use_is_refused(tmp_path):
    with pytest.raises(InputError, match="file not found"):
        read_camera_file(tmp_path / "none.yml")
    with pytest.raises(InputError, match=r"contains none of interior.csv, block.toml, camera.toml, cameras.txt"):
        read_camera_file(tmp_path)
    (tmp_path / "b.yml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not a text file"):
        read_camera_file(tmp_path / "b.yml")
    path = written(tmp_path, OPENCV, "a.yml")
    with pytest.raises(InputError, match="image size is 1280 x 960 px, not 100 x 100"):
        read_camera_file(path, size_px=(100, 100))
    with pytest.raises(InputError, match="pixel size -1 mm is invalid"):
        read_camera_file(path, pixel_mm=-1.0)
    with pytest.raises(InputError, match="unknown camera '9'"):
        read_camera_file(written(tmp_path, COLMAP, "cameras.txt"), camera="9")
    interior = InteriorOrientation(35.0, 0.0, 0.0, Brown())
    with pytest.raises(InputError, match="give one of opencv, colmap"):
        write_camera_file(tmp_path / "a.dat", SENSOR, interior)
    folding = InteriorOrientation(10.0, 0.0, 0.0, Brown(k1=5e-3))
    with pytest.raises(InputError, match=r"a\.xml: the camera cannot be written as agisoft: .* is not invertible"):
        write_camera_file(tmp_path / "a.xml", SENSOR, folding)
    assert not (tmp_path / "a.xml").exists()


def correlations(*rows):
    return "parameter_a,parameter_b,rho\n" + "".join(
        f"interior[nadir].{a},interior[nadir].{b},{rho}\n" for a, b, rho in rows
    )


PAIRS = [("c_mm", "xp_mm", 0.25), ("c_mm", "k1", 0.75), ("xp_mm", "k1", 0.5)]
IMPOSSIBLE = [("c_mm", "xp_mm", 0.9), ("c_mm", "k1", -0.9), ("xp_mm", "k1", 0.9)]


@pytest.mark.parametrize(
    "text",
    [
        CORRELATION.replace("xp_mm", "yp_mm", 1),
        correlations(*PAIRS),
        correlations(*PAIRS, *[(b, a, rho + 0.1) for a, b, rho in PAIRS]),
        correlations(*PAIRS, *[(b, a, "much") for a, b, _ in PAIRS]),
        correlations(*[(*pair, rho) for a, b, rho in IMPOSSIBLE for pair in ((a, b), (b, a))]),
    ],
    ids=["other parameters", "one way", "not symmetric", "text", "not positive"],
)
def test_correlations_of_another_adjustment_are_refused(tmp_path, text):
    block, folder = written(tmp_path, TOML, "b.toml"), results_folder(tmp_path)
    written(tmp_path, text, "correlation.csv")
    with pytest.raises(InputError, match=r"correlation.csv in its folder is of another adjustment"):
        read_camera_file(folder, block=block)


def test_results_that_are_incomplete_are_refused(tmp_path):
    folder = results_folder(tmp_path)
    block = written(tmp_path, TOML, "b.toml")
    written(tmp_path, "a,b\n1,2\n", "correlation.csv")
    with pytest.raises(
        InputError, match=r"correlation.csv in its folder is not a table of parameter_a, parameter_b, rho"
    ):
        read_camera_file(folder, block=block)
    written(
        tmp_path, TOML.replace('"smac"\nsign = "add"', '"ebner"').replace("r0_mm", "b_mm").replace("k1", "b1"), "e.toml"
    )
    with pytest.raises(InputError, match=r"camera nadir has no b1, b2, .* which Ebner needs"):
        read_camera_file(folder, block=tmp_path / "e.toml")


# The command ------------------------------------------------------------------------------------------------


def test_command_converts_and_reports_the_misfit(tmp_path, monkeypatch, capsys):
    written(tmp_path, OPENCV.replace("0.03, -0.01, 0.004", "0., 0., 0."), "calib.yml")
    arguments = ["camera", str(tmp_path / "calib.yml"), str(tmp_path / "lens.xml"), "--pixel-mm", "0.0048"]
    monkeypatch.setattr("sys.argv", ["jaxphoto", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 0
    said = capsys.readouterr().out
    assert "calib: OpenCv -> Agisoft" in said
    assert "note: avg_reprojection_error 0.3125 px" in said
    assert "the conversion is exact" in said
    both = [read_camera_file(tmp_path / name, pixel_mm=0.0048) for name in ("calib.yml", "lens.xml")]
    np.testing.assert_allclose(*map(columns_rows, both), rtol=0, atol=1e-9)
    for out, more, message in (
        ("lens.xml", [], "exists already"),
        ("new.xml", ["--width-px", "100"], "both --width-px and --height-px"),
        ("new.xml", ["--distortion", "none"], "brown"),
        ("new.xml", ["--format", "none"], "not one of 'opencv'"),
        ("new.xml", ["--distortion", "brown"], "--distortion Brown applies to a .toml; omit it"),
    ):
        monkeypatch.setattr("sys.argv", ["jaxphoto", *arguments[:2], str(tmp_path / out), *arguments[3:], *more])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert stopped.value.code == 2
        assert message in capsys.readouterr().err
