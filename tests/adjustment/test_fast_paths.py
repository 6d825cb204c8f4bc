"""Every way to compute an adjustment gives the plain one's numbers: banded or dense, in any order, chords or not."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxphoto import adjust, covariance
from jaxphoto.adjustment.layout import padding, rays
from jaxphoto.adjustment.layout.padding import pad_structure
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.compiling.lru_cache import LruCache
from jaxphoto.statistics import redundancy_numbers
from tests.blocks import BROWN, Scene, adjusted, all_stations, bare, free, measured, simulated
from tests.blocks import rows as control_rows


@pytest.fixture(scope="module")
def corridor():
    """Two opposite strips of 36 images along a valley, the images in no order at all."""
    rng = np.random.default_rng(11)
    n = 72
    along = np.concatenate([np.arange(36), np.arange(36)]) * 250.0
    positions = np.column_stack([along, np.repeat([-120.0, 120.0], 36), 1000 + rng.normal(0, 15, n)])
    angles = rng.normal(0, 0.02, (n, 3)) + np.repeat([[0, 0, 0.0], [0, 0, np.pi]], 36, axis=0)
    points = np.column_stack([rng.uniform(-300, 9100, 420), rng.uniform(-250, 250, 420), rng.uniform(0, 120, 420)])
    order = rng.permutation(n)
    block, truth = bare(Scene(positions[order], angles[order], points), {"one": BROWN}, ("one",) * n)
    block = dataclasses.replace(block, control=control_rows((3, 100, 200, 300)), stations=all_stations(block))
    return measured(type(simulated("cross"))(free(block, "one"), truth)).block


def everything(block, start):
    """Unknowns, residuals, covariances and redundancy numbers, flat."""
    result = adjust(block, start)
    assert bool(result.converged)
    cov = covariance(result)
    numbers = redundancy_numbers(result, cov)
    sigma = np.sqrt(np.diag(cov.matrix))
    unknowns = jax.tree.map(np.asarray, result.unknowns)
    return result, unknowns, cov, sigma, np.concatenate([np.ravel(v) for v in numbers.named.values()])


def assert_same(one, other):
    """To far below standard deviations."""
    a, unknowns, cov, sigma, numbers = one
    b, others, cov2, _, numbers2 = other
    exterior = sigma[: 6 * len(a.block.images)].reshape(-1, 6)
    error = (unknowns.exterior.position - others.exterior.position) / exterior[:, :3]
    assert np.abs(error).max() < 1e-5
    assert (np.abs(unknowns.points - others.points) < 1e-5 * cov.point_sigma + 1e-12).all()
    assert float(b.sum_of_squares) == pytest.approx(float(a.sum_of_squares), rel=1e-11)
    unit = np.outer(sigma, sigma)
    np.testing.assert_allclose(cov2.matrix / unit, cov.matrix / unit, atol=1e-8)
    np.testing.assert_allclose(cov2.points, cov.points, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(numbers2, numbers, atol=1e-7)


@pytest.mark.slow
def test_a_banded_reduced_matrix_gives_what_a_dense_one_gives(corridor, monkeypatch):
    start = corridor.start.unknowns
    padded = pad_structure(structure_of(corridor, corridor.priors)).structure
    assert padded.rays.columns >= 5
    banded = everything(corridor, start)
    monkeypatch.setattr(rays, "column_blocks", lambda n, bandwidth: (1, n))
    monkeypatch.setattr("jaxphoto.adjustment.adjust._layouts", LruCache(1))
    dense = everything(corridor, start)
    assert dense[0].padded.structure.rays.columns == 1
    assert_same(banded, dense)


@pytest.mark.slow
def test_batches_one_at_a_time_give_what_one_gives(monkeypatch):
    block, start = simulated("three_models").block, adjusted("three_models").unknowns
    together = everything(block, start)
    for name in ("_RAYS", "_PAIRS", "_FEWEST"):
        monkeypatch.setattr(padding, name, 256)
    monkeypatch.setattr("jaxphoto.adjustment.adjust._layouts", LruCache(1))
    alone = everything(block, start)
    assert (alone[0].padded.structure.rays.used > 1).all()
    assert_same(together, alone)
