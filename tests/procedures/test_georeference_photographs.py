"""Georeferencing by recorded positions: truth recovered, blunders rejected, insufficient positions refused."""

import dataclasses

import equinox as eqx
import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from jaxphoto import adjust, covariance
from jaxphoto.errors import DatumError, InputError
from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.georeferencing.recorded_positions import Gps
from jaxphoto.procedures.georeference_photographs import (
    SIGMA_M,
    georeference_photographs,
    utm_of,
    with_fixed_datum,
)
from jaxphoto.rotation import matrix_from_omega_phi_kappa
from jaxphoto.variants import some_images
from tests.blocks import free_network, simulated

ORIGIN = (13.2, 55.7, 0.0)
TURN = np.asarray(matrix_from_omega_phi_kappa(np.array([0.4, -0.7, 2.1])))


def network():
    """A free network at its optimum in a frame and a scale of its own, and the truth."""
    truth = simulated("cross").truth
    block = free_network()
    unknowns = adjust(block, truth).unknowns
    away = lambda x: 0.01 * (np.asarray(x) - 300.0) @ TURN.T + 5.0  # noqa: E731
    matrices = np.asarray(unknowns.exterior.camera_from_object) @ TURN.T
    position = away(unknowns.exterior.position)
    exterior = dataclasses.replace(unknowns.exterior, position=position, camera_from_object=matrices)
    moved = dataclasses.replace(unknowns, exterior=exterior, points=away(unknowns.points))
    return eqx.tree_at(lambda b: b.start.unknowns, block, moved), truth


def recorded(positions, names, sigma=None):
    frame = MapFrame(utm_of(*ORIGIN[:2]), None, ORIGIN)
    places = frame.place(frame.map(np.asarray(positions, float)))
    return {name: Gps(lat, lon, height, sigma) for name, (lon, lat, height) in zip(names, places, strict=True)}


def test_the_block_is_where_its_photographs_were_taken():
    block, truth = network()
    rng = np.random.default_rng(2)
    position = np.asarray(truth.exterior.position)
    found = georeference_photographs(block, recorded(position + rng.normal(0, 0.5, position.shape), block.images))
    assert found.block.frame.code == utm_of(*ORIGIN[:2]) == 32633 and found.used.all()
    assert np.std(found.offsets_m) < 1.0
    np.testing.assert_allclose(found.block.stations.sigma[:3], SIGMA_M)
    a = adjust(found.block)
    assert bool(a.converged)
    # In the frame of the truth, by way of the map.
    own = found.block.frame.map
    back = MapFrame(own.code, None, ORIGIN).local(own.map(np.asarray(a.unknowns.exterior.position)))
    assert np.abs((back - position).mean(axis=0)).max() < 1.0
    turned = np.asarray(a.unknowns.exterior.camera_from_object) @ np.swapaxes(truth.exterior.camera_from_object, 1, 2)
    assert np.degrees(np.arccos((np.trace(turned, axis1=1, axis2=2) - 1) / 2)).max() < 0.5


def test_the_datum_of_the_map_is_that_of_its_coordinates():
    block, truth = network()
    positions = recorded(np.asarray(truth.exterior.position), block.images, (0.02, 0.02, 0.04))
    wgs84 = np.array([(g.longitude_deg, g.latitude_deg, g.altitude_m) for g in positions.values()])
    # RT90, which is 200 m from WGS 84 here.
    space = pyproj.Transformer.from_crs(4979, pyproj.CRS(3021).to_3d(), always_xy=True)
    for kind in ("ellipsoid", "unknown"):
        told = {n: g._replace(heights=kind) for n, g in positions.items()}
        found = georeference_photographs(block, told, 3021)
        expected = np.stack(space.transform(*wgs84.T), axis=1)
        if kind == "unknown":
            expected[:, 2] = wgs84[:, 2]
        stations = found.block.frame.map.map(np.asarray(found.block.stations.value).reshape(-1, 3))
        np.testing.assert_allclose(stations, expected, rtol=0, atol=1e-4)
        assert "from WGS 84 to the datum RT90" in found.sentences[0]


def test_blunders_of_positions_are_rejected():
    block, truth = network()
    position = np.array(truth.exterior.position)
    wrong = [2, 7]
    position[wrong] += [[40.0, -30.0, 10.0], [0.0, 0.0, 60.0]]
    found = georeference_photographs(block, recorded(position, block.images, (0.02, 0.02, 0.04)))
    assert np.flatnonzero(~found.used).tolist() == wrong
    named = [s for s in found.sentences if "differs by" in s]
    assert [block.images[k] in s for k, s in zip(wrong, named, strict=True)] == [True, True]
    assert set(np.asarray(found.block.stations.who)).isdisjoint(wrong)
    assert set(np.asarray(found.block.stations.sigma)) == {0.02, 0.04}


@pytest.mark.parametrize("stated", [(2.0, 2.0, 4.0), None])
def test_positions_within_their_standard_deviations_are_accepted(stated):
    """Corrected positions for most, metres for the rest: what is 2 m off of these is used, what is 60 m off is not."""
    block, truth = network()
    position = np.array(truth.exterior.position)
    position[[1, 3, 6]] += [[1.6, -1.1, 2.0], [-0.9, 1.4, -3.0], [60.0, 0.0, 0.0]]
    known = recorded(position, block.images, (0.02, 0.02, 0.04))
    rest = {block.images[k] for k in (1, 3, 6)}
    known |= {n: known[n]._replace(sigma_m=stated) for n in rest}
    found = georeference_photographs(block, known)
    assert np.flatnonzero(~found.used).tolist() == [6]
    assert np.median(np.abs(found.offsets_m)) < 0.3


def test_positions_that_hardly_determine_the_rotation_only_place_the_block():
    block, truth = network()
    position = np.asarray(truth.exterior.position)
    found = georeference_photographs(block, recorded(position, block.images, (50.0, 50.0, 50.0)))
    with pytest.raises(DatumError, match="nearly undetermined"):
        adjust(found.block)
    held = with_fixed_datum(found, block.datum)
    a = adjust(held.block)
    assert bool(a.converged) and held.block.frame.code == 32633 and not len(held.block.stations)
    own = held.block.frame.map
    back = MapFrame(own.code, None, ORIGIN).local(own.map(np.asarray(a.unknowns.exterior.position)))
    assert np.abs(back - position).max() < 2.0
    with pytest.raises(InputError, match="determine the rotation of the block only to"):
        georeference_photographs(block, recorded(position, block.images, (500.0,) * 3))


def test_mirrored_positions_are_refused():
    """As of a table whose X and Y have changed places: cameras that look up fit them as well as the true ones fit."""
    block, truth = network()
    mirrored = np.array(truth.exterior.position)[:, [1, 0, 2]]
    with pytest.raises(InputError, match="would look upwards"):
        georeference_photographs(block, recorded(mirrored, block.images))


def test_too_few_positions_and_those_on_a_line_are_refused():
    block, truth = network()
    known = recorded(np.asarray(truth.exterior.position), block.images)
    with pytest.raises(InputError, match="2 of 10 photographs have a position"):
        georeference_photographs(block, dict(list(known.items())[:2]))
    line = recorded(np.linspace([0, 0, 900], [500, 0, 900], len(block.images)), block.images)
    with pytest.raises(InputError, match="lie on a line"):
        georeference_photographs(block, line)
    with pytest.raises(InputError, match="EPSG code 99 is unknown"):
        georeference_photographs(block, known, 99)


def strip_attitudes(block, truth, rng, common_deg=0.0):
    """Attitudes of all images as their files would have them, the zero of the roll off by `common_deg`."""
    frame = MapFrame(utm_of(*ORIGIN[:2]), None, ORIGIN)
    level = frame.local_from_level(np.asarray(truth.exterior.position, float))
    off = np.concatenate([np.zeros((10, 1)), np.full((10, 1), common_deg), np.zeros((10, 1))], axis=1)
    noise = Rotation.from_rotvec(np.deg2rad(off + rng.normal(0, 0.3, (10, 3)))).as_matrix()
    own = np.swapaxes(level, 1, 2) @ np.swapaxes(np.asarray(truth.exterior.camera_from_object, float), 1, 2) @ noise
    return {n: CameraAttitude(m, (0.3, 0.3, 0.3)) for n, m in zip(block.images, own, strict=True)}


def turned_deg(found, truth):
    """Of each image, how far its attitude is from the truth; the frames of both are parallel to a thousandth."""
    apart = np.asarray(found.camera_from_object) @ np.swapaxes(np.asarray(truth.exterior.camera_from_object), 1, 2)
    return np.degrees(Rotation.from_matrix(apart).magnitude())


def of_one_strip(block, truth, rng):
    """Positions of the first strip, which runs east, by a receiver without corrections; one of them jumps."""
    position = np.asarray(truth.exterior.position) + rng.normal(0, 1.5, (10, 3))
    position[3, 1] += 90.0
    return recorded(position[:5], block.images[:5])


def test_a_single_strip_without_attitudes_is_refused():
    whole, truth = network()
    block = some_images(whole, np.arange(10) < 5)
    position = np.asarray(truth.exterior.position)[:5] + np.random.default_rng(3).normal(0, 2.0, (5, 3))
    with pytest.raises(InputError, match="Fly a cross strip, measure control points, or give attitudes"):
        georeference_photographs(block, recorded(position, block.images, (10.0, 10.0, 10.0)))


def test_a_single_strip_is_oriented_by_its_attitudes():
    block, truth = network()
    rng = np.random.default_rng(5)
    attitudes = strip_attitudes(block, truth, rng, common_deg=1.0)
    attitudes[block.images[1]] = CameraAttitude(np.eye(3)[[1, 0, 2]] * [1, 1, -1], (0.3, 0.3, 0.3))
    positions = of_one_strip(block, truth, rng)
    found = georeference_photographs(block, positions, attitudes=attitudes)
    assert np.asarray(found.block.attitudes.image).tolist() == [0, 2, 3, 4]
    assert found.used.tolist() == [True, True, True, False, True]
    # By what the attitudes have in common, and what four of them scatter.
    assert turned_deg(found.block.start.unknowns.exterior, truth).max() < 1.5
    assert any("attitudes are observed" in s for s in found.sentences)
    assert any("5 photographs without a position" in s for s in found.sentences)
    assert any(f"the attitudes of {block.images[1]} contradict the others" in s for s in found.sentences)
    two = {n: positions[n] for n in (block.images[0], block.images[2])}
    found = georeference_photographs(block, two, attitudes=attitudes)
    assert turned_deg(found.block.start.unknowns.exterior, truth).max() < 1.5


def test_attitudes_of_rotated_pictures_are_not_used():
    block, truth = network()
    rng = np.random.default_rng(5)
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    own = strip_attitudes(block, truth, rng, common_deg=1.0)
    attitudes = {n: a._replace(level_from_camera=a.level_from_camera @ turned) for n, a in own.items()}
    known = recorded(np.asarray(truth.exterior.position), block.images)
    found = georeference_photographs(block, known, attitudes=attitudes)
    assert any("contradict the positions" in s for s in found.sentences) and not len(found.block.attitudes)


@pytest.mark.slow
def test_positions_closer_than_their_precision_contradict_no_attitudes():
    """Two photographs taken 5 m apart, of which the second has its error north instead of east."""
    block, truth = network()
    position = np.asarray(truth.exterior.position)[[0, 0]] + [[0.0, 0.0, 0.0], [0.0, 5.0, 0.0]]
    attitudes = strip_attitudes(block, truth, np.random.default_rng(5))
    poor = recorded(position, block.images[:2])
    found = georeference_photographs(block, poor, attitudes=attitudes)
    assert turned_deg(found.block.start.unknowns.exterior, truth).max() < 1.5


def test_a_single_strip_is_adjusted_with_a_common_attitude_error():
    block, truth = network()
    rng = np.random.default_rng(5)
    attitudes = strip_attitudes(block, truth, rng, common_deg=2.0)
    found = georeference_photographs(block, of_one_strip(block, truth, rng), attitudes=attitudes)
    a = adjust(found.block)
    assert bool(a.converged) and 0.7 < a.sigma0 < 1.4
    assert turned_deg(a.unknowns.exterior, truth).max() < 2.5
    # What all have in common is found, and as unsure as positions and the prior leave it, not as four attitudes would.
    found = covariance(a)
    label = next(n for n in found.labels if "boresight_y" in n)
    sigma = np.degrees(found.shared_sigma[found.labels.index(label) - 6 * found.n_images])
    assert 0.5 < sigma < 2.1
    assert abs(np.degrees(a.unknowns.mounts["default"].boresight[1]) - 2.0) < 3 * sigma


def test_attitudes_beside_better_positions_are_compared_and_not_used():
    block, truth = network()
    rng = np.random.default_rng(6)
    known = recorded(np.asarray(truth.exterior.position), block.images, (0.02, 0.02, 0.04))
    found = georeference_photographs(block, known, attitudes=strip_attitudes(block, truth, rng, 1.0))
    assert not len(found.block.attitudes) and turned_deg(found.block.start.unknowns.exterior, truth).max() < 0.1
    (said,) = (s for s in found.sentences if "attitudes" in s)
    assert said.startswith("10 recorded attitudes agree") and said.endswith("not used")
    wrong = {n: CameraAttitude(Rotation.random(random_state=k).as_matrix()) for k, n in enumerate(block.images)}
    said = georeference_photographs(block, known, attitudes=wrong).sentences
    assert any("the attitudes of the files contradict the photographs" in s for s in said)
