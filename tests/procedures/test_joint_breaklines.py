"""Tie points that were measured on ridges of roofs lie on both faces that meet there."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import BlockError, InputError, read_block, write_block
from jaxphoto.georeferencing import StripSpline
from jaxphoto.io.text_tables import points_matching
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.observations import StripPlanes
from jaxphoto.procedures.lidar import Photographs, adjust_strips
from jaxphoto.procedures.lidar.photographs import check_photographs, on_trajectory
from jaxphoto.procedures.lidar.strip_search import StripSearch
from jaxphoto.procedures.lidar.tie_point_search import PointSearch
from tests.lidar.clouds import gable
from tests.procedures.joint import JOINT, flown, photographs
from tests.procedures.strips import PRIORS, SETTINGS
from tests.procedures.test_strip_control import COMMON, SHIFT, two_strips
from tests.simulation.small import made

COARSE = StripSettings(cell_m=2.0, roughness_m=0.04, returns=8)
# On ridges of the roofs of `two_strips`, which lie along Y.
RIDGES = np.array([[x, y] for x in (24.0, 40.0, 56.0, 72.0) for y in (10.0, 20.0, 30.0)])
FACE = np.array([[20.0, 20.0]])


def test_of_each_point_on_a_breakline_both_faces_are_sought_in_every_strip():
    search = StripSearch(two_strips(1), None, COARSE)
    search.corrected = [search.cloud.xyz[look.returns] for look in search.looks]
    # The last of those on breaklines lies on a face.
    xy = np.vstack([FACE, np.repeat(RIDGES, 2, axis=0), FACE, FACE])
    place = np.column_stack([xy, gable(*xy.T)]) + COMMON
    points = PointSearch(search, np.array([7]), np.arange(10, 11 + len(RIDGES)))
    np.testing.assert_array_equal(points.points, [7, *np.repeat(np.arange(10, 11 + len(RIDGES)), 2)])
    seen = points.look(place, np.zeros((len(place), 3, 3)), settled=False)
    for found, shift in zip(seen, (np.zeros(3), SHIFT), strict=True):
        np.testing.assert_array_equal(np.sort(found.found.point), np.arange(1 + 2 * len(RIDGES)))
        w = (found.found.gap + found.patches.normal[found.found.patch] @ shift) / found.found.sigma
        assert 0.6 < np.sqrt(np.mean(w**2)) < 1.5
    names = tuple(f"P{k}" for k in range(30))
    (sentence,) = points.unseen(seen, names)
    assert sentence.startswith("1 of 13 points on breaklines have no two smooth faces about them") and "P22" in sentence


def test_points_on_breaklines_are_named_by_patterns():
    assert points_matching(("A1", "R1", "R2", "B"), ["R*", "A1", "R1"], "") == ("R1", "R2", "A1")
    with pytest.raises(InputError, match=r"--breaklines X\*: no point of the block has this name"):
        points_matching(("A1",), ["X*"], "--breaklines")


def test_points_on_breaklines_come_back_with_their_block(tmp_path):
    flight = flown()
    names = flight.block.points[:3]
    on = Photographs(dataclasses.replace(flight.block, breaklines=names), photographs(flight).time)
    assert on.breaklines == names and on._replace(on_breaklines=names[1:]).breaklines == names[1:]
    spans = np.array([[on.time.min(), on.time.max()]])
    posed = on_trajectory(on, (StripSpline.over(0, *spans[0].tolist(), 5.0),), spans, SETTINGS)
    assert posed.breaklines == names
    # Of points that are gone nothing is said, in which it would not be read again.
    kept = dataclasses.replace(on.block, breaklines=(*names, "gone"))
    write_block(kept, tmp_path / "block")
    assert read_block(tmp_path / "block").breaklines == names
    settings = tmp_path / "block" / "block.toml"
    settings.write_text(settings.read_text().replace(f'"{names[0]}"', '"R*"', 1))
    with pytest.raises(InputError, match=r"block\.toml, breaklines: R\*: no point of the block has this name"):
        read_block(tmp_path / "block")


def test_the_block_of_a_joint_adjustment_is_not_joined_again():
    flight = flown()
    joined = dataclasses.replace(flight.block, more=(*flight.block.more, StripPlanes.none()))
    with pytest.raises(BlockError, match="that of a joint adjustment, with its planes in strip_planes"):
        check_photographs(photographs(flight)._replace(block=joined), flight.trajectory)


@pytest.mark.slow
def test_breaklines_tell_where_ridges_are():
    """The flight of `joint` over halls with ridges along the map's axes."""
    at = [[x, y] for x in (-100.0, 0.0, 100.0) for y in (-40.0, 60.0)]
    hall = {"roof": "gable", "length_m": 60.0, "width_m": 28.0, "slope_deg": 30.0}
    halls = [hall | {"at_m": at[k::2], "heading_deg": 90.0 * k} for k in range(2)]
    ends = [[x + s * k, y + s * (1 - k)] for k in range(2) for x, y in at[k::2] for s in (-15.0, 15.0)]
    flight = made(JOINT | {"terrain.buildings": halls, "targets": [{"role": "tie", "prefix": "R", "at_m": ends}]}, 5)
    given = photographs(flight)
    number = [k for k, name in enumerate(flight.block.points) if name.startswith("R")]
    assert len(number) > 8
    truth = np.asarray(flight.truth.points)[number]
    spread = {}
    for names in ((), tuple(flight.block.points[k] for k in number)):
        how = {"photographs": given._replace(on_breaklines=names), "max_rounds": 3}
        found = adjust_strips(flight.cloud, flight.trajectory, SETTINGS, PRIORS, **how)
        covariance = np.asarray(found.covariance.points)[number]
        off = np.asarray(found.adjusted.unknowns.points)[number] - truth
        spread[bool(names)] = np.sqrt(np.trace(covariance[:, :2, :2], axis1=1, axis2=2)).mean()
        assert float(found.adjusted.sigma0) == pytest.approx(1.0, abs=0.1) and not found.odd
        chi = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off)
        assert chi.mean() < 8
    assert spread[True] < 0.95 * spread[False]
