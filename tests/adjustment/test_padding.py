"""Size classes: padding changes nothing that is computed, and blocks of similar size share what is compiled."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto import adjust, covariance
from jaxphoto.adjustment import common_sizes
from jaxphoto.adjustment.padding import pad_structure, size_class, sizes_of
from jaxphoto.adjustment.structure import structure_of
from jaxphoto.compiling import run
from jaxphoto.statistics import redundancy_numbers
from jaxphoto.variants import all_control, vertical_control
from tests.blocks import VARIANTS, adjusted, simulated


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(st.integers(1, 10**8))
def test_classes_are_few_and_at_most_an_eighth_larger(n):
    padded = size_class(n)
    assert n <= padded <= max(n * 1.125, n + 1)
    assert size_class(padded) == padded
    assert len({size_class(k) for k in range(n, n + n // 16)}) <= 2


def test_a_padded_structure_has_the_sizes_asked_for():
    for name in VARIANTS:
        block = simulated(name).block
        structure = structure_of(block, block.priors)
        sizes = sizes_of(structure)._replace(pairs=1000, blocks=333, stations=150)
        s, places = pad_structure(structure, sizes)
        assert s.tiles.pair_tile.shape[1] == size_class(1000)
        assert s.tiles.block.shape[1] == size_class(max(333, sizes.blocks))
        assert len(s.station_image) == size_class(150) * (len(structure.station_image) > 0)
        assert s.n_images > structure.n_images and s.n_points > structure.n_points
        # What is padding depends on nothing and is held.
        assert (np.diff(s.tiles.pair_block) >= 0).all()
        assert s.eop_free.sum() == structure.eop_free.sum() and s.point_free.sum() == structure.point_free.sum()
        assert s.n_images - 1 not in places.image


@pytest.mark.parametrize("name", ["everything", "three_models"])
def test_larger_sizes_change_no_result(name):
    block = simulated(name).block
    small, sizes = adjusted(name), sizes_of(structure_of(block, block.priors))
    wide = sizes._replace(images=40, tiles=50, tile_images=24, tile_points=16, pairs=3000, blocks=500, stations=300)
    large = adjust(block, small.unknowns, sizes=wide)
    for one, two in zip(small.residuals, large.residuals, strict=True):
        np.testing.assert_allclose(two, one, rtol=0, atol=1e-7)
    a, b = covariance(small), covariance(large)
    scale = np.sqrt(np.abs(np.diag(a.matrix)))
    scale = np.where(scale > 0, scale, 1.0)
    np.testing.assert_allclose(b.matrix / np.outer(scale, scale), a.matrix / np.outer(scale, scale), rtol=0, atol=1e-8)
    np.testing.assert_allclose(b.points, a.points, rtol=1e-7, atol=1e-14)
    for one, two in zip(redundancy_numbers(small, a), redundancy_numbers(large, b), strict=True):
        np.testing.assert_allclose(two, one, rtol=0, atol=1e-8)


def test_blocks_that_fit_common_sizes_compile_once():
    block = simulated("cross").block
    blocks = [all_control(block, 0.05), vertical_control(all_control(block, 0.05))]
    sizes = common_sizes(blocks)
    start = adjusted("cross").unknowns
    adjust(blocks[0], start, sizes=sizes)
    before = len(run._programs)
    result = adjust(blocks[1], start, sizes=sizes)
    assert len(run._programs) == before
    assert bool(result.converged)
