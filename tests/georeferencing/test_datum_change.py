"""Positions of receivers on the datums of national map systems, against pyproj."""

import re
import warnings

import numpy as np
import pyproj
import pytest

from jaxphoto.georeferencing.datum_change import datum_change, wgs84_places
from jaxphoto.georeferencing.map_frame import MapFrame

NEAR = {31287: (15.0, 47.0), 25832: (9.0, 50.0), 32633: (15.0, 47.0), 2056: (7.4, 46.9), 27700: (-1.5, 52.0)}


@pytest.mark.parametrize("code", NEAR)
def test_map_coordinates_of_received_positions_are_those_of_pyproj(code):
    longitude, latitude = NEAR[code]
    wgs84 = np.array([longitude, latitude, 0.0]) + np.random.default_rng(4).uniform(0, [0.02, 0.02, 900.0], (9, 3))
    change = datum_change(code, longitude, latitude)
    places = change.places(wgs84)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        plan = pyproj.Transformer.from_crs(4979, pyproj.CRS(code).to_3d(), always_xy=True)
    frame = MapFrame(code, None, (*places[0, :2].tolist(), 0.0))
    expected = np.stack(plan.transform(*wgs84.T), axis=1)
    np.testing.assert_allclose(frame.map(frame.local_from_place(places)), expected, rtol=0, atol=1e-5)
    # To 0.3 mm: PROJ turns back by small angles. Degrees as fine as metres of height.
    for back in (change.wgs84(places), wgs84_places(code, places)):
        np.testing.assert_allclose((back - wgs84) * [1e5, 1e5, 1], 0, atol=3e-4)
    flat = change.places(wgs84, False)
    np.testing.assert_array_equal(flat[:, 2], wgs84[:, 2])
    np.testing.assert_allclose(flat[:, :2], places[:, :2], rtol=0, atol=1e-13)


def test_what_a_change_does_and_how_sure_it_is_is_said():
    def said(code, longitude, latitude, with_height=True):
        return datum_change(code, longitude, latitude).sentences(np.array([[longitude, latitude, 500.0]]), with_height)

    assert said(25832, 9.0, 50.0) == said(32633, 15.0, 47.0) == ()
    (austria,) = said(31287, 15.0, 47.0)
    assert 'the datum MGI by PROJ\'s "MGI to WGS 84 (8)", accuracy 0.5 m: 83.92 m in plan, ' in austria
    (flat,) = said(31287, 15.0, 47.0, False)
    assert flat.endswith("heights unchanged")
    (nad83,) = said(6339, -122.0, 45.0)
    assert (
        nad83.startswith("positions of WGS 84 are used unchanged in the datum NAD83(2011), by")
        and "accuracy 2 m" in nad83
    )
    (britain,) = said(27700, -1.5, 52.0)
    # Where the grid is there, it is the way.
    assert "uk_os_OSTN15_NTv2_OSGBtoETRS.tif, which is not installed, gives 1 m" in britain or "(9)" in britain
    # A system of elsewhere.
    assert "errors of hundreds of metres" in said(31287, -60.0, -30.0)[0]


def test_longitudes_from_another_meridian_than_greenwich():
    # Austria GK West on MGI (Ferro), 17 degrees 40 minutes west of Greenwich.
    place = datum_change(31281, 10.5, 47.2).places(np.array([[10.5, 47.2, 600.0]]))
    (said,) = datum_change(31281, 10.5, 47.2).sentences(np.array([[10.5, 47.2, 600.0]]))
    assert re.search(r"1\.5 m: \d\d\.\d\d m in plan", said)
    assert place[0, 0] == pytest.approx(10.5 + 17 + 2 / 3, abs=0.01)
    np.testing.assert_allclose(wgs84_places(31281, place), [[10.5, 47.2, 600.0]], rtol=0, atol=1e-4)
