"""Several devices: tiles and their points are dealt out over a mesh, everything else is on every device.

Each device sums its own tiles; the sums of the reduced normal matrix are added across devices
(`model.structure.total`), and each factors the result for itself. So nothing but sums the size of the reduced matrix
ever travels.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.sharding import PartitionSpec as P

from jaxphoto.adjustment.layout.tiled import TiledStructure
from jaxphoto.devices import AXIS, mesh_of

EVERYWHERE: Any = P()
TILES: Any = P(AXIS)
"""Dealt out along the first axis, that of chunks of tiles."""


def along_points(ndim: int) -> Any:
    """Dealt out along the last axis, that of points."""
    return P(*[None] * (ndim - 1), AXIS)


_OF_TILES = {"xy", "sigma_xy", "met", "pair_tile", "pair_images", "pair_block", "block", "batches", "f"}
_OF_ROWS = {"parameter", "column", "slot"}
_OF_POINTS = {"points", "datum_points", "point_free", "l"}


def sharded(function: Callable[..., Any], structure: TiledStructure, out: Any) -> Callable[..., Any]:
    """`function` on what each device holds; itself where there is one device.

    Its arguments are cut by the names of their fields; `out` says how its result is, as a prefix of that tree.
    """
    shards = structure.shards
    if shards == 1:
        return function

    def wrapped(*arguments: Any) -> Any:
        arrays, rest = eqx.partition(arguments, eqx.is_array)
        run = jax.shard_map(
            lambda arrays: function(*eqx.combine(arrays, rest)),
            mesh=mesh_of(shards),
            in_specs=(jax.tree_util.tree_map_with_path(_spec, arrays),),
            out_specs=out,
            check_vma=False,
        )
        return run(arrays)

    return wrapped


def _spec(path: tuple[Any, ...], array: Any) -> P:
    names = [getattr(step, "name", "") for step in path]
    name = names[-1] if names else ""
    if "at_points" in names:
        return along_points(array.ndim)
    if "listed" in names:
        return EVERYWHERE
    # The images of tiles, not those of the rows of a block.
    if name in _OF_TILES or (name == "image" and array.ndim >= 3):
        return TILES
    # What rows by point touch, not what those in lists do.
    if name in _OF_ROWS and array.ndim == 3:
        return along_points(array.ndim)
    return along_points(array.ndim) if name in _OF_POINTS else EVERYWHERE
