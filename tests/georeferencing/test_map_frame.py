"""Local frames against PROJ's own chain through geocentric coordinates."""

import struct
import subprocess
import sys

import numpy as np
import pyproj
import pytest

from jaxphoto.errors import InputError
from jaxphoto.georeferencing.map_frame import MapFrame

ORIGIN = (-50.2, -25.1, 900.0)
RNG = np.random.default_rng(8)
LOCAL = RNG.uniform([-9000, -9000, -100], [9000, 9000, 2000], (40, 3))
CODES = [32722, 4326, 31982, 5880]  # UTM in WGS 84, geographic, UTM in SIRGAS 2000, Brazil Polyconic


def level(longitude, latitude):
    """Rows: east, north, up in geocentric axes."""
    l, b = np.deg2rad([longitude, latitude])  # noqa: E741
    return np.array(
        [
            [-np.sin(l), np.cos(l), 0],
            [-np.sin(b) * np.cos(l), -np.sin(b) * np.sin(l), np.cos(b)],
            [np.cos(b) * np.cos(l), np.cos(b) * np.sin(l), np.sin(b)],
        ]
    )


@pytest.mark.parametrize("code", CODES)
def test_coordinates_agree_with_pyproj_and_come_back(code):
    frame = MapFrame(code, None, ORIGIN)
    places = RNG.uniform([-50.4, -25.3, 0], [-50.0, -24.9, 2000], (40, 3))
    ellipsoid = pyproj.CRS(code).ellipsoid
    geocentric = pyproj.Transformer.from_pipeline(
        f"+proj=cart +a={ellipsoid.semi_major_metre} +b={ellipsoid.semi_minor_metre}"
    )
    at, origin = (np.stack(geocentric.transform(*p.T, radians=False), axis=-1) for p in (places, np.array(ORIGIN)))
    if code == 4326:
        coordinates = places
    else:
        project = pyproj.Proj(code)
        coordinates = np.column_stack([*project(places[:, 0], places[:, 1]), places[:, 2]])
    expected = (at - origin) @ level(*ORIGIN[:2]).T
    np.testing.assert_allclose(frame.local(coordinates), expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(frame.local(frame.map(LOCAL)), LOCAL, rtol=0, atol=1e-7)


@pytest.mark.parametrize("code", CODES[:3])  # in the plane of a grid that is not conformal it is another angle
def test_convergence_is_that_of_pyproj(code):
    frame = MapFrame(code, None, ORIGIN)
    place = frame.place(frame.map(LOCAL))
    expected = 0.0 if code == 4326 else pyproj.Proj(code).get_factors(place[:, 0], place[:, 1]).meridian_convergence
    np.testing.assert_allclose(np.rad2deg(frame.convergence(LOCAL)), expected, rtol=0, atol=1e-6)


def test_convergence_is_positive_east_of_the_central_meridian_in_the_north():
    # Textbook: (longitude - central meridian) sin(latitude).
    convergence = MapFrame(25832, None, (10.0, 50.0, 0.0)).convergence(np.zeros((1, 3)))
    np.testing.assert_allclose(convergence, np.deg2rad(np.sin(np.deg2rad(50))), rtol=1e-3)


def test_axes_at_a_distance_are_those_of_the_place():
    frame = MapFrame(32722, None, ORIGIN)
    place = frame.place(frame.map(LOCAL))
    for turned, (longitude, latitude, _) in zip(frame.local_from_level(LOCAL), place, strict=True):
        np.testing.assert_allclose(turned, level(*ORIGIN[:2]) @ level(longitude, latitude).T, rtol=0, atol=1e-12)


def test_grid_axes_point_along_grid_lines():
    frame = MapFrame(32722, None, ORIGIN)
    at, east, north = frame.map(LOCAL), np.array([10.0, 0, 0]), np.array([0, 10.0, 0])
    # UTM is conformal, so eastings serve as well as northings.
    right, step = (frame.local(at + line) - frame.local(at - line) for line in (east, north))
    axes = frame.local_from_grid(LOCAL)
    for column, line in ((0, right), (1, step)):
        line = line / np.linalg.norm(line, axis=1)[:, None]
        np.testing.assert_allclose(axes[:, :, column], line, rtol=0, atol=1e-7)


def test_sea_level_at_the_origin():
    np.testing.assert_allclose(MapFrame(32722, None, ORIGIN).sea_level(), -900.0, rtol=0, atol=1e-6)


REFUSED = {
    (99999, None): ["EPSG code 99999 is unknown", "correct"],
    (4978, None): ["EPSG:4978", "neither a projected nor a geographic CRS", "give"],
    (5773, None): ["EPSG:5773", "neither a projected nor a geographic CRS", "vertical"],
    (2227, None): ["EPSG:2227", "US survey foot", "convert"],
    (2053, None): ["EPSG:2053", "south or west", "convert"],
    (32722, 99999): ["EPSG code 99999 is unknown", "ellipsoidal heights"],
    (32722, 4326): ["EPSG:4326", "not a vertical CRS", "5773"],
    (32722, 5773): ["EGM96 height", "us_nga_egm96_15.tif", "not installed", "pyproj sync", "ellipsoidal"],
}


@pytest.mark.filterwarnings("ignore:Best transformation:UserWarning")
@pytest.mark.parametrize("code, vertical", REFUSED)
def test_codes_that_cannot_serve_are_refused(code, vertical):
    if vertical == 5773 and pyproj.transformer.TransformerGroup("EPSG:32722+5773", "EPSG:4979").best_available:
        pytest.skip("the geoid is on this computer")
    with pytest.raises(InputError) as caught:
        MapFrame(code, vertical, ORIGIN)
    for word in REFUSED[code, vertical]:
        assert word in str(caught.value)


def test_orthometric_heights_where_the_geoid_is_at_hand(tmp_path):
    """A geoid of our own in the place of EGM96, in a process of its own, because PROJ remembers its folders."""
    latitude, longitude = np.linspace(-90, 90, 181)[:, None], np.linspace(-180, 180, 361)
    height = 20 + latitude / 9 + longitude / 18
    header = struct.pack(">4d2i", -90, -180, 1, 1, 181, 361)
    (tmp_path / "egm96_15.gtx").write_bytes(header + height.astype(">f4").tobytes())
    program = f"""
import numpy as np, pyproj
pyproj.datadir.append_data_dir({str(tmp_path)!r})
from jaxphoto.georeferencing.map_frame import MapFrame
frame = MapFrame(32722, 5773, {ORIGIN})
coordinates = np.array([[580663.996, 7223740.43, 950.0]])
longitude, latitude, height = frame.place(coordinates)[0]
assert abs(height - (950 + 20 + latitude / 9 + longitude / 18)) < 1e-5, height
assert np.abs(frame.map(frame.local(coordinates)) - coordinates).max() < 1e-7
assert abs(frame.sea_level() - (20 - 25.1 / 9 - 50.2 / 18 - 900)) < 1e-5
"""
    subprocess.run([sys.executable, "-c", program], check=True)
