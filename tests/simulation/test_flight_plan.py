"""Overlaps, headings and heights are those given."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import IMAGE_X
from jaxphoto.io import recipe_from
from jaxphoto.simulation import FlightPlan, Footprint, Strip, Swaths
from tests.simulation.small import changed

bounded = settings(max_examples=60, deadline=None, derandomize=True, database=None)


def plan(changes) -> FlightPlan:
    return recipe_from(changed(changes)).plan


@bounded
@given(
    st.floats(0, 95), st.floats(0, 95), st.floats(-360, 180), st.floats(100, 4000), st.sampled_from(IMAGE_X),
    st.integers(2, 4),
)  # fmt: skip
def test_overlaps_are_achieved(forward, side, heading, height, image_x, count):
    strip = {"name": "S", "heading_deg": heading, "images": 5, "count": count, "along_m": 70.0}
    strips = plan(
        {
            "flight.strips": [strip],
            "flight.forward_overlap_percent": forward,
            "flight.side_overlap_percent": side,
            "flight.height_m": height,
            "mounts.default.image_x": image_x,
        }
    ).strips
    assert [s.name for s in strips] == [f"S{k + 1}" for k in range(count)]
    along, across = (36.0, 24.0) if image_x in ("forward", "back") else (24.0, 36.0)
    h = np.deg2rad(heading)
    ahead, right = np.array([np.sin(h), np.cos(h)]), np.array([np.cos(h), -np.sin(h)])
    for k, s in enumerate(strips):
        steps = np.diff(s.exposures, axis=0)
        base = (1 - forward / 100) * along * height / 34.25
        np.testing.assert_allclose(steps, np.tile((-1) ** k * base * ahead, (4, 1)), rtol=1e-9, atol=1e-9)
        assert s.height_m == height
    spacing = np.diff([s.exposures.mean(axis=0) for s in strips], axis=0)
    expected = (1 - side / 100) * across * height / 34.25 * right
    np.testing.assert_allclose(spacing, np.tile(expected, (count - 1, 1)), rtol=1e-9, atol=1e-9)
    off = np.mean([s.exposures for s in strips], axis=1) @ np.stack([ahead, right], axis=1)
    np.testing.assert_allclose(off[:, 0], 70, atol=1e-7)
    np.testing.assert_allclose(off[:, 1].mean(), 0, atol=1e-7)


def test_offsets_are_along_and_to_the_right():
    (strip,) = plan(
        {
            "flight.strips": [
                {"name": "E", "heading_deg": 90.0, "images": 3, "along_m": 5.0, "across_m": 7.0}
                | {"along_bases": 2.0, "across_spacings": 3.0, "base_m": 100.0, "spacing_m": 10.0}
            ],
            "flight.forward_overlap_percent": None,
        }
    ).strips
    # Flying east, right is south.
    np.testing.assert_allclose(strip.exposures, [[105, -37], [205, -37], [305, -37]], atol=1e-9)


def test_ground_sampling_distance_gives_the_height_and_a_strip_may_have_its_own():
    strips = plan(
        {
            "flight.height_m": None,
            "flight.gsd_m": 0.2,
            "flight.strips.1.gsd_m": 0.1,
            "flight.strips.2.height_m": 333.0,
            "flight.strips.2.base_m": 50.0,
        }
    ).strips
    assert strips[0].height_m == pytest.approx(0.2 * 34.25 / 0.008)
    assert strips[0].footprint.along == pytest.approx(0.2 * 4500)
    assert strips[1].base_m == pytest.approx(0.4 * 0.1 * 4500)
    assert (strips[2].height_m, strips[2].base_m) == (333.0, 50.0)


def test_swaths_end_where_they_should_and_are_filled_evenly():
    east = Strip("E", "c", 90.0, 3, 100.0, 1000.0, Footprint(80.0, 60.0))
    north = Strip("N", "c", 0.0, 3, 100.0, 1000.0, Footprint(80.0, 60.0), along_m=200.0)
    swaths = Swaths((east, north), across=0.5, ends=0.25)
    np.testing.assert_allclose(swaths.extent(np.eye(2)), [[-110, -15], [110, 310]], atol=1e-9)
    inside = np.array([[109, 14], [-109, -14], [14, 309], [14, 91]], float)
    outside = np.array([[111, 0], [0, -16], [16, 200], [0, 311]], float)
    assert swaths.contain(inside).all()
    assert not swaths.contain(outside).any()
    drawn = swaths.draw(np.random.default_rng(3), 20000)
    assert swaths.contain(drawn).all()
    # They touch without overlap beyond Y = 15 m, where the northern one starts at 90 m: equal areas.
    assert abs(np.mean(drawn[:, 1] > 50) - 0.5) < 4 * 0.5 / np.sqrt(20000)
    assert abs(np.mean(drawn[drawn[:, 1] < 50, 0] > 55) - 0.25) < 4 * 0.43 / np.sqrt(10000)


def test_swaths_without_ground_are_refused():
    lone = Strip("E", "c", 90.0, 1, 100.0, 1000.0, Footprint(80.0, 60.0))
    with pytest.raises(BlockError, match="no ground"):
        Swaths((lone,)).draw(np.random.default_rng(0), 1)
