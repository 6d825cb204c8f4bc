"""Size classes: padding changes nothing that is computed, and blocks of similar size share what is compiled."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto import adjust, compiling, covariance
from jaxphoto.adjustment import common_sizes
from jaxphoto.adjustment.padding import pad_structure, size_class, sizes_of
from jaxphoto.adjustment.structure import structure_of
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
        sizes = sizes_of(structure)._replace(rows=700, chunks=333, control=150)
        s = pad_structure(structure, sizes)
        assert len(s.image) == len(s.point) == size_class(700)
        assert len(s.chunk_a) == len(s.chunk_block) == size_class(max(333, len(structure.chunk_block)))
        assert len(s.control_point) == size_class(max(150, len(structure.control_point)))
        assert s.n_images > structure.n_images and s.n_points > structure.n_points
        # Sorted lists stay sorted, and what is padding refers to padding.
        for sorted_list in (s.point, s.pair_block, s.chunk_block):
            assert (np.diff(sorted_list) >= 0).all()
        assert (s.image[len(structure.image) :] == s.n_images - 1).all()
        assert s.eop_free[:, structure.n_images :].sum() == 0 == s.point_free[:, structure.n_points :].sum()


@pytest.mark.parametrize("name", ["everything", "three_models"])
def test_larger_sizes_change_no_result(name):
    block = simulated(name).block
    small, sizes = adjusted(name), sizes_of(structure_of(block, block.priors))
    wide = sizes._replace(images=40, points=200, rows=900, pairs=3000, blocks=500, chunks=500, width=80, control=300)
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
    before = len(compiling._executables)
    result = adjust(blocks[1], start, sizes=sizes)
    assert len(compiling._executables) == before
    assert bool(result.converged)
