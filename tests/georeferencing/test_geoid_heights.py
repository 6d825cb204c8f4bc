"""Heights above a geoid, brought to the ellipsoid by a grid of PROJ: a made one, as no grids are in the package."""

import dataclasses
import os
import struct

import numpy as np
import pytest
import typer
from pyproj import datadir

from jaxphoto.errors import InputError
from jaxphoto.georeferencing import map_frame
from jaxphoto.georeferencing.recorded_positions import Gps, one_height
from jaxphoto.procedures.control.control_block import in_frame
from jaxphoto.procedures.georeference_photographs import georeference_photographs
from jaxphoto_command.photographs import height_reference
from tests.procedures.controlled import CODE, marked_block
from tests.procedures.test_georeference_photographs import network, recorded

EGM96, GRID = 5773, "us_nga_egm96_15.tif"
FOLDERS = [f for f in (*datadir.get_data_dir().split(os.pathsep), datadir.get_user_data_dir()) if os.path.isdir(f)]
HERE = Gps(55.7, 13.3, 100.0)
# 30 m at 55 N, 13 E, and as steep as a plane of the grid keeps exactly.
UNDULATION_M = 30 + 0.5 * 0.7 + 0.25 * 0.3


@pytest.fixture
def geoid(tmp_path):
    """The grid of EGM96 under the name that PROJ looks for, from 50 N, 5 E to 60 N, 20 E: NOAA's GTX, big-endian."""
    latitude, longitude = np.meshgrid(np.arange(50, 61.0), np.arange(5, 21.0), indexing="ij")
    n = (30 + 0.5 * (latitude - 55) + 0.25 * (longitude - 13)).astype(">f4")
    (tmp_path / "egm96_15.gtx").write_bytes(struct.pack(">4d2i", 50, 5, 1, 1, *n.shape) + n.tobytes())
    before = datadir.get_data_dir()
    datadir.append_data_dir(str(tmp_path))
    map_frame._to_place.cache_clear()
    yield
    datadir.set_data_dir(before)
    map_frame._to_place.cache_clear()


def test_the_geoid_is_added_to_what_is_not_above_the_ellipsoid(geoid):
    given = {"a": HERE, "b": HERE._replace(heights="geoid"), "c": HERE._replace(heights="ellipsoid"), "d": None}
    found, said = one_height(given, {}, EGM96)
    assert [g and g.altitude_m for g in found.values()] == pytest.approx([100 + UNDULATION_M] * 2 + [100.0, None])
    assert {g.heights for g in found.values() if g} == {"ellipsoid"} and said[0] == "heights are above the ellipsoid"
    assert said[1:] == [
        f"the heights of 2 photographs are interpreted as EPSG:5773; its geoid, {UNDULATION_M:+.2f} to "
        f"{UNDULATION_M:+.2f} m, is added"
    ]
    assert "all heights in the files are ellipsoidal" in one_height({"c": given["c"]}, {}, EGM96)[1][1]


def test_a_block_has_heights_above_the_geoid_in_its_files(geoid):
    block, truth = network()
    known = recorded(truth.exterior.position, block.images)
    above, plain = (georeference_photographs(block, known, vertical=code) for code in (EGM96, None))
    assert "map system EPSG:32633+5773" in above.sentences[0]
    position = above.block.start.unknowns.exterior.position
    np.testing.assert_allclose(position, plain.block.start.unknowns.exterior.position, atol=1e-9)
    lower = plain.block.frame.map.map(np.asarray(position)) - above.block.frame.map.map(np.asarray(position))
    east, north, up = lower.T
    assert np.abs([east, north]).max() < 1e-6 and np.abs(up - 30.4).max() < 0.1


def test_a_block_that_control_places_has_the_heights_that_are_asked_for(geoid):
    """The places are the same as without; a block that has a map system keeps it."""
    made = marked_block()
    plain, above = (in_frame(made.block, made.control.points, None, CODE, code) for code in (None, EGM96))
    assert (above.frame.code, above.frame.vertical) == (CODE, EGM96)
    np.testing.assert_allclose(above.xyz, plain.xyz, atol=1e-9)
    lower = plain.frame.map.map(plain.xyz) - above.frame.map.map(plain.xyz)
    assert np.abs(lower[:, :2]).max() < 1e-6 and np.abs(lower[:, 2] - 30.4).max() < 0.1
    placed = dataclasses.replace(made.block, frame=plain.frame)
    assert in_frame(placed, made.control.points, None, None, EGM96).frame.vertical == EGM96
    with pytest.raises(InputError, match=f"the block is in EPSG:{CODE} already, and EPSG:25832 is given"):
        in_frame(placed, made.control.points, None, 25832)


def test_a_place_that_the_geoid_does_not_reach_is_named(geoid):
    with pytest.raises(InputError, match=r"EPSG:5773 does not cover the photograph 'far' at 13.3000, 20.0000 degrees"):
        one_height({"a": HERE, "far": HERE._replace(latitude_deg=20.0)}, {}, EGM96)


@pytest.mark.skipif(any(GRID in os.listdir(folder) for folder in FOLDERS), reason="PROJ has the grid here")
def test_a_geoid_that_is_not_here_is_refused_with_how_to_get_it():
    with pytest.raises(InputError, match=rf'geoid {GRID}, which is not installed; get it by "pyproj sync'):
        one_height({"a": HERE}, {}, EGM96)


def test_without_any_height_none_is_said_to_be_right(geoid):
    given = {"a": None, "b": HERE._replace(altitude_m=None)}
    assert "no photograph has one" in one_height(given, {}, EGM96)[1][-1]


def test_a_code_that_is_none_is_refused():
    with pytest.raises(InputError, match="EPSG code 99999 is unknown; correct it, or give ellipsoidal heights"):
        one_height({"a": HERE}, {}, 99999)


def test_a_code_of_no_heights_is_refused():
    with pytest.raises(InputError, match=r"EPSG:25832 .* is not a vertical CRS"):
        one_height({"a": HERE._replace(heights="ellipsoid")}, {}, 25832)


def test_what_the_option_takes():
    values = [height_reference(text) for text in ("take-off", "5773", "EPSG:7837", None)]
    assert values == ["take-off", 5773, 7837, None]
    with pytest.raises(typer.BadParameter, match="--heights sea: give ellipsoid, geoid, take-off"):
        height_reference("sea")
