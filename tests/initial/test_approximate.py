import sys

import equinox as eqx
import numpy as np
import pytest

from jaxphoto.block import Motion
from jaxphoto.camera import Brown, InteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.georeferencing import Exposure, Mount, StripBias, recorded_attitude, sensor_position
from jaxphoto.initial.approximate import approximate
from jaxphoto.initial.resection import resect_ideal
from jaxphoto.observations import Attitudes, ImagePoints
from jaxphoto.rotation import roll_pitch_yaw_from_matrix
from tests.derivatives import compiled
from tests.initial.scene import Truth, block_of, coordinate_rows, strip, with_known


def all_of(names):
    return np.arange(len(names))


def assert_true(unknowns, truth, metres=1e-3, turn=1e-6):
    np.testing.assert_allclose(unknowns.exterior.position, truth.positions, rtol=0, atol=metres)
    np.testing.assert_allclose(unknowns.exterior.camera_from_object, truth.matrices, rtol=0, atol=turn)
    np.testing.assert_allclose(unknowns.points, truth.points, rtol=0, atol=metres)


def points_of_image(block, image):
    return np.unique(block.image_points.point[block.image_points.image == image])


def without_rows(block, drop):
    rows = block.image_points
    kept = ImagePoints(rows.image[~drop], rows.point[~drop], rows.xy[~drop], rows.sigma[~drop])
    return eqx.tree_at(lambda b: b.image_points, block, kept)


def test_what_is_known_is_handed_back_untouched():
    block, truth = strip()
    block = with_known(block, truth, all_of(block.images), all_of(block.points))
    assert approximate(block) is block.start.unknowns


def test_points_from_known_images():
    block, truth = strip()
    block = with_known(block, truth, all_of(block.images))
    assert_true(approximate(block), truth)


def test_images_from_known_points():
    block, truth = strip()
    block = with_known(block, truth, points=all_of(block.points))
    assert_true(approximate(block), truth)


def test_a_whole_strip_from_control_under_its_first_two_images():
    # Each further image waits until the points it shares have been intersected.
    block, truth = strip(n_images=6)
    shared = np.intersect1d(points_of_image(block, 0), points_of_image(block, 1))
    known = np.random.default_rng(1).permutation(shared)[:6]
    assert np.intersect1d(known, points_of_image(block, 4)).size == 0
    unknowns = approximate(with_known(block, truth, points=known))
    assert_true(unknowns, truth, metres=0.1, turn=1e-4)
    np.testing.assert_array_equal(np.asarray(unknowns.points)[known], truth.points[known])


def test_images_wait_until_they_see_many_known_points(monkeypatch):
    # At first image 2 sees a few points of image 0, all at its edge; they are more when its turn comes.
    block, truth = strip(n_images=6)
    used = []

    def recorded(c_mm, ideal, points, image):
        used.append((image, len(points)))
        return resect_ideal(c_mm, ideal, points, image)

    monkeypatch.setattr(sys.modules["jaxphoto.initial.approximate"], "resect_ideal", recorded)
    both = np.intersect1d(points_of_image(block, 0), points_of_image(block, 2))
    known = np.setdiff1d(points_of_image(block, 0), both[np.arange(len(both)) % 3 > 0])
    at_first = np.isin(points_of_image(block, 2), known).sum()
    assert 4 <= at_first < len(both), "image 2 has nothing to wait for"
    approximate(with_known(block, truth, points=known))
    assert [image for image, _ in used] == [f"i{k}" for k in range(6)]
    assert dict(used)["i2"] > at_first


def test_points_come_from_all_their_rays_in_the_end():
    block, truth = strip(noise_mm=0.02)
    first = approximate(with_known(block, truth, points=points_of_image(block, 0)))
    found = Truth(first.exterior.position, first.exterior.camera_from_object, np.array(first.points))
    again = approximate(with_known(block, found, all_of(block.images), points_of_image(block, 0)))
    np.testing.assert_allclose(again.points, first.points, rtol=0, atol=1e-6)


def test_with_measuring_errors_and_a_camera_without_its_distortion():
    block, truth = strip(noise_mm=0.004)
    block = eqx.tree_at(lambda b: b.start.unknowns.interior["kodak"].distortion, block, Brown())
    control = all_of(block.points)[::4]
    unknowns = approximate(with_known(block, truth, points=control))
    assert_true(unknowns, truth, metres=40.0, turn=0.05)
    assert np.abs(np.asarray(unknowns.points) - truth.points).max() > 0.1


def test_vertical_control_helps_a_point_seen_once():
    block, truth = strip()
    alone = points_of_image(block, 2)[0]
    rows = block.image_points
    block = without_rows(block, (rows.point == alone) & (rows.image != 2))
    block = with_known(block, truth, all_of(block.images))
    with pytest.raises(BlockError, match=rf"point p{alone} is measured in 1 image\(s\) and has no known coordinates"):
        approximate(block)
    height = coordinate_rows(truth.points, [alone], axes=[2])
    assert_true(approximate(eqx.tree_at(lambda b: b.control, block, height)), truth)


def test_fixed_coordinates_stay_exactly_as_given():
    block, truth = strip(noise_mm=0.01)
    block = with_known(block, truth, all_of(block.images))
    block = eqx.tree_at(lambda b: b.fixed, block, coordinate_rows(truth.points, [3, 5], axes=[0, 2]))
    points = np.asarray(approximate(block).points)
    np.testing.assert_array_equal(points[[3, 5]][:, [0, 2]], truth.points[[3, 5]][:, [0, 2]])
    assert (points[[3, 5], 1] != truth.points[[3, 5], 1]).all()


VELOCITY, RATE = np.array([60.0, -20.0, 1.0]), np.array([0.02, -0.03, 0.01])


@compiled
def observed(position, camera_from_object, mount, bias):
    exposure = Exposure(2.0, VELOCITY, RATE, mount.nominal)
    station = sensor_position(position, camera_from_object, mount, bias, exposure)
    return station, roll_pitch_yaw_from_matrix(recorded_attitude(camera_from_object, mount, exposure))


def test_stations_and_attitudes_orient_images_directly():
    block, truth = strip()
    n = len(block.images)
    mount = Mount(np.array([0.3, -0.2, 1.5]), np.array([0.01, -0.02, 0.015]), 0.05, "left")
    bias = StripBias(np.array([1.0, -2.0, 3.0]), np.array([0.1, 0.2, -0.1]))
    stations, attitudes = zip(
        *(observed(truth.positions[i], truth.matrices[i], mount, bias) for i in range(n)), strict=True
    )
    places = lambda b: (  # noqa: E731
        b.stations, b.attitudes, b.image_time, b.start.unknowns.mounts["default"], b.start.unknowns.strips["default"],
        b.motion,
    )  # fmt: skip
    rows = coordinate_rows(np.array(stations), all_of(block.images))
    angles = Attitudes(all_of(block.images), np.array(attitudes), np.full((n, 3), 1e-4))
    motion = Motion(np.tile(VELOCITY, (n, 1)), np.tile(RATE, (n, 1)))
    new = (rows, angles, np.full(n, 2.0), mount, bias, motion)
    assert_true(approximate(eqx.tree_at(places, block, new, is_leaf=lambda v: v is None)), truth)


def test_stations_alone_do_not_orient_an_image():
    block, truth = strip()
    rows = coordinate_rows(truth.positions, all_of(block.images))
    with pytest.raises(BlockError, match="6 of 6 images have no approximate orientation"):
        approximate(eqx.tree_at(lambda b: b.stations, block, rows))


def test_images_without_known_points_are_named():
    block, truth = strip(n_images=8)
    block = with_known(block, truth, points=points_of_image(block, 0)[:3])
    message = (
        r"8 of 8 images have no approximate orientation and see fewer than 4 known points, so they cannot be resected "
        r"\(i0, i1, i2, i3, i4, \.\.\.\): give their X_m, .* images\.csv, or measure more control points"
    )
    with pytest.raises(BlockError, match=message):
        approximate(block)


def test_known_points_on_a_line_are_named_with_their_image():
    block, truth = strip()
    row = np.abs(truth.points[:, 1]) < 1
    truth.points[row] = np.column_stack([truth.points[row, 0], np.zeros(row.sum()), np.zeros(row.sum())])
    on_line = np.intersect1d(np.flatnonzero(row), points_of_image(block, 1))
    assert len(on_line) >= 4
    with pytest.raises(BlockError, match=r"known points of image i\d lie on a line"):
        approximate(with_known(block, truth, points=on_line))


def test_nearly_parallel_rays_are_named():
    # Two exposures from almost one place: 0.1 m base at 1000 m is 0.006 degrees.
    block, truth = strip(n_images=2)
    rows = block.image_points
    once = rows.image == 0
    double = ImagePoints(
        np.concatenate([rows.image[once], rows.image[once] + 1]), np.tile(rows.point[once], 2),
        np.tile(rows.xy[once], (2, 1)), np.tile(rows.sigma[once], (2, 1)),
    )  # fmt: skip
    truth.positions[1], truth.matrices[1] = truth.positions[0] + [0.1, 0, 0], truth.matrices[0]
    block = eqx.tree_at(lambda b: b.image_points, block, double)
    others = np.setdiff1d(all_of(block.points), rows.point[once][:1])
    block = with_known(block, truth, [0, 1], others)
    with pytest.raises(BlockError, match=rf"rays of point p{rows.point[once][0]} from 2 images are nearly parallel"):
        approximate(block)


def test_a_point_behind_its_camera_is_named():
    block, truth = strip()
    block = with_known(block, truth, all_of(block.images), all_of(block.points))
    point = int(block.image_points.point[block.image_points.image == 3][0])
    wrong = block.start.unknowns.points.copy()
    wrong[point, 2] = 2000.0  # above the flight
    block = eqx.tree_at(lambda b: b.start.unknowns.points, block, wrong)
    with pytest.raises(BlockError, match=rf"point p{point} lies behind image i\d.*check the approximate angles"):
        approximate(block)


def test_control_above_the_flight_is_named_as_such():
    """Heights in feet: only the surveyed points lie behind the images."""
    block, truth = strip()
    block = with_known(block, truth, all_of(block.images), all_of(block.points))
    wrong = block.start.unknowns.points.copy()
    wrong[:3, 2] = 2000.0
    control = coordinate_rows(wrong, range(3), (2,))
    block = eqx.tree_at(lambda b: (b.start.unknowns.points, b.control), block, (wrong, control))
    with pytest.raises(BlockError, match=r"3 control points"):
        approximate(block)


def test_a_coordinate_that_is_not_a_number_is_not_in_front():
    block, truth = strip()
    block = with_known(block, truth, all_of(block.images), all_of(block.points))
    wrong = block.start.unknowns.points.copy()
    wrong[4] = np.nan
    with pytest.raises(BlockError, match="point p4 lies behind"):
        approximate(eqx.tree_at(lambda b: b.start.unknowns.points, block, wrong))


def test_attitude_observed_of_an_image_that_is_known_changes_nothing():
    block, truth = strip()
    block = with_known(block, truth, all_of(block.images))
    rows = coordinate_rows(truth.positions + 500.0, all_of(block.images))
    angles = Attitudes(all_of(block.images), np.ones((6, 3)), np.ones((6, 3)))
    block = eqx.tree_at(lambda b: (b.stations, b.attitudes), block, (rows, angles))
    assert_true(approximate(block), truth)


def test_real_block_of_21_photographs_from_four_control_points(data_dir):
    """DBAT's camcal: the four corners of a flat calibration sheet, c nominal and distortion unknown."""
    folder = data_dir / "camcal"
    rows = np.loadtxt(folder / "measurements" / "markpts.txt", delimiter=",", comments="#")
    names, point = np.unique(rows[:, 1], return_inverse=True)
    order = np.argsort(point, kind="stable")
    pixel = 5.43764 / 1704
    xy = (rows[order, 2:4] - [1136, 852]) * [pixel, -pixel]
    block = block_of(rows[order, 0].astype(int) - 1, point[order], xy, 21, len(names))
    nominal = InteriorOrientation(7.5, 0.0, 0.0, Brown())
    block = eqx.tree_at(lambda b: b.start.unknowns.interior["kodak"], block, nominal)
    sheet = np.loadtxt(folder / "reference" / "camcal-fixed.txt", delimiter=",", usecols=(0, 2, 3, 4), comments="#")
    truth = Truth(np.zeros((21, 3)), np.zeros((21, 3, 3)), np.zeros((len(names), 3)))
    control = np.searchsorted(names, sheet[:, 0])
    truth.points[control] = sheet[:, 1:]
    unknowns = approximate(with_known(block, truth, points=control))

    stations = np.loadtxt(folder / "result" / "camera_stations.txt", delimiter=",", usecols=(2, 3, 4), comments="#")
    off = np.linalg.norm(np.asarray(unknowns.exterior.position) - stations, axis=1)
    # The cameras stand about 2 m away; 100 px of distortion are 3 degrees.
    assert np.median(off) < 0.1
    assert off.max() < 0.3
    assert np.abs(np.asarray(unknowns.points)[:, 2]).max() < 0.2
