"""Spatial index of a cloud: points sorted by square cells in plan.

Cells are numbered row by row, so the points of adjacent cells in a row are contiguous: a window of (2 reach + 1)^2
cells is read as 2 reach + 1 runs. Points and query positions outside the grid are assigned to the nearest border cell.
This only reduces their distances in cells, so no window misses a point, and a few distant points cannot enlarge the
grid.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.arrays import ArrayLike
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError

# Mean number of points in a nonempty cell.
_PER_CELL = 4
# Sample size for estimating the cell size.
_SAMPLE = 200_000
# Fraction of the points that may lie beyond each border if isolated points would make the grid too large.
_OUTSIDE = 1e-3
# LAS classes of low, medium and high vegetation.
_VEGETATION = (3, 4, 5)
# LAS classes of ground, buildings, water and bridge decks.
_SURFACES = (2, 6, 9, 17)


class Grid(eqx.Module):
    """Points of a cloud sorted by cells. Arrays are padded, so that clouds of similar size share compiled programs."""

    xyz: Float[ArrayLike, "padded 3"]
    """Points in the order of the cells (m); padded with copies of the last one."""
    order: Int[ArrayLike, "padded"]
    """Index of each point in the cloud; -1 for padding."""
    start: Int[ArrayLike, "offsets"]
    """Index of the first point of each cell, padded with the number of points."""
    corner: Float[ArrayLike, "2"]
    """X, Y of the lower left corner (m)."""
    cell_m: Float[ArrayLike, ""]
    """Side of a cell (m)."""
    shape: Int[ArrayLike, "2"]
    """Number of rows and columns."""
    leafy: Bool[ArrayLike, "padded"]
    """True for vegetation (LAS classes 3, 4, 5) and multiple returns of a pulse."""
    most: int = eqx.field(static=True)
    """Maximum number of points in three adjacent cells of a row (capacity)."""

    def __len__(self) -> int:
        return int(self.start[-1])


class Nearest(eqx.Module):
    """Points nearest to query positions, nearest first; distances are infinite if the cloud has too few points."""

    index: Int[np.ndarray, "places k"]
    """Index into the sorted points of the grid."""
    distance: Float[np.ndarray, "places k"]
    """Horizontal distance (m)."""


def index_cloud(cloud: Cloud | Float[np.ndarray, "n 3"]) -> Grid:
    """Index a cloud, or an array of points (m), in square cells.

    A nonempty cell contains about 4 points. The number of cells is at most about twice the number of points:
    for larger areas, isolated points are assigned to the border of the grid, and cells are enlarged.
    """
    xyz = np.asarray(cloud.xyz if isinstance(cloud, Cloud) else cloud, float)
    if not len(xyz):
        raise InputError("the cloud has no points; check the filters used for reading it")
    if not np.isfinite(xyz).all():
        wrong = int(np.argmin(np.isfinite(xyz).all(axis=1)))
        raise InputError(
            f"point {wrong} of the cloud is {xyz[wrong].tolist()}: remove points with NaN or infinite coordinates"
        )
    low, high, cell = _extent(xyz[:, :2])
    shape = np.maximum(np.ceil((high - low)[::-1] / cell), 1).astype(int)
    place = np.floor((xyz[:, :2] - low) / cell)
    place = np.clip(place, 0, shape[::-1] - 1).astype(np.int32)
    of_cell = place[:, 1] * np.int32(shape[1]) + place[:, 0]
    # Sort cell and point as one integer: stable, and three times as fast as a stable sort.
    key = of_cell.astype(np.int64) << 32 | np.arange(len(xyz))
    key.sort()
    order = (key & 0xFFFFFFFF).astype(np.int32)
    start = np.zeros(shape.prod() + 1, np.int32)
    np.cumsum(np.bincount(of_cell, minlength=shape.prod()), out=start[1:])
    order = np.concatenate([order, np.full(_room(len(xyz)) - len(xyz), -1, np.int32)])
    known = np.where(order < 0, order[len(xyz) - 1], order)
    return Grid(
        xyz=xyz[known],
        order=order,
        start=np.concatenate([start, np.full(_room(len(start)) - len(start), len(xyz), np.int32)]),
        corner=low,
        cell_m=np.array(cell),
        shape=shape,
        leafy=_leafy(cloud)[known] if isinstance(cloud, Cloud) else np.zeros(len(known), bool),
        most=_room(_fullest(start, shape)),
    )


def around(grid: Grid, xy: Float[Array, "2"], reach: int = 1) -> tuple[Int[Array, "k"], Bool[Array, "k"]]:
    """Return indices of the points in the (2 reach + 1)^2 cells around one position (m), and a mask of valid entries.

    Indices refer to the sorted points: `grid.xyz[index]`, or `grid.order[index]` in the cloud. The number of entries is
    always `(2 reach + 1) ceil((2 reach + 1) / 3) grid.most`, as required for compilation and `vmap`. All points closer
    than `reach` cells are included.
    """
    rows, columns = grid.shape[0], grid.shape[1]
    at = jnp.floor((xy - grid.corner) / grid.cell_m)
    # Clip as float: the cell of a distant position exceeds the integer range.
    column = jnp.clip(at[0], 0, columns - 1).astype(int)
    row = jnp.clip(at[1], 0, rows - 1).astype(int) + jnp.arange(-reach, reach + 1)
    inside = (row >= 0) & (row < rows)
    first = jnp.where(inside, row, 0) * columns
    start = jnp.asarray(grid.start)
    begin = start[first + jnp.maximum(column - reach, 0)]
    end = start[first + jnp.minimum(column + reach, columns - 1) + 1]
    width = -(-(2 * reach + 1) // 3) * grid.most
    index = begin[:, None] + jnp.arange(width)
    there = (index < end[:, None]) & inside[:, None]
    return jnp.where(there, index, 0).ravel(), there.ravel()


def nearest(grid: Grid, xy: Float[np.ndarray, "places 2"], k: int) -> Nearest:
    """Return the `k` points nearest to each position (m) in plan, exactly, nearest first."""
    tree = getattr(grid, "_tree", None)
    if tree is None:
        # Points are sorted: an unbalanced tree is equally good, and faster to build. Keep it: searches repeat.
        tree = scipy.spatial.KDTree(np.asarray(grid.xyz)[: len(grid), :2], balanced_tree=False, compact_nodes=False)
        object.__setattr__(grid, "_tree", tree)
    distance, index = tree.query(np.asarray(xy, float).reshape(-1, 2), k=np.arange(1, k + 1), workers=-1)
    return Nearest(np.where(np.isfinite(distance), index, 0).astype(np.int32), distance)


def _leafy(cloud: Cloud) -> np.ndarray:
    leafy = np.zeros(len(cloud), bool)
    if cloud.classification is not None:
        leafy |= np.isin(cloud.classification, _VEGETATION)
    if cloud.returns is not None:
        several = cloud.returns[:, 1] > 1
        if cloud.classification is not None:
            # Exclude classified ground: through an open crown the last return is the ground.
            several &= ~np.isin(cloud.classification, _SURFACES)
        leafy |= several
    return leafy


def _extent(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the lower left and upper right corner of the grid, and the side of its cells (m)."""
    low, high = xy.min(axis=0), xy.max(axis=0)
    some = xy[:: max(1, len(xy) // _SAMPLE)]
    limit = 2 * len(xy) + 1024
    cell = _cell_side(some, len(xy))
    if _cells(low, high, cell) > limit:
        low, high = np.quantile(some, [_OUTSIDE, 1 - _OUTSIDE], axis=0)
    while _cells(low, high, cell) > limit:
        cell *= 1.1
    return low, high, cell


def _cells(low: np.ndarray, high: np.ndarray, cell: float) -> float:
    return float(np.prod(np.maximum(np.ceil((high - low) / cell), 1)))


def _cell_side(some: np.ndarray, n: int) -> float:
    """Return the cell side (m) for `_PER_CELL` points per nonempty cell, estimated from a sample; `n` is the number of
    points.
    """
    span = np.ptp(some, axis=0)
    area = max(float(np.prod(span)), float(span.max()) ** 2 / len(some))
    if area == 0:
        return 1.0
    for _ in range(20):
        cell = np.sqrt(_PER_CELL * area / len(some))
        occupied = len(np.unique(np.floor((some - some.min(axis=0)) / cell) @ [1.0, 1.0 + np.ceil(span[0] / cell)]))
        before, area = area, occupied * cell**2
        if area > 0.9 * before:
            break
    return float(np.sqrt(_PER_CELL * area / n))


def _fullest(start: np.ndarray, shape: np.ndarray) -> int:
    """Return the maximum number of points in three adjacent cells of a row."""
    each = np.diff(start).reshape(shape)
    sums = np.convolve(each.ravel(), [1, 1, 1]) if shape[1] > 2 else each.sum(axis=1)
    return int(sums.max())


def _room(n: int) -> int:
    """Round up `n` to one of eight sizes between two powers of two."""
    step = 1 << max(n.bit_length() - 4, 2)
    return -(-n // step) * step
