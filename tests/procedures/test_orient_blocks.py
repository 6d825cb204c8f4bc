"""Blocks of which nothing is known but image points: oriented, and brought to the frame of what is known."""

import dataclasses

import numpy as np
import pytest

from jaxphoto.block import Rows, Start
from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.orientation.approximate import has_beginning
from jaxphoto.orientation.matches import tracks
from jaxphoto.procedures.adjust import start_of
from jaxphoto.procedures.orientation import orient_block
from jaxphoto.procedures.orientation.photographs import _block_of
from jaxphoto.procedures.orientation.refine import freed
from tests.procedures.orientable import PIXEL, SENSOR, Camera, convergent, photographed

PLAIN = Camera(8.0, 0.0, 0.0, 0.0, 0.0)


def unknown_block(scene, held=True):
    """Image points of the scene by a known camera, and the true point of each of the block."""
    p = photographed(scene, PLAIN, 0.3, clutter=0, found=1.0)
    sigmas = [np.full(len(xy), 0.3 * PIXEL) for xy in p.features]
    found = tracks([len(xy) for xy in p.features], p.matches)
    block = _block_of("scene", p.names, SENSOR, InteriorOrientation(8.0), p.features, sigmas, found)
    if held:
        interior = {"camera": freed(block.priors.interior["camera"], ())}
        block = dataclasses.replace(block, priors=dataclasses.replace(block.priors, interior=interior))
    true = np.zeros(len(block.points), int)
    true[found.point] = [p.point_of[i][f] for i, f in zip(found.image, found.feature, strict=True)]
    return block, true


def with_control(block, true, scene, which):
    """The true coordinates of the points `which` as control."""
    points = np.array(block.start.unknowns.points)
    points[which] = scene.points[true[which]]
    known = np.zeros(len(points), bool)
    known[which] = True
    unknowns = dataclasses.replace(block.start.unknowns, points=points)
    rows = Rows(
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
    assert not has_beginning(block)
    assert not has_beginning(with_control(block, true, scene, np.array([0, 20, 45])))
    assert has_beginning(with_control(block, true, scene, np.arange(20)))
    known = dataclasses.replace(block.start, image_known=np.arange(5) == 2)
    assert has_beginning(dataclasses.replace(block, start=known))


def test_images_that_see_nothing_in_common_are_refused(scene):
    block, _ = unknown_block(scene)
    rows = block.image_points
    kept = rows.image == rows.point % 5
    rows = dataclasses.replace(
        rows, image=rows.image[kept], point=rows.point[kept], xy=rows.xy[kept], sigma=rows.sigma[kept]
    )
    with pytest.raises(BlockError, match="no two of the 5 images can be oriented to one another"):
        orient_block(dataclasses.replace(block, image_points=rows))
