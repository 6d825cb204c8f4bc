"""Blocks of which nothing is known but image points: oriented, and brought to the frame of what is known."""

import dataclasses

import numpy as np
import pytest

from jaxphoto.block import Start
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.initial.approximate import completed
from jaxphoto.observations import CameraPositions, ControlCoordinates, ImagePoints
from jaxphoto.procedures.adjust import _reached, adjust, start_of
from jaxphoto.procedures.orientation import orient_block
from jaxphoto.procedures.orientation.orient_photographs import freed
from tests.formulas import camera_from_object
from tests.procedures.orientable import Camera, aerial, block_of, convergent, photographed, true_network

pytest.importorskip("pycolmap", reason="pycolmap, which orients images, is not installed (extra photos)")

PLAIN = Camera(8.0, 0.0, 0.0, 0.0, 0.0)


def needs_orientation(block):
    """Resection and intersection do not suffice."""
    return not _reached(block)[1]


def unknown_block(scene, held=True):
    """Image points of the scene by a known camera, and the true point of each of the block."""
    p = photographed(scene, PLAIN, 0.3, clutter=0, found=1.0)
    network, of_row = true_network(p)
    block = block_of(p, network)
    n, n_points = len(block.images), len(block.points)
    exterior = ExteriorOrientation(np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)))
    unknowns = dataclasses.replace(block.start.unknowns, exterior=exterior, points=np.zeros((n_points, 3)))
    block = dataclasses.replace(block, start=Start(unknowns, np.zeros(n, bool), np.zeros(n_points, bool)))
    if held:
        interior = {"camera": freed(block.priors.interior["camera"], ())}
        block = dataclasses.replace(block, priors=dataclasses.replace(block.priors, interior=interior))
    true = np.zeros(len(block.points), int)
    true[network.point] = of_row
    return block, true


def with_control(block, true, scene, which):
    """The true coordinates of the points `which` as control."""
    points = np.array(block.start.unknowns.points)
    points[which] = scene.points[true[which]]
    known = np.zeros(len(points), bool)
    known[which] = True
    unknowns = dataclasses.replace(block.start.unknowns, points=points)
    rows = ControlCoordinates(
        np.repeat(which, 3), np.tile(np.arange(3), len(which)), points[which].ravel(), np.full(3 * len(which), 0.01)
    )
    return dataclasses.replace(block, control=rows, start=Start(unknowns, block.start.image_known, known))


@pytest.fixture(scope="module")
def scene():
    return convergent(n_images=5, n_points=80)


@pytest.fixture(scope="module")
def oriented(scene):
    block, true = unknown_block(scene)
    block = with_control(block, true, scene, np.array([0, 20, 45]))
    return orient_block(block), true


def test_a_block_comes_to_the_frame_of_three_control_points(scene, oriented):
    block, true = oriented
    assert block.start.image_known.all()
    assert block.start.point_known.all()
    exterior = block.start.unknowns.exterior
    # The three points are known to 0.3 px of 1 mm at the object, of a field of 6 m; stations are 8 m away.
    np.testing.assert_allclose(exterior.position, scene.positions, rtol=0, atol=0.02)
    np.testing.assert_allclose(exterior.camera_from_object, scene.matrices, rtol=0, atol=2e-3)
    np.testing.assert_allclose(block.start.unknowns.points, scene.points[true], rtol=0, atol=0.02)
    assert len(block.control.who) == 9


def test_known_points_stay_as_they_are(scene, oriented):
    block, true = oriented
    which = [0, 20, 45]
    np.testing.assert_array_equal(np.asarray(block.start.unknowns.points)[which], scene.points[true[which]])


def test_an_adjustment_begins_with_it(scene):
    block, true = unknown_block(scene)
    start = start_of(with_control(block, true, scene, np.array([0, 20, 45])))
    np.testing.assert_allclose(start.exterior.position, scene.positions, rtol=0, atol=0.02)
    np.testing.assert_allclose(start.points, scene.points[true], rtol=0, atol=0.02)


def test_what_can_be_resected_needs_no_orientation(scene):
    block, true = unknown_block(scene)
    assert needs_orientation(block)
    assert needs_orientation(with_control(block, true, scene, np.array([0, 20, 45])))
    assert not needs_orientation(with_control(block, true, scene, np.arange(20)))
    assert needs_orientation(with_known_images(block, scene, [2]))
    assert not needs_orientation(with_known_images(block, scene, [1, 2]))


@pytest.fixture(scope="module")
def flown():
    """Ten images of two strips, and four control points that no two images see all."""
    scene = aerial(per_image=120, crab_deg=0.0)
    block, true = unknown_block(scene)
    corners = scene.points[true][:, :2] @ np.array([[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])
    return scene, block, true, np.unique(np.argmax(corners, axis=0))


def with_known_images(block, scene, which, off_m=0.0, off_rad=0.0):
    """The images `which` known, wrongly by so much."""
    rng = np.random.default_rng(0)
    known = np.isin(np.arange(len(block.images)), which)
    positions = scene.positions + off_m * rng.normal(size=scene.positions.shape)
    turned = np.stack([camera_from_object(*a) for a in off_rad * rng.normal(size=(len(known), 3))])
    exterior = ExteriorOrientation(
        np.where(known[:, None], positions, 0.0), np.where(known[:, None, None], turned @ scene.matrices, np.eye(3))
    )
    unknowns = dataclasses.replace(block.start.unknowns, exterior=exterior)
    return dataclasses.replace(block, start=Start(unknowns, known, block.start.point_known))


def with_stations(block, scene, which):
    """Stations observed by GNSS to 5 cm, no angles."""
    noise = 0.05 * np.random.default_rng(1).normal(size=(len(which), 3))
    n = len(which)
    rows = CameraPositions(
        np.repeat(which, 3), np.tile(np.arange(3), n), (scene.positions[which] + noise).ravel(), np.full(3 * n, 0.05)
    )
    return dataclasses.replace(block, stations=rows)


def largest_errors(start, scene):
    """Of stations (m) and rotations (rad)."""
    exterior = start.exterior
    turned = np.einsum("nij,nkj->nik", exterior.camera_from_object, scene.matrices)
    angle = 2 * np.arcsin(np.linalg.norm(turned - np.eye(3), axis=(1, 2)) / np.sqrt(8))
    return np.linalg.norm(exterior.position - scene.positions, axis=1).max(), angle.max()


@pytest.mark.parametrize(
    ("images", "control", "stations"),
    [
        (range(10), False, ()),
        (range(0, 10, 2), False, ()),
        ((0, 1), False, ()),
        ((0, 9), False, ()),
        ((3,), True, ()),
        ((), True, ()),
        ((), False, range(10)),
        ((), False, (0, 4, 5)),
        ((4,), False, (0, 1, 2)),
    ],
    ids=["all", "half", "two", "ends", "one, control", "control", "GNSS", "GNSS of three", "one, GNSS on a line"],
)
def test_whatever_is_known_gives_a_start(flown, images, control, stations):
    scene, block, true, corners = flown
    block = with_control(block, true, scene, corners) if control else block
    block = with_stations(block, scene, np.array(stations, int)) if len(stations) else block
    block = with_known_images(block, scene, np.array(images, int), 0.05, 5e-4)
    start = start_of(block)
    metres, radians = largest_errors(start, scene)
    # From 100 m, 0.3 px is 2 cm; over a strip of five images this sums up to some decimetres.
    assert metres < 2.0, metres
    assert radians < 0.02, radians
    given = np.array(images, int)
    exterior, known = start.exterior, block.start.unknowns.exterior
    np.testing.assert_array_equal(np.asarray(exterior.position)[given], np.asarray(known.position)[given])
    apart = np.linalg.norm(start.points - scene.points[true], axis=1)
    assert np.median(apart) < 1.0


def test_few_images_known_roughly_lead_to_the_same_adjustment(flown):
    scene, block, true, corners = flown
    block = with_control(block, true, scene, corners)
    # 3 m and 3.4 degrees: resections from points that these intersect would lead others astray.
    rough = with_known_images(block, scene, [0, 1], 3.0, 0.06)
    assert largest_errors(completed(rough).unknowns, scene)[0] > 20.0
    assert largest_errors(start_of(rough), scene)[0] < 8.0
    adjusted = adjust(rough)
    assert bool(adjusted.converged)
    assert 0.9 < float(adjusted.sigma0) < 1.1
    best = adjust(with_known_images(block, scene, np.arange(10)))
    np.testing.assert_allclose(adjusted.unknowns.exterior.position, best.unknowns.exterior.position, rtol=0, atol=1e-5)
    assert largest_errors(adjusted.unknowns, scene)[0] < 1.0


def test_images_beyond_reach_are_named(flown):
    scene, block, _, _ = flown
    rows = block.image_points
    # Points of one strip only: the other has no tie to it.
    first = np.isin(np.arange(len(block.points)), rows.point[rows.image < 5])
    second = np.isin(np.arange(len(block.points)), rows.point[rows.image >= 5])
    block = with_known_images(block, scene, [0, 1])
    kept = ~(first & second)[rows.point]
    cut = ImagePoints(*(np.asarray(v)[kept] for v in (rows.image, rows.point, rows.xy, rows.sigma)))
    with pytest.raises(BlockError, match=r"5 of 10 images have .* \(p05, p06, p07, p08, p09\).*2 groups"):
        start_of(dataclasses.replace(block, image_points=cut))


def test_images_that_see_nothing_in_common_are_refused(scene):
    block, _ = unknown_block(scene)
    rows = block.image_points
    kept = rows.image == rows.point % 5
    rows = dataclasses.replace(
        rows, image=rows.image[kept], point=rows.point[kept], xy=rows.xy[kept], sigma=rows.sigma[kept]
    )
    with pytest.raises(BlockError, match="no two of the 5 images can be oriented to one another"):
        orient_block(dataclasses.replace(block, image_points=rows))
