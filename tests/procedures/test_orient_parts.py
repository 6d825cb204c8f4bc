"""Parts of an orientation by themselves: meeting points, two steps, what a camera needs, the frame of known points."""

import dataclasses

import numpy as np
import pytest

from jaxphoto.block import Start
from jaxphoto.camera import InteriorOrientation, Smac
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.initial.matches import tracks
from jaxphoto.observations import CameraPositions, Distances
from jaxphoto.procedures.orientation.depths import supported
from jaxphoto.procedures.orientation.finish import _open
from jaxphoto.procedures.orientation.growing import _starts, _worth
from jaxphoto.procedures.orientation.network import Fate, empty_network, meet, misfits, sight_of
from jaxphoto.procedures.orientation.onto_known import onto_known, similarity_between
from jaxphoto.procedures.orientation.orient_photographs import _block_of
from jaxphoto.procedures.orientation.refine import _at_corner
from jaxphoto.procedures.orientation.related_pairs import Pair
from jaxphoto.procedures.orientation.two_steps import two_steps
from tests.formulas import camera_from_object
from tests.procedures.orientable import (
    PIXEL,
    SENSOR,
    Camera,
    Scene,
    aerial,
    convergent,
    photographed,
    with_epipolar_matches,
)

PLAIN = Camera(8.0, 0.0, 0.0, 0.0, 0.0)


def network_of(scene, noise_px=0.0, false=0):
    """A network at the truth, of exact images, its points not met yet; its block, its rays, and true points of rows.

    `false` matches of each pair lie along epipolar lines; their points are -1.
    """
    p = with_epipolar_matches(photographed(scene, PLAIN, noise_px, clutter=0, found=1.0), false, noise_px)
    sigmas = [np.full(len(xy), 0.3 * PIXEL) for xy in p.features]
    found = tracks([len(xy) for xy in p.features], p.matches)
    block = _block_of("scene", p.names, SENSOR, InteriorOrientation(8.0), p.features, sigmas, found)
    true = np.array([p.point_of[i][f] for i, f in zip(found.image, found.feature, strict=True)])
    network = empty_network(block)._replace(
        positions=scene.positions.copy(), camera_from_object=scene.matrices.copy(), oriented=np.ones(len(p.names), bool)
    )
    return block, network, sight_of(block, network.interior), true


def pair_of(scene, i, j, n=100):
    """The true relative orientation of two images."""
    base = scene.matrices[i] @ (scene.positions[j] - scene.positions[i])
    rotation = scene.matrices[j] @ scene.matrices[i].T
    return Pair(i, j, rotation, base / np.linalg.norm(base), n, 0.3)


@pytest.mark.parametrize("r0_mm", [0.0, 4.9, 5.0, 5.1])
def test_radial_terms_move_the_image_whatever_the_balance_radius(r0_mm):
    """The corner is at 5 mm: k1 moves it, or what lies within, by a good part of 125 mm."""
    moved = _at_corner(InteriorOrientation(8.0, distortion=Smac(r0=r0_mm)), "k1", np.array([4.0, 3.0]))
    assert 40 < moved < 130


def test_points_meet_where_they_are():
    scene = convergent(5, 60)
    _, network, sight, true = network_of(scene)
    met = meet(sight, network, 4.0, np.deg2rad(1.5))
    assert met.used.all()
    np.testing.assert_allclose(met.points[sight.point], scene.points[true], rtol=0, atol=1e-9)
    assert misfits(sight, met, np.arange(len(true))).max() < 1e-6


def test_wrong_rays_are_left_out_and_others_stay():
    scene = convergent(6, 60)
    block, network, _, true = network_of(scene)
    rows = block.image_points
    often = np.flatnonzero(np.bincount(rows.point) >= 4)[::3]
    wrong = np.array([np.flatnonzero(rows.point == p)[1] for p in often])
    xy = np.array(rows.xy)
    xy[wrong] += [30 * PIXEL, -20 * PIXEL]
    block = dataclasses.replace(block, image_points=dataclasses.replace(rows, xy=xy))
    sight = sight_of(block, network.interior)
    met = meet(sight, network, 4.0, np.deg2rad(1.5))
    np.testing.assert_array_equal(np.flatnonzero(met.fate == Fate.BEYOND), np.sort(wrong))
    np.testing.assert_allclose(met.points[sight.point], scene.points[true], rtol=0, atol=1e-9)


def test_narrow_rays_and_lone_ones_make_no_point():
    scene = convergent(5, 40)
    near = scene.positions[0] + [0.02, 0.0, 0.0]
    two = Scene(np.stack([scene.positions[0], near]), scene.matrices[[0, 0]], scene.points)
    _, network, sight, _ = network_of(two)
    assert (meet(sight, network, 4.0, np.deg2rad(1.5)).fate == Fate.SMALL_ANGLE).all()
    assert meet(sight, network, 4.0, np.deg2rad(0.01)).used.all()
    alone = meet(sight, network.without_image(1), 4.0, np.deg2rad(0.01))
    assert set(alone.fate) == {Fate.TOO_FEW, Fate.UNORIENTED}


def stepped(scene, height=15.0):
    """The scene with blocks of houses, 12 m wide, of up to so many metres."""
    x, y = np.floor(scene.points[:, :2] / 12).astype(int).T
    houses = height * np.random.default_rng(0).random((200, 200))[x % 200, y % 200] * ((x + y) % 2)
    return scene._replace(points=scene.points + np.column_stack([0 * houses, 0 * houses, houses]))


DEPTHS = {
    "flat": aerial(relief=0.0),
    "hills": aerial(relief=40.0),
    "houses": stepped(aerial()),
    "a heap": convergent(6, 300),
}


@pytest.mark.parametrize("which", DEPTHS)
def test_points_of_two_rays_go_where_nothing_else_is(which):
    """Hardly a true one, whatever the relief; false ones the more, the less the depths of neighbours differ."""
    _, network, sight, true = network_of(DEPTHS[which], 0.3, false=4)
    met = meet(sight, network, 4.0, np.deg2rad(1.5))
    left = supported(sight, met)
    gone = met.used & ~left.used
    two = met.used & (np.bincount(sight.point[met.used], minlength=len(met.points))[sight.point] == 2)
    assert not (gone & ~two).any()
    assert (left.fate[gone] == Fate.UNSUPPORTED).all()
    false, right = two & (true < 0), two & (true >= 0)
    assert gone[right].mean() < 0.02
    assert gone[false].mean() > {"flat": 0.9, "hills": 0.15, "houses": 0.15, "a heap": -1}[which]


@pytest.mark.parametrize("turned", [False, True], ids=["from", "to"])
def test_two_steps_give_rotation_and_position(turned):
    scene = convergent(5, 40)
    _, network, sight, _ = network_of(scene)
    network = network.without_image(4)
    ends = [(4, i) if turned else (i, 4) for i in range(3)]
    placed = two_steps(4, [pair_of(scene, *e) for e in ends], network, sight)
    np.testing.assert_allclose(placed.position, scene.positions[4], rtol=0, atol=1e-9)
    np.testing.assert_allclose(placed.camera_from_object, scene.matrices[4], rtol=0, atol=1e-9)


def test_a_false_pair_does_not_spoil_two_steps():
    scene = convergent(5, 40)
    _, network, sight, _ = network_of(scene)
    pairs = [pair_of(scene, i, 4) for i in range(3)]
    false = pair_of(scene, 3, 4)._replace(second_from_first=np.asarray(camera_from_object(0.4, 0.2, 1.0)))
    placed = two_steps(4, [false, *pairs], network.without_image(4), sight)
    np.testing.assert_allclose(placed.position, scene.positions[4], rtol=0, atol=1e-9)


def test_of_two_orientations_of_a_pair_one_counts():
    """The other, from the same place, would have the lines meet there."""
    scene = convergent(5, 60)
    _, network, sight, _ = network_of(scene)
    network = meet(sight, network.without_image(4), 4.0, np.deg2rad(0.5))
    true = pair_of(scene, 0, 4)
    turn = np.asarray(camera_from_object(0.03, -0.02, 0.01))
    other = true._replace(second_from_first=turn @ true.second_from_first, base=np.asarray(turn) @ true.base)
    for pairs in ([true, other], [other, true, pair_of(scene, 1, 4)]):
        placed = two_steps(4, pairs, network, sight)
        np.testing.assert_allclose(placed.position, scene.positions[4], rtol=0, atol=0.05)
    np.testing.assert_allclose(placed.camera_from_object, scene.matrices[4], rtol=0, atol=0.03)


def test_it_begins_with_the_orientation_that_the_triplet_bears_out():
    scene = convergent(4, 40)
    pairs = [pair_of(scene, i, j, 100) for i in range(4) for j in range(i + 1, 4)]
    wrong = pairs[0]._replace(second_from_first=np.asarray(camera_from_object(0.3, 0.2, 0.1)), n=150)
    assert _worth(wrong) == max(map(_worth, [wrong, *pairs]))
    assert next(_starts([wrong, *pairs]))[0] is not wrong


def test_on_a_line_the_points_give_the_scale():
    rng = np.random.default_rng(3)
    positions = np.array([[0.0, 0, 0], [0, 1, 0], [0, 2.3, 0]])
    matrices = np.stack([camera_from_object(np.pi / 2, 0.0, 0.02 * k) for k in range(3)])
    points = rng.uniform([-4, 6, -3], [4, 14, 3], (80, 3))
    scene = Scene(positions, matrices, points)
    _, network, sight, _ = network_of(scene)
    network = meet(sight, network.without_image(2), 4.0, np.deg2rad(0.5))
    placed = two_steps(2, [pair_of(scene, 0, 2), pair_of(scene, 1, 2)], network, sight)
    np.testing.assert_allclose(placed.position, positions[2], rtol=0, atol=1e-6)


def test_without_a_pair_there_are_no_two_steps():
    scene = convergent(4, 40)
    _, network, sight, _ = network_of(scene)
    assert two_steps(3, [pair_of(scene, 0, 1)], network.without_image(3), sight) is None


def test_observed_parameters_change_the_others_as_a_new_adjustment_would():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(60, 4)) @ (np.eye(4) + 0.5 * rng.normal(size=(4, 4)))
    a[:, 3] = a[:, 2] + 0.02 * rng.normal(size=60)  # two that are hardly told apart
    a[:, 1] *= 0.05  # one that is hardly told
    names, observed, hardly = ("k1", "k2", "p1", "p2"), np.full(4, 0.1), np.full(4, 1.0)
    found = _open(names, a.T @ a / 0.1**2, observed, hardly)
    # The same by adjusting anew, the one told least observed each time.
    known: dict[int, float] = {}
    while True:
        prior = np.array([observed[k] if k in known else hardly[k] for k in range(4)])
        sigma = np.linalg.norm(np.linalg.pinv(np.vstack([a / 0.1, np.diag(1 / prior)])), axis=1)
        left = [k for k in range(4) if k not in known]
        worst = max(left, key=lambda k: sigma[k])
        if sigma[worst] <= 0.05:
            break
        known[worst] = sigma[worst]
    assert list(found) == [names[k] for k in known]
    np.testing.assert_allclose(list(found.values()), list(known.values()), rtol=1e-9)
    # One of the two observed does not tell the other; what is told stays free.
    assert set(found) == {"k2", "p1", "p2"}


def test_similarity_by_any_turn_and_its_defects():
    rng = np.random.default_rng(1)
    there = rng.normal(size=(6, 3))
    for kappa in (0.3, np.pi, -3.0):
        turn = np.asarray(camera_from_object(0.1, -0.2, kappa))
        found = similarity_between(there, [1000.0, -50, 7] + 12.5 * there @ turn.T)
        np.testing.assert_allclose(found.turn, turn, rtol=0, atol=1e-12)
        assert found.scale == pytest.approx(12.5, rel=1e-12)
    line = np.outer(np.arange(5.0), [1, 2, 3])
    assert similarity_between(line, 3 * line + 1) is None
    assert similarity_between(there[:2], there[:2]) is None


@pytest.fixture(scope="module")
def elsewhere():
    """A network of six images, its block, and truth in a frame that is turned, moved and twice as large."""
    scene = convergent(6, 60)
    block, network, sight, true = network_of(scene)
    network = meet(sight, network, 4.0, np.deg2rad(1.5))
    turn = np.asarray(camera_from_object(0.5, 0.4, 3.1))
    where = np.zeros((len(block.points), 3))
    where[sight.point] = scene.points[true]
    there = Scene(5 + 2 * scene.positions @ turn.T, scene.matrices @ turn.T, 5 + 2 * where @ turn.T)
    return block, network, there


def stations_of(there, images):
    """Stations of `images` as rows of a block."""
    n = len(images)
    return CameraPositions(
        np.repeat(images, 3), np.tile(np.arange(3), n), there.positions[images].ravel(), np.full(3 * n, 0.1)
    )


def known_start(block, there, images=(), points=()):
    """A start that knows `images` and `points`."""
    pick = lambda n, which: np.isin(np.arange(n), which)  # noqa: E731
    image, point = pick(len(block.images), images), pick(len(block.points), points)
    exterior = ExteriorOrientation(
        np.where(image[:, None], there.positions, 0.0), np.where(image[:, None, None], there.matrices, np.eye(3))
    )
    unknowns = dataclasses.replace(
        block.start.unknowns, exterior=exterior, points=np.where(point[:, None], there.points, 0.0)
    )
    return Start(unknowns, image, point)


def test_a_network_comes_to_known_stations_or_says_why_not(elsewhere):
    block, network, there = elsewhere
    np.testing.assert_array_equal(onto_known(block, network, block.start).points, network.points)
    found = onto_known(dataclasses.replace(block, stations=stations_of(there, np.arange(4))), network, block.start)
    np.testing.assert_allclose(found.points, there.points, rtol=0, atol=1e-9)
    few = dataclasses.replace(block, stations=stations_of(there, np.arange(2)))
    with pytest.raises(BlockError, match="the 2 known points and stations that they see are fewer than three"):
        onto_known(few, network, block.start)


@pytest.mark.parametrize(
    ("images", "points"),
    [([0, 1, 2, 3], []), ([1, 4], []), ([2], [5, 6]), ([3], [7])],
    ids=["four images", "two images", "one image and two points", "one image and one point"],
)
def test_known_images_give_the_frame(elsewhere, images, points):
    block, network, there = elsewhere
    start = known_start(block, there, images, points)
    found = onto_known(dataclasses.replace(block, start=start), network, start)
    np.testing.assert_allclose(found.positions, there.positions, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.camera_from_object, there.matrices, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.points, there.points, rtol=0, atol=1e-9)


def test_a_scale_bar_gives_the_scale(elsewhere):
    block, network, there = elsewhere
    bar = np.array([[3, 17]])
    length = np.linalg.norm(there.points[3] - there.points[17])
    block = dataclasses.replace(block, distances=Distances(bar, np.array([length]), np.array([0.01])))
    start = known_start(block, there, [2])
    found = onto_known(dataclasses.replace(block, start=start), network, start)
    np.testing.assert_allclose(found.points, there.points, rtol=0, atol=1e-9)
    free = onto_known(block, network, block.start)
    assert np.linalg.norm(free.points[3] - free.points[17]) == pytest.approx(length, rel=1e-12)
