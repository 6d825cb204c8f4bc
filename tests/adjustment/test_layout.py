"""Fixed points lie at several places, so that tiles have few images; nothing else knows."""

import dataclasses

import numpy as np
import pytest

from jaxphoto.adjustment import LEAST
from jaxphoto.adjustment.layout.padding import pad_structure
from jaxphoto.adjustment.layout.tile_layout import sizes_of
from jaxphoto.adjustment.model.block_values import values_of
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.sensitivity import response, sensitivity
from tests.blocks import FIELDS, adjusted, simulated


def laid_out(name, **options):
    block = simulated(name).block
    structure = structure_of(block, block.priors)
    values = values_of(block, block.start.unknowns, block.priors, structure)
    tiled = pad_structure(structure, **options)
    return structure, values, tiled.structure, tiled.places, tiled.pad(values)


@pytest.mark.parametrize("shards", [1, 2])
@pytest.mark.parametrize("name", FIELDS)
def test_every_row_lies_in_its_image_and_at_its_point(name, shards):
    structure, values, s, places, padded = laid_out(name, shards=shards)
    tiles, p = s.tiles, s.tiles.per_tile
    tile, slot = np.divmod(places.row, tiles.image.shape[2] * p)
    assert (tiles.image.reshape(-1, tiles.image.shape[2])[tile, slot // p] == places.image[structure.image]).all()
    at = tile * p + slot % p
    assert (places.point_at[at] == structure.point).all()
    assert len(set(places.row.tolist())) == len(structure.image)
    np.testing.assert_array_equal(padded.points[:, at], values.points[:, structure.point])
    np.testing.assert_array_equal(np.moveaxis(padded.xy, 2, 0).reshape(2, -1)[:, places.row], values.xy)


@pytest.mark.parametrize("name", FIELDS)
def test_points_that_are_free_lie_at_one_place_and_fixed_ones_at_several(name):
    structure, _, s, places, _ = laid_out(name)
    often = np.bincount(places.point_at[places.point_at >= 0], minlength=structure.n_points)
    free = structure.point_free.any(axis=0)
    assert (often[free] == 1).all()
    assert (often[~free] > 1).any()
    assert (places.point_at[places.point] == np.arange(structure.n_points)).all()
    assert s.tiles.free_points == free.any()
    assert s.point_free.sum() == structure.point_free.sum()


def test_a_field_asks_for_tiles_no_wider_than_its_free_points_do():
    structure = laid_out("field_and_ground")[0]
    rays = np.bincount(structure.point)
    free = structure.point_free.any(axis=0)
    assert rays[~free].max() > 1.5 * sizes_of(structure).tile_images > 1.5 * rays[free].max()


def test_images_that_meet_in_fixed_points_only_do_not_meet():
    structure, _, s, places, _ = laid_out("field")
    assert s.tiles.pair_tile.size == 0
    assert sizes_of(structure).bandwidth == LEAST.bandwidth
    assert sorted(places.image.tolist()) == list(range(structure.n_images))


def test_a_coordinate_that_is_fixed_moves_the_point_at_all_its_places():
    """What the sensitivity says of it, against the response to a block in which it is another."""
    a = adjusted("field")
    block, step = a.block, 1e-3
    k = 4
    moved = np.asarray(block.fixed.value) + step * (np.arange(len(block.fixed.value)) == k)
    moved = dataclasses.replace(block, fixed=dataclasses.replace(block.fixed, value=moved))
    found = response(a, moved).unknowns
    every = sensitivity(a)
    label = f"points[{block.points[block.fixed.who[k]]}].{'XYZ'[block.fixed.axis[k]]}"
    by = every.fixed[:, every.fixed_labels.index(label)]
    position = np.asarray(found.exterior.position)
    expected = np.stack([by[[every.of(f"exterior[{i}].{x}") for x in "XYZ"]] for i in block.images])
    np.testing.assert_allclose(position / step, expected, rtol=1e-6, atol=1e-9)
    assert np.abs(expected).max() > 1e-3
