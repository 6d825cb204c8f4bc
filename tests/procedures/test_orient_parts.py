"""Parts of an orientation: rejected depths, what a camera needs, the frame of known points."""

import dataclasses

import numpy as np
import pytest

from jaxphoto.block import Start
from jaxphoto.camera import InteriorOrientation, Smac
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.initial.rays import ideal_coordinates, turn_to_object, unit_rays
from jaxphoto.observations import CameraPositions, Distances
from jaxphoto.procedures.orientation.blocks import in_known_frame, similarity_between
from jaxphoto.procedures.orientation.orient_photographs import beyond_limit, corner_shift, undetermined, unsupported
from tests.formulas import camera_from_object
from tests.procedures.orientable import (
    Camera,
    Scene,
    aerial,
    block_of,
    convergent,
    photographed,
    true_network,
    with_epipolar_matches,
)

PLAIN = Camera(8.0, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("r0_mm", [0.0, 4.9, 5.0, 5.1])
def test_radial_terms_move_the_image_whatever_the_balance_radius(r0_mm):
    """The corner is at 5 mm: k1 moves it, or what lies within, by a good part of 125 mm."""
    moved = corner_shift(InteriorOrientation(8.0, distortion=Smac(r0=r0_mm)), "k1", np.array([4.0, 3.0]))
    assert 40 < moved < 130


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


def network_of(scene, noise_px=0.0, false=0):
    """The block of a network at the truth, its points intersected, and the network and true points of rows.

    `false` matches of each pair lie along epipolar lines; their points are -1.
    """
    p = with_epipolar_matches(photographed(scene, PLAIN, noise_px, clutter=0, found=1.0), false, noise_px)
    network, true = true_network(p)
    xy = np.array([p.features[i][f] for i, f in zip(network.image, network.feature, strict=True)])
    rays = unit_rays(PLAIN.c, ideal_coordinates(InteriorOrientation(PLAIN.c), xy))
    directions = turn_to_object(scene.matrices, network.image, rays)
    points, met = intersect_points(scene.positions[network.image], directions, network.point, len(network.points))
    kept = met[network.point]
    new = np.cumsum(met) - 1
    rows = {"image": network.image[kept], "feature": network.feature[kept], "point": new[network.point[kept]]}
    network = network._replace(points=points[met], **rows)
    return block_of(p, network), network, true[kept]


@pytest.mark.parametrize("which", DEPTHS)
def test_points_of_two_rays_go_where_nothing_else_is(which):
    """Hardly a true one, whatever the relief; false ones the more, the less the depths of neighbours differ."""
    block, network, true = network_of(DEPTHS[which], 0.3, false=4)
    gone = unsupported(block)
    two = np.bincount(network.point)[network.point] == 2
    assert not (gone & ~two).any()
    false, right = two & (true < 0), two & (true >= 0)
    assert gone[right].mean() < 0.02
    assert gone[false].mean() > {"flat": 0.9, "hills": 0.15, "houses": 0.15, "a heap": -1}[which]


def test_the_largest_residual_of_a_point_goes_and_others_stay():
    block, network, _ = network_of(convergent(6, 60))
    residuals = 0.3 * np.random.default_rng(0).normal(size=(2, len(network.point)))
    often = np.flatnonzero(np.bincount(network.point) >= 4)[::3]
    wrong = np.array([np.flatnonzero(network.point == p)[:2] for p in often])
    residuals[0, wrong] += [30.0, 20.0]
    beyond, limit = beyond_limit(block, residuals)
    np.testing.assert_array_equal(np.flatnonzero(beyond), np.sort(wrong[:, 0]))
    assert 1.0 < limit < 3.0


def test_observed_parameters_change_the_others_as_a_new_adjustment_would():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(60, 4)) @ (np.eye(4) + 0.5 * rng.normal(size=(4, 4)))
    a[:, 3] = a[:, 2] + 0.02 * rng.normal(size=60)  # two that are hardly told apart
    a[:, 1] *= 0.05  # one that is hardly told
    names, observed, hardly = ("k1", "k2", "p1", "p2"), np.full(4, 0.1), np.full(4, 1.0)
    found = undetermined(names, a.T @ a / 0.1**2, observed, hardly)
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
    block, network, true = network_of(scene)
    unknown = Start(block.start.unknowns, np.zeros(len(block.images), bool), np.zeros(len(block.points), bool))
    block = dataclasses.replace(block, start=unknown)
    turn = np.asarray(camera_from_object(0.5, 0.4, 3.1))
    where = np.zeros((len(block.points), 3))
    where[network.point] = scene.points[true]
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
    np.testing.assert_array_equal(in_known_frame(block, network, block.start).points, network.points)
    found = in_known_frame(dataclasses.replace(block, stations=stations_of(there, np.arange(4))), network, block.start)
    np.testing.assert_allclose(found.points, there.points, rtol=0, atol=1e-9)
    few = dataclasses.replace(block, stations=stations_of(there, np.arange(2)))
    with pytest.raises(BlockError, match="the 2 known points and stations that they see are fewer than three"):
        in_known_frame(few, network, block.start)


@pytest.mark.parametrize(
    ("images", "points"),
    [([0, 1, 2, 3], []), ([1, 4], []), ([2], [5, 6]), ([3], [7])],
    ids=["four images", "two images", "one image and two points", "one image and one point"],
)
def test_known_images_give_the_frame(elsewhere, images, points):
    block, network, there = elsewhere
    start = known_start(block, there, images, points)
    found = in_known_frame(dataclasses.replace(block, start=start), network, start)
    np.testing.assert_allclose(found.positions, there.positions, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.camera_from_object, there.matrices, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.points, there.points, rtol=0, atol=1e-9)


def test_a_scale_bar_gives_the_scale(elsewhere):
    block, network, there = elsewhere
    bar = np.array([[3, 17]])
    length = np.linalg.norm(there.points[3] - there.points[17])
    block = dataclasses.replace(block, distances=Distances(bar, np.array([length]), np.array([0.01])))
    start = known_start(block, there, [2])
    found = in_known_frame(dataclasses.replace(block, start=start), network, start)
    np.testing.assert_allclose(found.points, there.points, rtol=0, atol=1e-9)
    free = in_known_frame(block, network, block.start)
    assert np.linalg.norm(free.points[3] - free.points[17]) == pytest.approx(length, rel=1e-12)
