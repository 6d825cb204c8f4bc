"""The index finds the points that an independent search finds."""

import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxphoto import InputError
from jaxphoto.cloud import Cloud
from jaxphoto.lidar import around, index_cloud, nearest


def uniform(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, 100, (n, 2)), rng.uniform(0, 9, n)])


def with_outliers() -> np.ndarray:
    xyz = uniform(5000)
    xyz[:3, :2] = [[1e7, 1e7], [-1e8, 0], [50, 1e9]]
    return xyz


def crowded() -> np.ndarray:
    xyz = uniform(5000)
    xyz[:3000, :2] *= 0.01
    return xyz


def on_a_line() -> np.ndarray:
    xyz = uniform(3000)
    xyz[:, 1] = xyz[:, 0]
    return xyz


def on_one_spot() -> np.ndarray:
    xyz = uniform(500)
    xyz[:, :2] = 5
    return xyz


CLOUDS = {
    "uniform": uniform(5000), "few": uniform(7), "one": uniform(1), "outliers": with_outliers(), "crowded": crowded(),
    "line": on_a_line(), "spot": on_one_spot(), "lattice": np.round(uniform(4000)),
}  # fmt: skip


@pytest.mark.parametrize("name", CLOUDS)
def test_nearest_are_those_of_a_tree(name: str) -> None:
    xyz = CLOUDS[name]
    places = np.random.default_rng(1).uniform(-20, 120, (1500, 2))
    places[0], places[1] = [3e7, 1e7], [1e5, -1e5]
    grid = index_cloud(xyz)
    for k in (1, 8, 24):
        found = nearest(grid, places, k)
        distance, _ = cKDTree(xyz[:, :2]).query(places, k=np.arange(1, k + 1))
        np.testing.assert_allclose(found.distance, distance, rtol=1e-14)
        there = np.isfinite(distance)
        assert np.array_equal(there.sum(axis=1), np.full(1500, min(k, len(xyz))))
        named = xyz[grid.order[found.index], :2]
        np.testing.assert_allclose(np.linalg.norm(named - places[:, None], axis=2)[there], distance[there], rtol=1e-14)


@pytest.mark.parametrize("name", CLOUDS)
def test_grid_holds_every_point_once_in_few_cells(name: str) -> None:
    xyz = CLOUDS[name]
    grid = index_cloud(xyz)
    assert len(grid) == len(xyz)
    assert np.array_equal(np.sort(grid.order[: len(xyz)]), np.arange(len(xyz)))
    assert np.array_equal(grid.xyz[: len(xyz)], xyz[grid.order[: len(xyz)]])
    assert np.prod(grid.shape) <= 2 * len(xyz) + 1024


@pytest.mark.parametrize("reach", [1, 2])
def test_around_gives_the_points_of_the_window(reach: int) -> None:
    xyz = uniform(3000)
    grid = index_cloud(xyz)
    places = np.random.default_rng(2).uniform(-5, 105, (300, 2))
    index, there = map(np.asarray, jax.jit(jax.vmap(lambda xy: around(grid, xy, reach)))(places))
    tree = cKDTree(xyz[:, :2])
    cell = np.clip(np.floor((xyz[:, :2] - grid.corner) / grid.cell_m), 0, grid.shape[::-1] - 1)
    for place, of, mask in zip(places, index, there, strict=True):
        found = grid.order[of[mask]]
        own = np.clip(np.floor((place - grid.corner) / grid.cell_m), 0, grid.shape[::-1] - 1)
        assert sorted(found) == list(np.flatnonzero(np.abs(cell - own).max(axis=1) <= reach))
        assert set(tree.query_ball_point(place, 0.999 * reach * float(grid.cell_m))) <= set(found)


def test_size_of_cells() -> None:
    # 4 points a cell of those that are not empty, whatever lies between two towns.
    assert float(index_cloud(uniform(10_000)).cell_m) == pytest.approx(2.0, rel=0.05)
    towns = np.concatenate([uniform(10_000), uniform(10_000, seed=1) + np.array([150, 150, 0])])
    assert float(index_cloud(towns).cell_m) == pytest.approx(2.0, rel=0.1)


def test_clouds_of_about_the_same_size_share_programs() -> None:
    kinds = {
        tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(index_cloud(uniform(n, seed=n))))
        for n in (61_500, 62_200, 63_000)
    }
    assert len(kinds) == 1


def test_vegetation_is_carried_along() -> None:
    xyz = uniform(1000)
    rng = np.random.default_rng(3)
    classes = rng.integers(1, 8, 1000).astype(np.uint8)
    returns = rng.integers(1, 3, (1000, 2)).astype(np.uint8)
    grid = index_cloud(Cloud(xyz, classification=classes, returns=returns))
    leafy = (classes >= 3) & (classes <= 5) | (returns[:, 1] > 1) & ~np.isin(classes, (2, 6, 9, 17))
    assert np.array_equal(grid.leafy[:1000], leafy[grid.order[:1000]])
    assert not index_cloud(Cloud(xyz)).leafy.any()


def test_what_cannot_be_indexed_is_said() -> None:
    with pytest.raises(InputError, match="no points"):
        index_cloud(np.zeros((0, 3)))
    xyz = uniform(10)
    xyz[4, 2] = np.nan
    with pytest.raises(InputError, match="point 4 "):
        index_cloud(xyz)
