"""Size classes: padding changes nothing that is computed, and blocks of similar size share what is compiled."""

import dataclasses

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto import FIXED, ExteriorOrientation, adjust, covariance
from jaxphoto.adjustment import common_sizes
from jaxphoto.adjustment.adjust import build_problem
from jaxphoto.adjustment.layout.padding import pad_structure
from jaxphoto.adjustment.layout.rays import PaddedSizes, size_class, sizes_of
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.block import Block
from jaxphoto.compiling import run
from jaxphoto.statistics import redundancy_numbers
from jaxphoto.variants import all_control, vertical_control
from tests.blocks import BROWN, VARIANTS, Scene, adjusted, bare, simulated


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(st.integers(1, 10**8), st.integers(1, 100))
def test_classes_are_few_and_at_most_a_step_or_an_eighth_larger(n, step):
    padded = size_class(n, step)
    assert n <= padded < n + max(step, n / 8)
    assert padded % step == 0
    assert size_class(padded, step) == padded
    assert len({size_class(k, step) for k in (n, n + n // 32, n + n // 16)}) <= 2


def strips(images: int, points: int, seed: int) -> Block:
    """Two parallel strips of `images` each, 60 % forward overlap, along `points` points."""
    rng = np.random.default_rng(seed)
    along = np.tile(np.arange(images) * 280.0, 2)
    positions = np.column_stack([along, np.repeat([-150.0, 150.0], images), rng.normal(1000, 10, 2 * images)])
    ground = np.column_stack([rng.uniform(0, along.max(), points), rng.uniform(-400, 400, points), np.zeros(points)])
    scene = Scene(positions, rng.normal(0, 0.02, (2 * images, 3)), ground)
    return bare(scene, {"one": BROWN}, ("one",) * 2 * images).block


def test_blocks_of_similar_size_share_what_is_compiled():
    kinds = set()
    for k, change in enumerate(np.linspace(-0.25, 0.25, 6)):
        block = strips(round(11 * (1 + change / 2)), round(150 * (1 + change)), seed=k)
        padded = pad_structure(structure_of(block, block.priors)).structure
        leaves, tree = jax.tree.flatten(padded)
        kinds.add((tuple(map(np.shape, leaves)), tree))
    assert len(kinds) == 1


def test_a_layout_is_kept_for_blocks_that_differ_in_numbers_only():
    block = simulated("cross").block
    start = block.start.unknowns
    first, again = (
        build_problem(block, start, block.priors),
        build_problem(block.shift_stations([1.0, 0.0, 0.0]), start, block.priors),
    )
    assert again.padded is first.padded
    numbers = [jax.tree.leaves(laid.padded_values.groups) for laid in (first, again)]
    assert any(not np.array_equal(one, other) for one, other in zip(*numbers, strict=True))
    # FIXED is structure, and is no number.
    held = dataclasses.replace(block.priors, exterior=ExteriorOrientation(FIXED, FIXED))
    assert not build_problem(block, start, held).padded.structure.eop_free.any()
    # The same shapes with other indices, and unknowns in another order.
    stations = dataclasses.replace(block.stations, who=block.stations.who[::-1])
    turned = dataclasses.replace(block, stations=stations)
    one, other = (laid.padded.own.observed[0] for laid in (first, build_problem(turned, start, block.priors)))
    assert one.name == other.name == "stations"
    np.testing.assert_array_equal(other.image, one.image[:, ::-1])
    assert build_problem(block, start, block.priors, PaddedSizes(images=64)).padded.structure.n_images == 64


def test_a_layout_follows_the_order_of_a_scanners_strips():
    block = simulated("surfaces").block

    def reordered(unknowns):
        shifts = dict(reversed(unknowns.scanner.shifts.items()))
        return dataclasses.replace(unknowns, scanner=dataclasses.replace(unknowns.scanner, shifts=shifts))

    start, priors = reordered(block.start.unknowns), reordered(block.priors)
    turned = dataclasses.replace(block, start=dataclasses.replace(block.start, unknowns=start), priors=priors)
    one, other = (build_problem(b, b.start.unknowns, b.priors).padded.own.labels for b in (block, turned))
    assert sorted(one) == sorted(other)
    assert one != other


def test_a_padded_structure_has_the_sizes_asked_for():
    for name in VARIANTS:
        block = simulated(name).block
        structure = structure_of(block, block.priors)
        sizes = sizes_of(structure)._replace(pair_chunks=3333, rows=(("stations", 150),))
        padded = pad_structure(structure, sizes)
        s, places = padded.structure, padded.places
        assert np.prod(s.rays.block.shape[:2]) >= 3333
        assert all(g.n_rows >= 150 for g in s.observed if g.name == "stations")
        assert s.n_images > structure.n_images
        # What is padding depends on nothing and is held.
        assert s.eop_free.sum() == structure.eop_free.sum() and s.point_free.sum() == structure.point_free.sum()
        assert s.n_images - 1 not in places.image


def test_larger_sizes_change_no_result():
    block = simulated("everything").block
    small, sizes = adjusted("everything"), sizes_of(structure_of(block, block.priors))
    wide = sizes._replace(images=40, point_groups=50, chunks=100, pair_chunks=900, rows=(("stations", 300),))
    large = adjust(block, small.unknowns, sizes=wide)
    for one, two in zip(small.residuals.named.values(), large.residuals.named.values(), strict=True):
        np.testing.assert_allclose(two, one, rtol=0, atol=1e-7)
    a, b = covariance(small), covariance(large)
    scale = np.sqrt(np.abs(np.diag(a.matrix)))
    scale = np.where(scale > 0, scale, 1.0)
    np.testing.assert_allclose(b.matrix / np.outer(scale, scale), a.matrix / np.outer(scale, scale), rtol=0, atol=1e-8)
    np.testing.assert_allclose(b.points, a.points, rtol=1e-7, atol=1e-14)
    for one, two in zip(*(redundancy_numbers(*of).named.values() for of in ((small, a), (large, b))), strict=True):
        np.testing.assert_allclose(two, one, rtol=0, atol=1e-8)


def test_blocks_that_fit_common_sizes_compile_once():
    block = simulated("cross").block
    blocks = [all_control(block, 0.05), vertical_control(all_control(block, 0.05))]
    sizes = common_sizes(blocks)
    start = adjusted("cross").unknowns
    adjust(blocks[0], start, sizes=sizes)
    before = set(run._programs)
    result = adjust(blocks[1], start, sizes=sizes)
    assert set(run._programs) == before
    assert bool(result.converged)
