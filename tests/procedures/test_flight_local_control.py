"""A flight with positions in degrees and control in a local system: one block in that system, and one sentence."""

import numpy as np
import pytest

from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.recorded_positions import Gps
from jaxphoto.initial.matches import MatchedPart
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints
from jaxphoto.procedures.flight import KnownOfFlight, calibrate_flight, flight_control
from tests.procedures.orientable import PIXEL, SENSOR, Camera, aerial, photographed, projected

LENS = Camera(8.0, 0.04, -0.03, 1e-4, -1e-6)
SURVEY_M, NOISE_PX = 0.01, 0.3


@pytest.fixture(scope="module")
def flown():
    """Eight photographs of rolling ground, nine of whose points are surveyed in its own frame and marked."""
    scene, rng = aerial(per_strip=4, seed=1), np.random.default_rng(5)
    seen = np.sum([projected(scene, LENS, k, scene.points)[1] for k in range(8)], axis=0)
    which = rng.permutation(np.flatnonzero(seen > 2))[:9]
    ids = tuple(f"P{k}" for k in which)
    image, point, pixels = [], [], []
    for k in range(8):
        xy, on = projected(scene, LENS, k, scene.points[which])
        image += [f"p{k:02}"] * on.sum()
        point += [ids[p] for p in np.flatnonzero(on)]
        pixels.append(SENSOR.px_from_mm(xy[on]) + NOISE_PX * rng.normal(size=(on.sum(), 2)))
    surveyed = scene.points[which] + SURVEY_M * rng.normal(size=(9, 3))
    sigma, check = np.full((9, 3), SURVEY_M), np.arange(9) > 6
    points = SurveyedPoints("site.csv", ids, surveyed, sigma, check, ids)
    n = len(image)
    marks = Marks(tuple(image), tuple(point), np.vstack(pixels), np.full(n, NOISE_PX), ("site.csv",) * n)
    positions = {f"p{k:02}": Gps(55.7 + 1e-5 * y, 13.2 + 1e-5 * x, z) for k, (x, y, z) in enumerate(scene.positions)}
    return scene, GivenControl(points, marks), positions


@pytest.mark.slow
def test_the_block_is_in_the_local_system_and_no_position_is_used(flown):
    scene, control, positions = flown
    given, code = flight_control(control, "local", positions, positions.values())
    assert code is None and given.local
    p = photographed(scene, LENS, NOISE_PX, 0.1)
    sigmas = [np.full(len(xy), NOISE_PX * PIXEL) for xy in p.features]
    part = MatchedPart(list(p.names), p.features, sigmas, p.matches, np.zeros((0, 3), int), 1.0)
    known = KnownOfFlight(positions, {}, code, given)
    (found,) = calibrate_flight(part, SENSOR, InteriorOrientation(8.1), known).parts
    assert found.placed is None and "control is in a local system" in found.why_not and not found.no_control
    block = found.adjusted.block
    assert block.frame.kind == "local" and not len(block.stations) and bool(found.adjusted.converged)
    assert found.controlled.state == ("control",) * 7 + ("check",) * 2
    # At its true place, not only of its true shape.
    true = scene.positions[[int(name[1:]) for name in block.images]]
    assert np.abs(np.asarray(found.adjusted.unknowns.exterior.position) - true).max() < 0.5
    assert np.nanmax(np.abs(found.controlled.off_m[7:])) < 0.1


def test_a_map_system_for_the_block_beside_it_is_refused(flown):
    _, control, positions = flown
    with pytest.raises(InputError, match=r"site.csv is in a local system, and EPSG:25832 is given for the block"):
        flight_control(control, "local", positions, positions.values(), code=25832)


def test_without_a_word_about_the_system_the_sentence_names_local(flown):
    _, control, positions = flown
    with pytest.raises(InputError, match=r"site.csv does not state the coordinate system .* \(or local, for Cartesian"):
        flight_control(control, None, positions, positions.values())
