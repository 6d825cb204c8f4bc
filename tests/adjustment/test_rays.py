"""Lists of rays hold every image row once, and of free points every pair of rays once, whatever sees what."""

import dataclasses
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.adjustment import MINIMAL_SIZES
from jaxphoto.adjustment.layout import padding
from jaxphoto.adjustment.layout.padding import pad_structure
from jaxphoto.adjustment.layout.rays import Chunks, DeviceLists, order_images, sizes_of
from jaxphoto.adjustment.model.block_values import values_of
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.sensitivity import response, sensitivity
from tests.blocks import FIELDS, VARIANTS, adjusted, simulated


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
@given(sightings(), st.floats(0, 1))
def test_rays_and_pairs_are_listed_once(case, free):
    image, point, n_images, n_points = case
    place, bandwidth = order_images(image, point, n_images, n_points)
    assert sorted(place.tolist()) == list(range(n_images))
    own = (np.random.default_rng(0).random(n_points) < free)[point]
    row, at = np.arange(len(image)), place[image]
    lists = DeviceLists.of(row, at, point, own, n_images)
    assert sorted(lists.ray.tolist()) == row.tolist()
    assert (lists.image == at[lists.ray]).all() and (np.diff(lists.image) >= 0).all()
    one, other = lists.ray[lists.pair]
    expected = {frozenset(pair) for j in range(n_points) for pair in combinations(row[(point == j) & own], 2)}
    assert {frozenset(pair) for pair in zip(one.tolist(), other.tolist(), strict=True)} == expected
    assert len(one) == len(expected)
    assert (np.array(np.divmod(lists.images, n_images)) == (at[one], at[other])).all()
    assert (np.diff(lists.images) >= 0).all()
    assert ((at[one] > at[other]) & (at[one] - at[other] <= bandwidth)).all()


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.lists(st.integers(0, 9)), st.integers(1, 5))
def test_chunks_have_one_key_each(key, size):
    key = np.sort(np.array(key, int))
    chunks = Chunks.of(key, size)
    assert (chunks.key[chunks.slot // size] == key).all()
    assert len(set(chunks.slot.tolist())) == len(key)
    assert len(chunks.key) == sum(-(-(key == k).sum() // size) for k in np.unique(key))


def laid_out(name, **options):
    block = simulated(name).block
    structure = structure_of(block, block.priors)
    values = values_of(block, block.start.unknowns, block.priors, structure)
    padded = pad_structure(structure, **options)
    return structure, values, padded.structure, padded.places, padded.pad(values)


@pytest.mark.parametrize("at_once", [64, 8192])
@pytest.mark.parametrize("shards", [1, 2])
@pytest.mark.parametrize("name", (*VARIANTS, *FIELDS))
def test_rows_lie_where_they_are_computed_with(name, shards, at_once, monkeypatch):
    for limit in ("_RAYS", "_PAIRS", "_FEWEST"):
        monkeypatch.setattr(padding, limit, at_once)
    structure, values, s, places, padded = laid_out(name, shards=shards)
    rays, chunk = s.rays, places.row // s.rays.ray_point.shape[2]
    assert (rays.chunk_image.ravel()[chunk] == places.image[structure.image]).all()
    assert (rays.ray_point.ravel()[places.row] == places.point[structure.point]).all()
    assert len(set(places.row.tolist())) == len(structure.image)
    assert s.point_free.sum() == structure.point_free.sum()
    np.testing.assert_array_equal(padded.points[:, places.point], values.points)
    np.testing.assert_array_equal(np.moveaxis(padded.xy, 1, 0).reshape(2, -1)[:, places.row], values.xy)
    # Devices have the rays of their points, and the batches that these need.
    assert len(rays.chunk_image) % shards == len(rays.pair) % shards == 0
    device = places.point[structure.point] // (s.n_points // shards)
    batch = chunk // rays.chunk_image.shape[1]
    assert (batch // (len(rays.chunk_image) // shards) == device).all()
    assert (batch % (len(rays.chunk_image) // shards) < rays.used[device, 0]).all()

    row = np.full(rays.ray_point.size, -1)
    row[places.row] = np.arange(len(places.row))
    listed, block = np.moveaxis(row[rays.pair], 2, 0), rays.block
    real = (listed >= 0).all(axis=0)
    assert (listed[:, ~real] == -1).all()
    expected = sum(n * (n - 1) // 2 for n in np.bincount(structure.point[structure.point_free.any(0)[structure.point]]))
    pairs = [frozenset(pair) for pair in listed[:, real].T.tolist()]
    assert len(set(pairs)) == len(pairs) == expected
    which = np.broadcast_to(np.moveaxis(block, 2, 0)[..., None], (3, *real.shape))[:, real]
    width = s.n_images // rays.columns
    for k, image in enumerate(which[1:] + which[0] * width):
        assert (image == places.image[structure.image[listed[k, real]]]).all()


def test_images_that_meet_in_fixed_points_only_do_not_meet():
    structure, _, s, places, _ = laid_out("field")
    assert not s.rays.free_points and not s.rays.used[:, 1].any()
    assert sizes_of(structure).bandwidth == MINIMAL_SIZES.bandwidth
    assert sorted(places.image.tolist()) == list(range(structure.n_images))


def test_a_coordinate_that_is_fixed_moves_the_point():
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
    expected = np.stack([by[[every.row(f"exterior[{i}].{x}") for x in "XYZ"]] for i in block.images])
    np.testing.assert_allclose(position / step, expected, rtol=1e-6, atol=1e-9)
    assert np.abs(expected).max() > 1e-3
