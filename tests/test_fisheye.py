"""A fisheye that sees behind itself, from a block folder to the adjusted camera: read, found, adjusted, written."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxphoto
from jaxphoto.camera import Equidistant, InteriorOrientation, OpenCvFisheye, get_parameter, parameter_names
from jaxphoto.collinearity import ExteriorOrientation, camera_coordinates, image_ray
from jaxphoto.errors import BlockError
from jaxphoto.simulation.points import photograph

TRUTH = InteriorOrientation(
    1.7, 0.012, -0.02, OpenCvFisheye(k1=-0.012, k2=0.003, k3=-0.0011, k4=0.00012), projection=Equidistant()
)
SENSOR = jaxphoto.Sensor(3000, 3000, 0.0025)  # its half side of 3.75 mm is 126 degrees from the axis
SIGMA_MM = 0.0005
RNG = np.random.default_rng(31)
# Points on the walls, floor and ceiling of a room; cameras near its middle, which look all ways.
SIDES = np.array([6.0, 5.0, 3.0])
POINTS = RNG.uniform(-0.5, 0.5, (60, 3))
POINTS[np.arange(60), np.arange(60) % 3] = np.sign(POINTS[np.arange(60), np.arange(60) % 3]) / 2
POINTS = POINTS * SIDES + [100.0, 200.0, 10.0]
CENTRES = RNG.uniform(-0.25, 0.25, (7, 3)) * SIDES + [100.0, 200.0, 10.0]
ANGLES = RNG.uniform([-3, -1, -3], [3, 1, 3], (7, 3))
EXTERIOR = ExteriorOrientation.from_angles(CENTRES, ANGLES)
IMAGES, NAMES = [f"i{k}" for k in range(7)], [f"p{k}" for k in range(60)]
FIXED = range(0, 60, 4)

TOML = f"""
[sigmas]
image_mm = {SIGMA_MM}
[cameras.dome]
width_px = 3000
height_px = 3000
pixel_mm = 0.0025
distortion = "opencv_fisheye"
projection = "equidistant"
[cameras.dome.interior]
c_mm = 1.72
[cameras.dome.unknowns]
c_mm = "free"
xp_mm = "free"
yp_mm = "free"
k1 = "free"
k2 = "free"
k3 = "free"
k4 = "free"
"""


def rays():
    """What the cameras see of the points: measured without errors."""
    return photograph({"dome": TRUTH}, {"dome": SENSOR}, ["dome"] * 7, EXTERIOR, POINTS)


def folder_of(path, noise=0.0, orientations=True):
    path.mkdir(exist_ok=True)
    seen = rays()
    xy = seen.xy + noise * np.random.default_rng(5).normal(size=seen.xy.shape)
    (path / "block.toml").write_text(TOML)
    rows = [
        f"{IMAGES[i]},{NAMES[p]},{x!r},{y!r}" for i, p, (x, y) in zip(seen.image, seen.point, xy.tolist(), strict=True)
    ]
    (path / "image_points.csv").write_text("\n".join(["image,point,x_mm,y_mm", *rows]))
    known = [f"{NAMES[p]},{','.join(map(repr, POINTS[p].tolist()))},fixed" for p in FIXED]
    (path / "control_points.csv").write_text("\n".join(["point,X_m,Y_m,Z_m,role", *known]))
    lines = ["image,camera"] + [f"{name},dome" for name in IMAGES]
    if orientations:
        lines[0] += ",X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg"
        off = np.random.default_rng(6).normal(size=(7, 6)) * [0.02, 0.02, 0.02, 0.5, 0.5, 0.5]
        values = np.hstack([CENTRES, np.rad2deg(EXTERIOR.omega_phi_kappa)]) + off
        lines[1:] = [f"{line},{','.join(map(repr, v.tolist()))}" for line, v in zip(lines[1:], values, strict=True)]
    (path / "images.csv").write_text("\n".join(lines))
    return path


def angles_from_axis(image, point):
    each = jax.vmap(lambda c, m, p: camera_coordinates(ExteriorOrientation(c, m), p))
    uvw = np.asarray(each(CENTRES[image], np.asarray(EXTERIOR.camera_from_object)[image], POINTS[point]))
    return np.rad2deg(np.arccos(-uvw[:, 2] / np.linalg.norm(uvw, axis=1)))


def test_simulated_images_hold_what_lies_behind_the_image_plane():
    seen = rays()
    angle = angles_from_axis(seen.image, seen.point)
    assert (angle > 90).sum() > 40 and angle.max() > 115
    # Everything within the format is there, once: 115 degrees are inside it in every direction.
    image, point = (v.ravel() for v in np.meshgrid(range(7), range(60), indexing="ij"))
    inside = angles_from_axis(image, point) < 115
    assert set(zip(image[inside], point[inside], strict=True)) <= set(zip(seen.image, seen.point, strict=True))
    each = jax.vmap(lambda c, m, xy: image_ray(TRUTH, ExteriorOrientation(c, m), xy)[1])
    direction = np.asarray(each(CENTRES[seen.image], np.asarray(EXTERIOR.camera_from_object)[seen.image], seen.xy))
    to = POINTS[seen.point] - CENTRES[seen.image]
    np.testing.assert_allclose(direction, to / np.linalg.norm(to, axis=1, keepdims=True), rtol=0, atol=1e-11)


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    return jaxphoto.read_block(folder_of(tmp_path_factory.mktemp("dome"), SIGMA_MM))


def test_the_camera_is_recovered(block):
    adjusted = jaxphoto.adjust(block)
    assert bool(adjusted.converged)
    assert 0.9 < float(adjusted.sigma0) < 1.1
    found, truth = adjusted.unknowns, TRUTH
    table = jaxphoto.Tables(adjusted).interior.set_index("parameter")
    free = ["c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "k4"]
    off = [(table.value[n] - float(get_parameter(truth, n))) / table.sigma[n] for n in free]
    assert np.abs(off).max() < 3.5
    assert table.sigma["c_mm"] < 1e-3
    assert np.abs(np.asarray(found.exterior.position) - CENTRES).max() < 5e-3
    assert np.abs(np.asarray(found.points) - POINTS[[NAMES.index(p) for p in block.points]]).max() < 2e-2


def test_without_errors_truth_comes_back(block):
    exact = folder_numbers(block)
    adjusted = jaxphoto.adjust(exact)
    for name in parameter_names(TRUTH):
        found = float(get_parameter(adjusted.unknowns.interior["dome"], name))
        assert found == pytest.approx(float(get_parameter(TRUTH, name)), abs=1e-9), name


def folder_numbers(block):
    """The block with image points that have no errors."""
    seen = rays()
    place = {(IMAGES[i], NAMES[p]): xy for i, p, xy in zip(seen.image, seen.point, seen.xy, strict=True)}
    rows = block.image_points
    xy = [place[block.images[i], block.points[p]] for i, p in zip(rows.image, rows.point, strict=True)]
    return dataclasses.replace(block, image_points=dataclasses.replace(rows, xy=np.array(xy)))


def test_orientations_are_found_from_the_known_points(tmp_path):
    start = jaxphoto.read_block(folder_of(tmp_path / "dome", SIGMA_MM, orientations=False))
    adjusted = jaxphoto.adjust(start)
    assert bool(adjusted.converged)
    assert np.abs(np.asarray(adjusted.unknowns.exterior.position) - CENTRES).max() < 5e-3


def test_a_camera_that_looks_the_other_way_is_said_so(tmp_path):
    folder = folder_of(tmp_path / "dome")
    table = (folder / "images.csv").read_text().splitlines()
    cells = table[1].split(",")
    table[1] = ",".join([*cells[:6], repr(float(cells[6]) + 180), cells[7]])  # phi
    (folder / "images.csv").write_text("\n".join(table))
    with pytest.raises(BlockError, match="lies behind image i0, which measured it"):
        jaxphoto.adjust(jaxphoto.read_block(folder))


def test_it_is_not_oriented_from_nothing(tmp_path):
    folder = folder_of(tmp_path / "dome", orientations=False)
    (folder / "control_points.csv").unlink()
    with pytest.raises(
        BlockError, match=r"camera dome has the projection equidistant, .* perspective cameras only: give"
    ):
        jaxphoto.adjust(jaxphoto.read_block(folder))


def test_block_folder_and_results_keep_the_projection(block, tmp_path):
    jaxphoto.write_block(block, tmp_path / "again")
    assert 'projection = "equidistant"' in (tmp_path / "again/block.toml").read_text()
    again = jaxphoto.read_block(tmp_path / "again").start.unknowns.interior["dome"]
    assert isinstance(again.projection, Equidistant) and isinstance(again.distortion, OpenCvFisheye)
