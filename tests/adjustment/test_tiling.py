"""Tiles hold every point and every image row exactly once, whatever sees what."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.adjustment.layout.padding import pad_structure
from jaxphoto.adjustment.layout.tiling import order_images, tile_points, tile_shape
from jaxphoto.adjustment.model.structure import structure_of
from tests.blocks import FIELDS, VARIANTS, simulated


@st.composite
def sightings(draw):
    """Image and point of each row, sorted by point; some points and images may have none."""
    n_images, n_points = draw(st.integers(1, 90)), draw(st.integers(1, 60))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    reach, most = draw(st.integers(1, n_images)), draw(st.integers(1, 12))
    image, point = [], []
    for j in range(n_points):
        first = rng.integers(0, n_images)
        near = np.arange(first, min(first + reach, n_images))
        own = rng.permutation(near)[: rng.integers(0, most + 1)]
        image += own.tolist()
        point += [j] * len(own)
    return np.array(image, np.int32), np.array(point, np.int32), n_images, n_points


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(sightings())
def test_every_row_has_a_slot_of_its_own_with_its_image_and_point(case):
    image, point, n_images, n_points = case
    place, bandwidth = order_images(image, point, n_images, n_points)
    assert sorted(place.tolist()) == list(range(n_images))
    placed = place[image]
    m, p = tile_shape(placed, point, n_images, n_points)
    tiling = tile_points(placed, point, n_points, m, p)
    tile, slot, within = tiling.slot // (m * p), tiling.slot // p % m, tiling.slot % p
    assert (tiling.image[tile, slot] == placed).all()
    assert (tiling.place[point] == tile * p + within).all()
    assert len(set(tiling.slot.tolist())) == len(image)
    assert len(set(tiling.place.tolist())) == n_points
    for own in tiling.image:
        real = own[own >= 0]
        assert (np.diff(real) > 0).all()
        assert (own[len(real) :] == -1).all()
    for j in range(n_points):
        mine = placed[point == j]
        if len(mine):
            assert np.ptp(mine) <= bandwidth


def test_a_point_with_more_rays_than_a_tile_has_images_is_refused():
    with pytest.raises(ValueError, match="more than the 4 images"):
        tile_points(np.arange(6), np.zeros(6, int), 1, 4, 8)


@pytest.mark.parametrize("shards", [1, 2])
@pytest.mark.parametrize("name", (*VARIANTS, *FIELDS))
def test_lists_of_pairs_are_all_pairs_of_images_that_share_a_tile(name, shards):
    """Of a tile's images those that see a free point in it."""
    block = simulated(name).block
    structure = structure_of(block, block.priors)
    tiled = pad_structure(structure, shards=shards)
    s, places = tiled.structure, tiled.places
    slots = np.zeros((*s.tiles.image.shape, s.tiles.per_tile), bool)
    slots.reshape(-1)[places.row] = structure.point_free.any(axis=0)[structure.point]
    of_free = slots.any(axis=-1)
    tiles, nobody = s.tiles, s.n_images - 1
    assert len(tiles.image) % shards == 0
    width = s.n_images // tiles.columns
    for k in range(len(tiles.image)):
        real = tiles.block[k][:, 0] < tiles.columns
        found = set()
        listed = real[tiles.pair_block[k]]
        for t, (a, b), which in zip(
            tiles.pair_tile[k][listed], tiles.pair_images[k][listed], tiles.pair_block[k][listed], strict=True
        ):
            one, other = tiles.image[k, t, a], tiles.image[k, t, b]
            column, row_in, column_in = tiles.block[k][which]
            # The block of the band that the pair adds to is that of its images, in the lower triangle.
            assert (one, other) == (column * width + row_in, column * width + column_in)
            assert one >= other
            found.add((int(t), int(a), int(b)))
        expected = {
            (t, a, b)
            for t, own in enumerate(tiles.image[k])
            for a in range(len(own))
            for b in range(a + 1)
            if own[a] != nobody and own[b] != nobody and of_free[k, t, a] and of_free[k, t, b]
        }
        assert found == expected
        where = [tuple(v) for v in tiles.block[k]]
        assert len(set(where)) == len(where)
