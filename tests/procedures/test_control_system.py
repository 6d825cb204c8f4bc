"""Systems of control: datums changed by PROJ, and what would fit where points lie far from the photographs."""

import numpy as np
import pytest
from pyproj import Transformer

from jaxphoto.errors import InputError
from jaxphoto.procedures.control.surveyed import SurveyedPoints, check_near, distance_m, places, system_of

PLACE = (13.2, 55.7)


def points(xyz, **more):
    xyz = np.array(xyz, float)
    n = len(xyz)
    names = tuple(f"P{k}" for k in range(n))
    return SurveyedPoints("survey.csv", names, xyz, np.full((n, 3), np.nan), np.zeros(n, bool), names, **more)


DEGREES = [(13.2001, 55.7002, 31.0), (13.2011, 55.7012, 33.0)]
UTM = [(*Transformer.from_crs(4326, 32633, always_xy=True).transform(*p[:2]), p[2]) for p in DEGREES]


@pytest.mark.parametrize(
    "words", ["EPSG:32633", "EPSG::32633", "WGS84 UTM 33N", "+proj=utm +zone=33 +datum=WGS84 +units=m +no_defs"]
)
def test_places_are_those_of_proj(words):
    np.testing.assert_allclose(places(points(UTM), system_of(words, "a"), 32633), DEGREES, atol=1e-9)


def test_a_height_that_is_not_known_is_that_of_the_others_and_one_must_be():
    some = [(*DEGREES[0][:2], np.nan), DEGREES[1]]
    assert places(points(some), system_of("4326", "a"), 32633)[0, 2] == pytest.approx(33.0)
    with pytest.raises(InputError, match="no point has a height"):
        places(points([(*DEGREES[0][:2], np.nan)]), system_of("4326", "a"), 32633)


def test_another_datum_is_changed():
    """RT90 is on Bessel's ellipsoid: the same place has other degrees there, by 100 m and more."""
    old = Transformer.from_crs(4326, 3021, always_xy=True)
    told = [(*old.transform(*p[:2]), p[2]) for p in DEGREES]
    found = places(points(told), system_of("3021", "a"), 32633)
    np.testing.assert_allclose(found[:, :2], np.array(DEGREES)[:, :2], atol=1e-7)


@pytest.mark.parametrize(
    ("xyz", "words", "said"),
    [
        ([(p[1], p[0], p[2]) for p in DEGREES], "4326", "first two coordinates exchanged"),
        ([(p[1], p[0], p[2]) for p in UTM], "32633", "first two coordinates exchanged"),
        (UTM, "32634", "correct the coordinates, or the system"),
        ([(x + 2e5, y, z) for x, y, z in UTM], "32633", "correct the coordinates, or the system"),
    ],
)
def test_points_far_away_are_refused_with_what_would_fit(xyz, words, said):
    with pytest.raises(InputError) as caught:
        check_near(points(xyz), system_of(words, "a"), *PLACE)
    assert said in str(caught.value), caught.value


def test_points_near_the_photographs_are_accepted():
    check_near(points(UTM), system_of("32633", "a"), *PLACE)


def test_distances_are_those_of_a_sphere():
    assert distance_m(np.array([[13.2, 55.7, 0.0]]), 13.2, 56.7) == pytest.approx(111.19e3, rel=1e-3)
    assert distance_m(np.array([[179.9, 0.0, 0.0]]), -179.9, 0.0) == pytest.approx(22.24e3, rel=1e-3)
