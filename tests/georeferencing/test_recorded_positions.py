"""Positions as photographs record them: what cannot be, what is mended, and what heights are above."""

import numpy as np
import pytest
from pyproj import Geod

from jaxphoto.georeferencing.gps import Gps, moved
from jaxphoto.georeferencing.recorded_positions import one_height, plausible_positions

HERE = Gps(-15.75, -47.9, 1100.0)


def test_what_cannot_be_is_named_and_what_changed_places_is_changed_back():
    given = {f"{k}": HERE._replace(latitude_deg=-15.75 + k * 1e-4) for k in range(8)}
    swapped = Gps(HERE.longitude_deg, HERE.latitude_deg, 1100.0)
    given |= {"swapped": swapped, "zero": Gps(0.0, 0.0, 0.0), "far": Gps(48.1, 11.5, 500.0), "none": None}
    found, said = plausible_positions(given)
    assert found["swapped"] == HERE and found["3"] == given["3"]
    assert [n for n, g in found.items() if g is None] == ["zero", "far", "none"]
    for words in (
        "the positions of far are more than 50 km from the others",
        "latitude and longitude of swapped are swapped",
        "the positions of zero are (0, 0)",
        "1 of 12 photographs has no position (none)",
    ):
        assert sum(words in s for s in said) == 1, said
    assert plausible_positions({"a": HERE}) == ({"a": HERE}, [])


def test_all_latitudes_beyond_the_poles_are_longitudes():
    found, said = plausible_positions({f"{k}": Gps(139.7, 35.6 + k * 1e-4, 9.0) for k in range(3)})
    assert [g.longitude_deg for g in found.values()] == [139.7] * 3 and "3 photographs (0, 1, 2)" in said[0]


def test_heights_above_take_off_among_others_are_brought_to_them():
    above = {"a": 60.0, "b": 61.0, "c": 62.0, "d": 60.5}
    given = {n: HERE._replace(altitude_m=1040.0 + h) for n, h in above.items()}
    given["d"] = HERE._replace(altitude_m=60.5)
    found, said = one_height(given, above)
    assert [g.altitude_m for g in found.values()] == pytest.approx([1100.0, 1101.0, 1102.0, 1100.5])
    assert "the heights of d are above take-off: +1040.0 m is added" in said[1]
    assert "of unknown reference" in said[0]
    # All above take-off, or a flight from sea level: nothing to mend.
    for zero in (0.0, 2.0):
        plain = {n: HERE._replace(altitude_m=zero + h) for n, h in above.items()}
        assert one_height(plain, above)[0] == plain


def test_heights_of_two_kinds_are_joined_where_something_tells_how_far_they_are_apart():
    above = {"a": 60.0, "b": 61.0, "c": 62.0}
    given = {n: HERE._replace(altitude_m=1040.0 + h, heights="ellipsoid") for n, h in above.items()}
    given["c"] = HERE._replace(altitude_m=1075.0 + 62, heights="geoid")
    found, said = one_height(given, above)
    assert found["c"].altitude_m == pytest.approx(1102.0) and found["c"].heights == "ellipsoid"
    assert said[0] == "heights are above the ellipsoid" and "-35.0 m is added" in said[1]
    found, said = one_height(given, {})
    assert found["c"].altitude_m is None and found["a"] == given["a"] and "not used" in said[1]


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
