"""GeoTIFFs of surface models and orthophotos, read back by rasterio itself; the commands `dsm` and `orthophoto`."""

import dataclasses
import functools
import re

import jax
import numpy as np
import pytest
import rasterio
from pyproj import CRS
from rasterio.errors import NotGeoreferencedWarning

from jaxphoto import InputError, Sensor
from jaxphoto.block import Frame
from jaxphoto.cloud import Cloud
from jaxphoto.io import clouds, raster, write_block
from jaxphoto.lidar.raster import Picture, Raster, filled, hillshade, surface_model
from tests.checked_types import unchecked
from tests.commands import run
from tests.lidar.photographs import rendered
from tests.simulation.small import made

UTM = Frame("epsg", 32722, None, "true", (-50.2, -25.1, 0.0))


def north_up(west, north, width, height):
    """The place of cells of this size."""
    return rasterio.Affine(width, 0, west, 0, -height, north)


def surface(seed=1, shape=(300, 410), west=194_000.0, north=258_900.0):
    rng = np.random.default_rng(seed)
    heights = rng.normal(120.0, 30.0, shape)
    heights[rng.random(shape) < 0.1] = np.nan
    return Raster(heights, west, north, 0.5)


@pytest.mark.parametrize("code", [None, 32610, 2993])
def test_rasterio_reads_written_models(tmp_path, code):
    model = surface()
    system = clouds.CoordinateSystem() if code is None else clouds.CoordinateSystem(CRS.from_epsg(code))
    path = tmp_path / "out" / "dsm.tif"
    raster.write_dsm(path, model, system)
    with rasterio.open(path) as file:
        assert file.profile["tiled"] and file.compression.name == "deflate" and file.dtypes == ("float32",)
        assert file.transform == rasterio.Affine(0.5, 0, 194_000.0, 0, -0.5, 258_900.0)
        assert (file.crs and file.crs.to_epsg()) == code
        assert file.tags(ns="IMAGE_STRUCTURE")["PREDICTOR"] == "3"
        values = file.read(1, masked=True)
    np.testing.assert_array_equal(np.ma.getmaskarray(values), np.isnan(model.heights))
    np.testing.assert_array_equal(values.compressed(), model.heights[~np.isnan(model.heights)].astype("f4"))
    read, of = raster.read_dsm(path)
    np.testing.assert_array_equal(read.heights, model.heights.astype("f4"))
    np.testing.assert_array_equal(read.extent, model.extent)
    assert of.plane == system.plane and of.heights is None
    assert [p.name for p in path.parent.iterdir()] == ["dsm.tif"]


def test_systems_of_heights_round_trip(tmp_path):
    raster.write_dsm(tmp_path / "dsm.tif", surface(), clouds.CoordinateSystem(CRS.from_epsg(32610), 5703))
    _, system = raster.read_dsm(tmp_path / "dsm.tif")
    assert (system.plane.to_epsg(), system.heights) == (32610, 5703)


def test_a_model_in_feet_is_read_in_metres(tmp_path):
    model = surface()
    kind = {"driver": "GTiff", "height": 300, "width": 410, "count": 1, "dtype": "float64", "crs": "EPSG:2994"}
    place = north_up(model.west / 0.3048, model.north / 0.3048, 0.5 / 0.3048, 0.5 / 0.3048)
    with rasterio.open(tmp_path / "ft.tif", "w", nodata=np.nan, transform=place, **kind) as file:
        file.write(model.heights / 0.3048, 1)
    read, system = raster.read_dsm(tmp_path / "ft.tif")
    np.testing.assert_allclose(read.heights, model.heights, rtol=1e-14)
    np.testing.assert_allclose(read.extent, model.extent, rtol=1e-14)
    assert system.plane.axis_info[0].unit_name == "metre"


def test_real_strip_to_a_surface_model(data_dir, tmp_path, monkeypatch, capsys):
    """The command against every cell by NumPy; and the PNG is the shading of that."""
    cloud, out = data_dir / "lidar" / "autzen_trim.laz", tmp_path / "dsm.tif"
    hill = tmp_path / "hill.png"
    arguments = ("--cell-m", 1.5, "--returns", "first", "--fill-m", 1.5, "--hillshade", hill)
    code, said, errors = run(monkeypatch, capsys, "dsm", cloud, "--out", out, *arguments)
    assert (code, errors) == (0, "") and "NAD_1983_HARN" in said
    xyz = clouds.read_cloud(cloud, returns="first").xyz
    column, row = (np.floor(xyz[:, :2] / 1.5).astype(int) * [1, -1]).T
    column, row = column - column.min(), row - row.min()
    expected = np.full((row.max() + 1, column.max() + 1), -np.inf)
    for r, c, z in zip(row, column, xyz[:, 2], strict=True):
        expected[r, c] = max(expected[r, c], z)
    there = np.isfinite(expected)
    with rasterio.open(out) as file:
        values, place = file.read(1, masked=True).filled(np.nan), file.transform
        assert CRS.from_wkt(file.crs.to_wkt()).axis_info[0].unit_name == "metre"
    assert values.shape == expected.shape
    np.testing.assert_array_equal(values[there], expected[there].astype("f4"))
    assert 0 < np.isfinite(values[~there]).sum() < (~there).sum()
    west, south = np.floor(xyz[:, :2].min(axis=0) / 1.5) * 1.5
    assert (place.c, place.f) == (west, south + len(expected) * 1.5)
    model = filled(surface_model([xyz], [xyz.min(axis=0)[:2], xyz.max(axis=0)[:2]], 1.5), 1.5)
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(hill) as file:
        grey, alpha = file.read()
    shade = hillshade(model)
    np.testing.assert_array_equal(alpha == 255, ~np.isnan(shade))
    np.testing.assert_allclose(grey[alpha == 255] / 255, shade[~np.isnan(shade)], atol=0.51 / 255)


def test_parts_of_a_cloud_make_the_model_of_the_whole(tmp_path, monkeypatch, capsys):
    """Chunks of the file one after another, classes chosen, in feet that the user says."""
    monkeypatch.setattr("jaxphoto.io.clouds.las.CHUNK", 700)
    rng = np.random.default_rng(0)
    xyz = np.round(rng.uniform(0, 300, (5000, 3)), 3)
    classes = rng.choice([1, 2, 6], 5000).astype(np.uint8)
    clouds.write_cloud(Cloud(xyz, classes), tmp_path / "c.laz")
    arguments = ("dsm", tmp_path / "c.laz", "--out", tmp_path / "d.tif", "--class", "2,6", "--statistic", "mean")
    code, said, _ = run(monkeypatch, capsys, *arguments, "--cloud-unit", "ft", "--cell-m", 3)
    assert code == 0 and "local frame" in said
    kept = xyz[classes > 1] * 0.3048
    model = surface_model([kept], [kept.min(axis=0)[:2], kept.max(axis=0)[:2]], 3.0, "mean")
    np.testing.assert_allclose(raster.read_dsm(tmp_path / "d.tif")[0].heights, model.heights, rtol=1e-6)


def test_rasters_that_are_no_surface_models(tmp_path):
    path = tmp_path / "d.tif"
    kind = {"driver": "GTiff", "height": 20, "width": 30, "count": 1, "dtype": "float32", "nodata": -9999.0}
    turned = rasterio.Affine.translation(1e5, 2e5) @ rasterio.Affine.rotation(10) @ rasterio.Affine.scale(1, -1)
    cases = [
        ({"transform": north_up(5, 5, 1, 1), "crs": "EPSG:4326"}, "degrees"),
        ({"transform": turned}, "north up"),
        ({"transform": north_up(5, 5, 1, 2)}, "1 x 2"),
        ({"transform": north_up(5, 5, 1, 1)}, "no heights"),
    ]
    for place, says in cases:
        with rasterio.open(path, "w", **kind, **place) as file:
            file.write(np.full((20, 30), -9999.0 if says == "no heights" else 1.0, "f4"), 1)
        with pytest.raises(InputError, match=f"d.tif.*{says}"):
            raster.read_dsm(path)
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(path, "w", **kind) as file:
        file.write(np.ones((20, 30), "f4"), 1)
    with pytest.raises(InputError, match="no georeferencing"):
        raster.read_dsm(path)
    with pytest.raises(InputError, match="no file"):
        raster.read_dsm(tmp_path / "none.tif")
    raster.write_dsm(path, surface())
    whole = path.read_bytes()
    for content in (b"no raster", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"d\.tif cannot be read as a raster"):
            raster.read_dsm(path)


def test_nonfinite_heights_are_missing(tmp_path):
    path = tmp_path / "d.tif"
    place = {"transform": north_up(5, 5, 1, 1), "crs": "EPSG:32633"}
    signalling = np.array([0x7F800001], "<u4").view("<f4")[0]
    heights = np.array([[1.0, np.inf, signalling], [-np.inf, np.nan, 2.0]], "<f4")
    with rasterio.open(path, "w", driver="GTiff", height=2, width=3, count=1, dtype="float32", **place) as file:
        file.write(heights, 1)
    np.testing.assert_array_equal(raster.read_dsm(path)[0].heights, [[1, np.nan, np.nan], [np.nan, np.nan, 2]])


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("bands", [1, 3])
def test_orthophotos_carry_a_mask(tmp_path, kind, bands):
    model = surface(shape=(70, 90))
    rng = np.random.default_rng(0)
    seen = rng.random((70, 90)) < 0.7
    pixels = np.where(seen, rng.integers(0, 200, (bands, 70, 90)), 0).astype(kind)
    raster.write_orthophoto(
        tmp_path / "o.tif", Picture(pixels, seen), model, clouds.CoordinateSystem(CRS.from_epsg(32722))
    )
    with rasterio.open(tmp_path / "o.tif") as file:
        np.testing.assert_array_equal(file.read(), pixels)
        np.testing.assert_array_equal(file.dataset_mask() > 0, seen)
        assert file.crs.to_epsg() == 32722 and file.transform.c == model.west and file.transform.f == model.north
    assert [p.name for p in tmp_path.iterdir()] == ["o.tif"]


def test_photographs_of_another_size(tmp_path):
    path = tmp_path / "p.tif"
    kind = {"driver": "GTiff", "height": 20, "width": 30, "count": 3, "dtype": "uint8"}
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(path, "w", **kind) as file:
        file.write(np.arange(1800, dtype="u1").reshape(3, 20, 30))
    np.testing.assert_array_equal(
        raster.read_photograph(path, Sensor(30, 20, 0.1)), np.arange(1800, dtype="u1").reshape(3, 20, 30)
    )
    for sensor, says in ((Sensor(20, 30, 0.1), "before it was rotated"), (Sensor(40, 20, 0.1), "40 x 20")):
        with pytest.raises(InputError, match=f"30 x 20 pixels.*{says}"):
            raster.read_photograph(path, sensor)


# The command `orthophoto`


def texture(x, y):
    return np.stack([120 + 80 * np.sin(x / 40 + k) * np.cos(y / 55) for k in range(3)])


def sunk(x, y):
    """The ellipsoid below the local frame at latitude -25: 6378 km in a plane across the meridian, less along it."""
    return -(x * x) / (2 * 6_381_956.0) - y * y / (2 * 6_346_818.0)


@functools.cache
def flown():
    """A simulated block over level ground whose camera has few pixels."""
    small = {"cameras.kodak.width_px": 450, "cameras.kodak.height_px": 300, "cameras.kodak.pixel_mm": 0.08}
    every = dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1", "k2"), "free")
    return made(small | {"terrain": {"kind": "flat"}, "cameras.kodak.unknowns": every})


def photographed(folder, image, height):
    """The block with a photograph of one of its images."""
    simulation = flown()
    at = simulation.block.images.index(image)
    truth = jax.tree.map(np.asarray, simulation.truth)
    pixels = rendered(
        simulation.block.sensors["kodak"],
        truth.interior["kodak"],
        truth.exterior.position[at],
        np.asarray(simulation.truth.exterior.omega_phi_kappa)[at],
        height,
        texture,
    )
    kind = {"driver": "GTiff", "height": 300, "width": 450, "count": 3, "dtype": "uint8"}
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(folder / "photo.tif", "w", **kind) as file:
        file.write(np.rint(pixels).astype("u1"))
    return truth.exterior.position[at]


@pytest.mark.parametrize("frame", [Frame("local"), UTM], ids=["local", "epsg"])
def test_the_command_lays_a_photograph_over_the_ground(tmp_path, monkeypatch, capsys, frame):
    """Adjusted from noise-free observations, the orthophoto is the ground's brightness; in UTM as in a local frame."""
    block = dataclasses.replace(flown().block, frame=frame)
    with monkeypatch.context():
        write_block(block, tmp_path / "block")
    image = block.images[len(block.images) // 2]
    in_map = frame.kind == "epsg"
    centre = photographed(tmp_path, image, sunk if in_map else lambda x, y: 0 * x)
    middle = frame.map.map(centre[None] * [1, 1, 0])[0] if in_map else centre
    west, north = np.floor(middle[:2] / 8) * 8 + [-600, 600]
    model = Raster(np.zeros((150, 150)), west, north, 8.0)
    raster.write_dsm(tmp_path / "dsm.tif", model, clouds.frame_system(frame))
    arguments = (tmp_path / "block", tmp_path / "photo.tif", tmp_path / "dsm.tif", "--out", tmp_path / "ortho.tif")
    code, said, errors = run(monkeypatch, capsys, "orthophoto", *arguments, "--image", image)
    assert code == 0, errors
    with rasterio.open(tmp_path / "ortho.tif") as file:
        pixels, seen = file.read().astype(float), file.dataset_mask() > 0
        assert (file.crs and file.crs.to_epsg()) == frame.code and file.transform.c == west
    assert 0.3 < seen.mean() < 1 and f"{100 * seen.mean():.0f} %" in said
    centres = model.centres()
    local = frame.map.local(centres) if in_map else centres
    truth = texture(*local[:, :2].T).reshape(3, 150, 150)
    # Rounded twice to whole numbers; pixels of 2.3 m over waves of 40 and 55 m give 0.1.
    assert np.abs(pixels - truth)[:, seen].max() < 1.3


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"--image": "nobody"}, "no such image; it has"),
        ({"dsm": "away"}, r"does not see dsm\.tif"),
        ({"dsm": "utm"}, "frame is local"),
        ({"photo": "dsm"}, "its camera 450 x 300"),
        ({"photo": "none"}, "no file"),
    ],
)
def test_invalid_options_of_orthophoto_are_refused(tmp_path, monkeypatch, capsys, changes, says):
    block = flown().block
    write_block(block, tmp_path / "block")
    photographed(tmp_path, block.images[0], lambda x, y: 0 * x)
    away = 1e5 if changes.get("dsm") == "away" else 0.0
    system = clouds.CoordinateSystem(CRS.from_epsg(32722)) if changes.get("dsm") == "utm" else clouds.CoordinateSystem()
    raster.write_dsm(tmp_path / "dsm.tif", Raster(np.zeros((50, 50)), away - 400, 400.0, 16.0), system)
    photo = {"dsm": "dsm.tif", "none": "none.tif"}.get(changes.get("photo"), "photo.tif")
    arguments = (tmp_path / "block", tmp_path / photo, tmp_path / "dsm.tif", "--out", tmp_path / "ortho.tif")
    image = changes.get("--image", block.images[0])
    code, _, errors = run(monkeypatch, capsys, "orthophoto", *arguments, "--image", image)
    assert code == 2 and errors.count("\n") == 1
    assert re.search(says, errors), errors
    assert not (tmp_path / "ortho.tif").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--class", "two"), "give class numbers"),
        (("--class", "9"), "no points of class 9"),
        (("--returns", "none"), "'none' is not one of 'all'"),
        (("--statistic", "median"), "'median' is not one of 'highest'"),
        (("--cell-m", "0"), "0 is not a positive number"),
        (("--cloud-unit", "yd"), "'yd' is not one of 'm'"),
        (("--cloud-epsg", "1"), "EPSG code 1 is unknown"),
    ],
)
def test_invalid_options_of_dsm_are_refused(tmp_path, monkeypatch, capsys, arguments, says):
    clouds.write_cloud(Cloud(np.arange(30.0).reshape(10, 3), np.ones(10, np.uint8)), tmp_path / "c.las")
    with unchecked():
        code, _, errors = run(monkeypatch, capsys, "dsm", tmp_path / "c.las", "--out", tmp_path / "d.tif", *arguments)
    assert code == 2 and says in errors and "Traceback" not in errors
    assert not (tmp_path / "d.tif").exists()
