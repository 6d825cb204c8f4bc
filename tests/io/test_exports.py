"""Exports: object points projected by the equations of each format, in NumPy, agree with ours."""

import dataclasses
import functools
import json
import math
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax
import numpy as np
import pytest
from pyproj import CRS, Proj, Transformer
from scipy.spatial.transform import Rotation

from jaxphoto.block import Frame
from jaxphoto.camera import (
    Agisoft,
    Brown,
    Equidistant,
    Equisolid,
    InteriorOrientation,
    OpenCv,
    OpenCvFisheye,
    Sensor,
    Smac,
)
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import EXPORTS, Project, ProjectCamera, export
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.writing import MARKER
from tests.formulas import camera_from_object

EPSG = 32633
ORIGIN = (13.2, 55.7, 91.5)
SENSOR = Sensor(4000, 3000, 0.0024)
CAMERAS = {
    "agisoft": InteriorOrientation(
        8.8, 0.031, -0.022, Agisoft(-0.02, 0.03, -0.01, 0.002, 1e-3, -7e-4, b1=3e-4, b2=-2e-4)
    ),
    "brown": InteriorOrientation(8.8, 0.031, -0.022, Agisoft(-0.02, 0.03, -0.01, p1=1e-3, p2=-7e-4)),
    "opencv": InteriorOrientation(8.8, 0.031, -0.022, OpenCv(-0.02, 0.03, -0.01, p1=1e-3, p2=-7e-4, b1=2e-4)),
    "rational": InteriorOrientation(8.8, 0.031, -0.022, OpenCv(0.5, 0.03, 0.01, 0.52, 0.02, 0.001, 1e-3, -7e-4)),
    "fisheye": InteriorOrientation(
        5.0, 0.031, -0.022, OpenCvFisheye(-0.02, 0.01, -0.003, 0.001), projection=Equidistant()
    ),
    "agisoft fisheye": InteriorOrientation(
        5.0, 0.031, -0.022, Agisoft(-0.02, 0.01, -0.003, 0.001, 1e-3, -7e-4, b1=3e-4, b2=-2e-4),
        projection=Equidistant(),
    ),
}  # fmt: skip
# What each format holds exactly, and is given.
HELD = [
    ("metashape", "agisoft"), ("metashape", "agisoft fisheye"), ("metashape", "fisheye"), ("blocksexchange", "brown"),
    ("opensfm", "opencv"), ("opensfm", "fisheye"), ("colmap", "rational"),
]  # fmt: skip
NAMES = ("a b.jpg", 'c<&">.jpg', "d,e.JPG", "f.tif")
_projected = jax.jit(jax.vmap(project, (None, 0, 0)))


@functools.cache
def photographs(camera, kind="epsg"):
    """Four photographs of forty points, the last one oblique."""
    rng = np.random.default_rng(3)
    positions = np.array([[-20, -5, 80], [15, 3, 85], [2, 30, 78], [120, 8, 90.0]]) + rng.normal(0, 1, (4, 3))
    angles = np.array([[0.05, -0.1, 0.3], [-0.08, 0.02, 2.9], [0.1, 0.1, -1.6], [0.1, 0.9, 1.2]])
    rotations = np.stack([camera_from_object(*a) for a in angles])
    xyz = np.column_stack([rng.uniform(-40, 40, (40, 2)), rng.uniform(-5, 12, 40)])
    image, point = np.repeat(np.arange(4), 40), np.tile(np.arange(40), 4)
    interior = CAMERAS[camera]
    xy = _projected(interior, ExteriorOrientation(positions[image], rotations[image]), xyz[point])
    frame = Frame("epsg", EPSG, None, "true", ORIGIN) if kind == "epsg" else Frame("local")
    exterior = ExteriorOrientation(positions, rotations)
    ids = tuple(re.sub(r"\.\w+$", "", name) for name in NAMES)
    return Project(
        "four", {"one": ProjectCamera(SENSOR, interior)}, ids, NAMES, ("one",) * 4, exterior,
        tuple(f"p{k}" for k in range(40)), xyz, image, point, SENSOR.px_from_mm(np.asarray(xy)), frame,
    )  # fmt: skip


def plane(x, y, fx, fy, cx, cy, k=(0,) * 6, p=(0, 0), skew=0.0):
    """OpenCV's equations, x right and y down, z = 1; k1 to k3, k4 to k6 below the line, p1 and p2."""
    r2 = x * x + y * y
    q = (1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3) / (1 + k[3] * r2 + k[4] * r2**2 + k[5] * r2**3)
    u = x * q + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x)
    v = y * q + p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y
    return np.stack([fx * u + skew * v + cx, fy * v + cy], axis=-1)


def fisheye(x, y, fx, fy, cx, cy, k):
    """cv2.fisheye's equations."""
    r = np.hypot(x, y)
    theta = np.arctan(r)
    scale = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8) / r
    return np.stack([fx * x * scale + cx, fy * y * scale + cy], axis=-1)


def seen(rotation, position, xyz):
    """x / z and y / z in a camera that looks along z."""
    x, y, z = rotation @ (xyz - position).T
    assert (z > 0).all()
    return x / z, y / z


def geocentric(p):
    """Object points from the centre of the earth: by way of the map, not of the local frame."""
    there = Transformer.from_crs(CRS.from_epsg(EPSG).to_3d(), CRS.from_epsg(4978), always_xy=True)
    return np.stack(there.transform(*p.frame.map.map(p.xyz).T), axis=1)


def world_from_place(longitude, latitude, height):
    """Rotation and translation of the east-north-up frame at a place of WGS 84 to geocentric axes."""
    lon, lat = math.radians(longitude), math.radians(latitude)
    sl, cl, sp, cp = math.sin(lon), math.cos(lon), math.sin(lat), math.cos(lat)
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    n = a / math.sqrt(1 - e2 * sp * sp)
    axes = np.array([[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0, cp, sp]])
    return axes, np.array([(n + height) * cp * cl, (n + height) * cp * sl, (n * (1 - e2) + height) * sp])


def by_metashape(folder, p):
    """Column and row, the centre of the first pixel at 0.5, of all points in all photographs."""
    root = ElementTree.parse(folder / "cameras.xml").getroot()
    transform = root.find("chunk/components/component/transform")
    rotation, translation, scale = (
        np.array(transform.findtext(k).split(), float) for k in ("rotation", "translation", "scale")
    )
    if p.frame.kind == "epsg":
        assert 'AUTHORITY["EPSG","32633"]' in root.findtext("chunk/reference")
    world = geocentric(p) if p.frame.kind == "epsg" else p.xyz
    chunk = (world - translation) @ rotation.reshape(3, 3) / scale
    calibration = root.find("chunk/sensors/sensor/calibration")
    v = {e.tag: float(e.text) for e in calibration if e.tag != "resolution"}
    get = lambda name: v.get(name, 0.0)  # noqa: E731
    found = []
    for camera in root.iter("camera"):
        matrix = np.array(camera.findtext("transform").split(), float).reshape(4, 4)
        x, y, z = np.linalg.inv(matrix)[:3] @ np.column_stack([chunk, np.ones(len(chunk))]).T
        x, y = x / z, y / z
        if calibration.get("type") == "fisheye":
            x, y = np.stack([x, y]) * np.arctan(np.hypot(x, y)) / np.hypot(x, y)
        r2 = x * x + y * y
        q = 1 + get("k1") * r2 + get("k2") * r2**2 + get("k3") * r2**3 + get("k4") * r2**4
        u = x * q + get("p1") * (r2 + 2 * x * x) + 2 * get("p2") * x * y
        w = y * q + get("p2") * (r2 + 2 * y * y) + 2 * get("p1") * x * y
        column = SENSOR.width_px / 2 + get("cx") + u * v["f"] + u * get("b1") + w * get("b2")
        found.append(np.stack([column, SENSOR.height_px / 2 + get("cy") + w * v["f"]], axis=-1))
    return found


def by_opensfm(folder, p):
    (r,) = json.loads((folder / "reconstruction.json").read_text())
    assert json.loads((folder / "camera_models.json").read_text()) == r["cameras"]
    xyz = np.array([r["points"][name]["coordinates"] for name in p.points])
    if p.frame.kind == "epsg":
        lla = json.loads((folder / "reference_lla.json").read_text())
        assert lla == r["reference_lla"]
        axes, centre = world_from_place(lla["longitude"], lla["latitude"], lla["altitude"])
        np.testing.assert_allclose(xyz @ axes.T + centre, geocentric(p), rtol=0, atol=2e-6)
    rows = [line.split("\t") for line in (folder / "tracks.csv").read_text().splitlines()]
    longer, half = max(SENSOR.width_px, SENSOR.height_px), np.array([SENSOR.width_px, SENSOR.height_px]) / 2
    place = {name: k for k, name in enumerate(p.files)}, {name: k for k, name in enumerate(p.points)}
    for row in rows:
        own = (p.image == place[0][row[0]]) & (p.point == place[1][row[1]])
        np.testing.assert_allclose(np.array(row[3:5], float) * longer + half, p.column_row[own][0], rtol=0, atol=1e-9)
    assert len(rows) == len(p.image)
    found = []
    for name in p.files:
        shot, camera = r["shots"][name], r["cameras"][r["shots"][name]["camera"]]
        rotation = Rotation.from_rotvec(shot["rotation"]).as_matrix()
        x, y = seen(rotation, -rotation.T @ shot["translation"], xyz)
        f = camera["focal_x"], camera["focal_y"], camera["c_x"], camera["c_y"]
        if camera["projection_type"] == "brown":
            k = [camera[key] for key in ("k1", "k2", "k3")]
            normalised = plane(x, y, *f, (*k, 0, 0, 0), (camera["p1"], camera["p2"]))
        else:
            assert camera["projection_type"] == "fisheye_opencv"
            normalised = fisheye(x, y, *f, [camera[f"k{i}"] for i in (1, 2, 3, 4)])
        found.append(normalised * longer + half)
    return found


def by_blocksexchange(folder, p):
    root = ElementTree.parse(folder / "blocks_exchange.xml").getroot()
    number = lambda e, name: float(e.findtext(name))  # noqa: E731
    ties = root.findall("Block/TiePoints/TiePoint")
    xyz = np.array([[number(t, f"Position/{a}") for a in "xyz"] for t in ties])
    if p.frame.kind == "epsg":
        latitude, longitude = map(float, root.findtext("SpatialReferenceSystems/SRS/Definition")[4:].split(","))
        axes, centre = world_from_place(longitude, latitude, 0.0)
        np.testing.assert_allclose(xyz @ axes.T + centre, geocentric(p), rtol=0, atol=2e-6)
    for k, tie in enumerate(ties):
        for m in tie.findall("Measurement"):
            own = (p.image == int(m.findtext("PhotoId"))) & (p.point == k)
            expected = p.column_row[own][0] - 0.5
            np.testing.assert_allclose([number(m, "x"), number(m, "y")], expected, rtol=0, atol=1e-9)
    group = root.find("Block/Photogroups/Photogroup")
    assert group.findtext("CameraOrientation") == "XRightYDown"
    f, centre = number(group, "FocalLengthPixels"), [number(group, f"PrincipalPoint/{a}") + 0.5 for a in "xy"]
    k1, k2, k3, p1, p2 = (number(group, f"Distortion/{a}") for a in ("K1", "K2", "K3", "P1", "P2"))
    photos = {photo.findtext("ImagePath"): photo for photo in group.findall("Photo")}
    found = []
    for name in p.files:
        pose = photos[name].find("Pose")
        rotation = np.array([[number(pose, f"Rotation/M_{i}{j}") for j in range(3)] for i in range(3)])
        x, y = seen(rotation, np.array([number(pose, f"Center/{a}") for a in "xyz"]), xyz)
        # Bentley's P1 and P2 are OpenCV's p2 and p1.
        found.append(plane(x, y, f, f, *centre, (k1, k2, k3, 0, 0, 0), (p2, p1)))
    return found


def by_colmap(folder, p):
    cells = [line.split() for line in (folder / "cameras.txt").read_text().splitlines() if not line.startswith("#")]
    assert cells[0][1] == "FULL_OPENCV"
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 = map(float, cells[0][4:])
    lines = [line for line in (folder / "images.txt").read_text().splitlines() if not line.startswith("#")][::2]
    assert [line.split(maxsplit=9)[9] for line in lines] == list(p.files)
    found = []
    for line in lines:
        w, x, y, z, *t = map(float, line.split()[1:8])
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        x, y = seen(rotation, -rotation.T @ np.array(t), p.xyz)
        found.append(plane(x, y, fx, fy, cx, cy, (k1, k2, k3, k4, k5, k6), (p1, p2)))
    return found


BY = {
    "metashape": by_metashape, "opensfm": by_opensfm, "blocksexchange": by_blocksexchange,
    "colmap": by_colmap,
}  # fmt: skip


@pytest.mark.parametrize("kind", ["epsg", "local"])
@pytest.mark.parametrize(("format", "camera"), HELD)
def test_points_project_alike_by_the_equations_of_the_format(tmp_path, format, camera, kind):
    p = photographs(camera, kind)
    if format == "colmap":
        p = p._replace(files=tuple(name.replace(" ", "_") for name in p.files))
    done = export(p, tmp_path / "out", format)
    assert done.cameras["one"].max_px == 0
    apart = np.abs(np.concatenate(BY[format](tmp_path / "out", p)) - p.column_row).max()
    assert apart < 1e-6


def test_misfit_of_a_fitted_camera_is_within_the_reported_maximum(tmp_path):
    p = photographs("brown")
    brown = InteriorOrientation(8.8, 0.031, -0.022, Brown(k1=-2e-4, k2=3e-6, p1=1e-5))
    xy = _projected(
        brown,
        ExteriorOrientation(*(a[p.image] for a in (p.exterior.position, p.exterior.camera_from_object))),
        p.xyz[p.point],
    )
    p = p._replace(cameras={"one": ProjectCamera(SENSOR, brown)}, column_row=SENSOR.px_from_mm(np.asarray(xy)))
    said = export(p, tmp_path / "out", "metashape").cameras["one"]
    inside = ((p.column_row > 0) & (p.column_row < [SENSOR.width_px, SENSOR.height_px])).all(axis=1)
    apart = np.linalg.norm(np.concatenate(by_metashape(tmp_path / "out", p)) - p.column_row, axis=1)[inside]
    assert inside.sum() > 60
    assert 1e-6 < apart.max() < said.max_px < 0.1
    assert said.rms_px <= said.max_px


@pytest.mark.parametrize("camera", ["agisoft", "agisoft fisheye"])
def test_a_camera_of_metashape_round_trip(tmp_path, camera):
    export(photographs(camera), tmp_path / "out", "metashape")
    again = read_camera_file(tmp_path / "out" / "cameras.xml")
    assert (again.name, again.sensor) == ("one", SENSOR)
    assert type(again.interior.projection) is type(CAMERAS[camera].projection)
    leaves = [np.array(jax.tree.leaves(i), float) for i in (again.interior, CAMERAS[camera])]
    np.testing.assert_allclose(*leaves, rtol=1e-12, atol=1e-16)


@pytest.mark.parametrize("format", EXPORTS)
def test_every_format_exports_any_camera_or_names_formats_that_can(tmp_path, format):
    """Brown's and SMAC's lens, whose polynomials go the other way, and one that sees beyond 90 degrees."""
    # Points to both sides of the axis, for those that follow rays; and no blank in a name, for lists.
    known, p = EXPORTS[format], photographs("opencv")
    near = (np.abs(p.column_row - [2000, 1500]) < [1500, 1100]).all(axis=1)
    p = p._replace(image=p.image[near], point=p.point[near], column_row=p.column_row[near])
    p = p._replace(files=tuple(name.replace(" ", "_") for name in p.files))
    lenses = {
        "brown": InteriorOrientation(8.8, 0.031, -0.022, Brown(k1=-2e-4, k2=3e-6, p1=1e-5)),
        "smac": InteriorOrientation(8.8, 0.031, -0.022, Smac(k0=1e-4, k1=-2e-4, p1=1e-5)),
        "fisheye": InteriorOrientation(3.0, 0.031, -0.022, projection=Equisolid()),
    }
    for name, interior in lenses.items():
        given = p._replace(cameras={"one": ProjectCamera(SENSOR, interior)})
        if name == "fisheye" and known.plane and not known.fisheye:
            with pytest.raises(InputError, match=r"fisheye.*; write one of colmap, .*metashape"):
                export(given, tmp_path / name, format)
            assert not (tmp_path / name).exists()
            continue
        said = export(given, tmp_path / name, format).cameras["one"]
        written = {path.suffix for path in (tmp_path / name).iterdir() if path.name != MARKER}
        assert written <= set(known.endings)
        # What f, k1 and k2 cannot follow they need not: rays are kept.
        most = 1.0 if known.keeps_rays else 0.02
        assert (said.max_px == 0) == (known.plane is None) and said.max_px < most, (name, said)


def test_angles_on_the_map_are_against_the_lines_of_its_grid(tmp_path):
    """Axes of the camera, as ways of ten metres on the map, freed of its scale: by PROJ alone."""
    p = photographs("opencv")
    export(p, tmp_path / "out", "opk")
    table = [line.split("\t") for line in (tmp_path / "out" / "exterior.txt").read_text().splitlines()]
    assert table[0][0] == "# coordinates of EPSG:32633, heights above the ellipsoid"
    assert table[2] == ["imageName", "X", "Y", "Z", "Omega", "Phi", "Kappa"]
    for i, (name, *cells) in enumerate(table[3:]):
        values = np.array(cells, float)
        position, matrix = p.exterior.position[i], p.exterior.camera_from_object[i]
        assert name == p.files[i]
        np.testing.assert_allclose(values[:3], p.frame.map.map(position[None])[0], rtol=0, atol=1e-9)
        longitude, latitude, height = p.frame.map.place(values[None, :3])[0]
        factors = Proj(EPSG).get_factors(longitude, latitude)
        # Above the ellipsoid a way is that much longer than its foot.
        scale = factors.meridional_scale / (1 + height / 6.38e6)
        ways = p.frame.map.map(position + 10 * matrix) - p.frame.map.map(position - 10 * matrix)
        axes = ways / 20 / [scale, scale, 1.0]
        np.testing.assert_allclose(camera_from_object(*np.radians(values[3:])), axes, rtol=0, atol=2e-7)
        # The convergence is there: against the local frame kappa differs by it.
        assert abs(factors.meridian_convergence) > 1


def test_the_table_of_angles_has_the_camera_as_it_was_adjusted(tmp_path):
    export(photographs("agisoft"), tmp_path / "out", "opk")
    camera = tomllib.loads((tmp_path / "out" / "camera.toml").read_text())["cameras"]["one"]
    assert camera["interior"]["b1"] == 3e-4
    assert read_camera_file(tmp_path / "out" / "camera.toml").interior.distortion.k4 == 0.002


def test_several_cameras(tmp_path):
    p = photographs("opencv")
    other = ProjectCamera(Sensor(2000, 1500, 0.0048), InteriorOrientation(9.9, 0.0, 0.0, OpenCv(k1=0.1)))
    two = p._replace(cameras={**p.cameras, "two": other}, image_camera=("one", "two", "one", "two"))
    export(two, tmp_path / "meta", "metashape")
    root = ElementTree.parse(tmp_path / "meta" / "cameras.xml").getroot()
    assert [c.get("sensor_id") for c in root.iter("camera")] == ["0", "1", "0", "1"]
    export(two, tmp_path / "bex", "blocksexchange")
    groups = ElementTree.parse(tmp_path / "bex" / "blocks_exchange.xml").getroot().iter("Photogroup")
    assert [[photo.findtext("Id") for photo in g.findall("Photo")] for g in groups] == [["0", "2"], ["1", "3"]]


def test_numbers_of_numpy_are_written_as_numbers(tmp_path):
    p = photographs("brown")
    p = p._replace(files=tuple(name.replace(" ", "_") for name in p.files))
    longitude, latitude, height = map(np.float64, ORIGIN)
    sensor = dataclasses.replace(SENSOR, pixel_mm=np.float64(SENSOR.pixel_mm))
    p = p._replace(
        frame=dataclasses.replace(p.frame, origin=(longitude, latitude, height)),
        cameras={"one": ProjectCamera(sensor, CAMERAS["brown"])},
    )
    for format in ("blocksexchange", "opensfm", "metashape", "opk", "colmap", "geojson"):
        export(p, tmp_path / format, format)
    for file in (file for file in tmp_path.rglob("*.*") if file.is_file()):
        assert "np.float" not in file.read_text(), file


def test_invalid_exports_are_refused(tmp_path):
    p = photographs("opencv")
    with pytest.raises(InputError, match="unknown export format 'patb'; choose one of colmap, "):
        export(p, tmp_path / "out", "patb")
    assert not (tmp_path / "out").exists()
    # Of another ellipsoid: no place of WGS 84.
    bessel = p._replace(frame=Frame("epsg", 31467, None, "true", (9.0, 50.0, 100.0)))
    export(bessel, tmp_path / "sfm", "opensfm")
    assert not (tmp_path / "sfm" / "reference_lla.json").exists()


def test_features_agree_with_the_map_projection(tmp_path):
    p = photographs("opencv")
    export(p, tmp_path / "json", "geojson")
    to_map = Transformer.from_crs(CRS.from_epsg(4979), CRS.from_epsg(EPSG).to_3d(), always_xy=True)
    for name, expected in (("stations", p.exterior.position), ("object_points", p.xyz)):
        features = json.loads((tmp_path / "json" / f"{name}.geojson").read_text())["features"]
        on_map = np.stack(to_map.transform(*np.array([f["geometry"]["coordinates"] for f in features]).T), axis=1)
        np.testing.assert_allclose(on_map, p.frame.map.map(expected), rtol=0, atol=1e-6)
        if name == "stations":
            angles = [repr(features[0]["properties"][f"{a}_deg"]) for a in ("omega", "phi", "kappa")]
    export(p, tmp_path / "opk", "opk")
    line = (tmp_path / "opk" / "exterior.txt").read_text().splitlines()[3].split("\t")
    assert angles == line[4:]
    with pytest.raises(InputError, match="the block is in a local frame"):
        export(photographs("opencv", "local"), tmp_path / "local", "geojson")


def test_the_page_names_every_format():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `([\w-]+)` \|", page.split("## Export")[1], re.MULTILINE) == list(EXPORTS)
