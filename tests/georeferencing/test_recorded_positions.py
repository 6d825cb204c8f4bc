"""Positions as photographs record them: what cannot be, what is mended, and what heights are above."""

import numpy as np
import pytest
from pyproj import Geod

from jaxphoto.georeferencing.recorded_positions import Gps, moved, one_height, plausible_positions

HERE = Gps(-15.75, -47.9, 1100.0)


def test_implausible_positions_are_named_and_not_used():
    given = {f"{k}": HERE._replace(latitude_deg=-15.75 + k * 1e-4) for k in range(8)}
    swapped = Gps(HERE.longitude_deg, HERE.latitude_deg, 1100.0)
    given |= {"swapped": swapped, "zero": Gps(0.0, 0.0, 0.0), "beyond": Gps(139.7, 35.6, 9.0), "none": None}
    found, said = plausible_positions(given)
    assert found["3"] == given["3"] and [n for n, g in found.items() if g is None] == list(given)[8:]
    for words in (
        "the positions of swapped are more than 50 km from the others",
        "the latitudes of beyond exceed 90 degrees",
        "the positions of zero are (0, 0)",
        "1 of 12 photographs has no position (none)",
    ):
        assert sum(words in s for s in said) == 1, said
    assert plausible_positions({"a": HERE}) == ({"a": HERE}, [])


def test_of_heights_of_two_kinds_the_more_frequent_are_used():
    given = {n: HERE._replace(heights="ellipsoid") for n in "ab"} | {"c": HERE._replace(heights="geoid")}
    found, said = one_height(given, {})
    assert found["c"].altitude_m is None and found["a"] == given["a"]
    assert said[0] == "heights are above the ellipsoid" and "--heights" in said[1]


def test_heights_that_are_wanted_or_said():
    above = {"a": 60.0, "b": None}
    given = dict.fromkeys(above, HERE)
    found, said = one_height(given, above, "take-off")
    assert (found["a"].altitude_m, found["b"].altitude_m) == (60.0, None)
    assert "above take-off" in said[0] and "b have no height above take-off" in said[1]
    found, said = one_height(given, {}, "take-off")
    assert found["a"] == HERE._replace(heights="take-off") and "no photograph has a height above take-off" in said[1]
    found, said = one_height(given, above, "geoid")
    assert found["b"] == HERE._replace(heights="geoid") and "above a geoid" in said[0]


def test_a_lever_arm_moves_a_position_by_its_length():
    at = moved(HERE, np.array([0.3, -0.4, 1.2]))
    ends = (HERE.longitude_deg, HERE.latitude_deg, at.longitude_deg, at.latitude_deg)
    azimuth, _, length = Geod(ellps="WGS84").inv(*ends)
    assert (length, at.altitude_m) == pytest.approx((0.5, 1101.2), abs=1e-6)
    assert azimuth == pytest.approx(np.degrees(np.arctan2(0.3, -0.4)), abs=1e-4)
