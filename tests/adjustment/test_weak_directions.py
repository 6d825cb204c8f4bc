"""Weak directions against dense linear algebra, and what is said of blocks that cannot tell something."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import RankError, adjust
from jaxphoto.adjustment.weak_directions import POOR, weak_directions, yardsticks
from tests.adjustment.dense import at_optimum
from tests.blocks import adjusted, covariance_of, simulated
from tests.marks import slow_but


def dense_covariance(name):
    """C of the free unknowns in yardsticks from the dense normal matrix, and which of all unknowns these are."""
    a, dense = adjusted(name), at_optimum(name)
    s, yard = a.structure, yardsticks(a)
    units = np.concatenate(
        [
            np.repeat([yard.ground, yard.angle], 3 * s.n_images),
            yard.shared,
            np.full(3 * s.n_points, yard.ground),
        ]
    )
    j = dense.jacobian[:, dense.free]
    over = (dense.scale / units)[dense.free]
    return np.linalg.inv(j.T @ j) * np.outer(over, over), dense.free, s


@pytest.mark.parametrize("name", slow_but(("inner",), ("everything", "inner")))
def test_directions_are_those_of_the_dense_covariance(name):
    covariance, free, s = dense_covariance(name)
    mu, vectors = np.linalg.eigh(covariance)
    found = weak_directions(adjusted(name), 0.0)
    moved = np.array(
        [np.concatenate([d.moved.exterior.T.ravel(), d.moved.shared, d.moved.points.T.ravel()]) for d in found]
    )
    assert (moved[:, ~free] == 0).all()
    moved = moved[:, free]
    np.testing.assert_allclose(np.sum(moved**2, axis=1)[:3], mu[::-1][:3], rtol=1e-4)
    along = np.abs(moved[0] @ vectors[:, -1])
    np.testing.assert_allclose(along, np.linalg.norm(moved[0]), rtol=1e-4)
    # With a shared unknown held, so much is left of the variance along the direction as its share says.
    first = np.count_nonzero(free[: 6 * s.n_images])
    u = moved[0] / np.linalg.norm(moved[0])
    precision = np.linalg.inv(covariance)
    held = int(np.argmax(found[0].share))
    kept = np.arange(len(covariance)) != first + held
    left = u[kept] @ np.linalg.inv(precision[np.ix_(kept, kept)]) @ u[kept]
    assert left == pytest.approx((1 - found[0].share[held]) * mu[-1], rel=1e-3)


def test_a_block_without_shared_unknowns_has_directions_too():
    block = simulated("cross").block
    held = adjust(block.fix("c_mm", "xp_mm", "yp_mm", "k1", "k2"))
    assert not held.structure.free.size
    found = weak_directions(held, 0.0)
    assert len(found) == 12
    assert all(np.isfinite(d.sigma) and not d.share.size for d in found)


@pytest.mark.parametrize("name", ["cross", "everything", "inner", "inner_scale"])
def test_sound_blocks_are_not_weak(name):
    a, q = adjusted(name), covariance_of(name)
    yard, sigma0 = yardsticks(a), float(a.sigma0)
    of_all = (
        q.exterior_sigma[:, :3] / yard.ground,
        q.exterior_sigma[:, 3:] / yard.angle,
        q.point_sigma / yard.ground,
        q.shared_sigma / yard.shared,
    )
    assert max(np.max(v, initial=0.0) for v in of_all) / sigma0 < POOR


def test_an_image_of_two_points_is_named():
    block = simulated("cross").block
    rows = block.image_points
    mine = np.flatnonzero(rows.image == 4)
    out = np.isin(np.arange(len(rows)), mine[2:])
    block = dataclasses.replace(
        block.with_observations({rows.group: rows.take(~out)}), stations=block.stations.take(block.stations.who != 4)
    )
    with pytest.raises(
        RankError, match=r"image i4: its orientation is not determined .* by its 2 points: measure more"
    ):
        adjust(block, block.start.unknowns)
