"""Several devices: tiles and their points are dealt out over a mesh, everything else is on every device.

Each device sums its own tiles; the sums of the reduced normal matrix are added across devices (`normal.total`), and
each factors the result for itself. So nothing but sums the size of the reduced matrix ever travels.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from jaxphoto.adjustment.structure import AXIS, Structure
from jaxphoto.arrays import still

EVERYWHERE: Any = P()
TILES: Any = P(AXIS)
"""Dealt out along the first axis, that of chunks of tiles."""


def along_points(ndim: int) -> Any:
    """Dealt out along the last axis, that of points."""
    return P(*[None] * (ndim - 1), AXIS)


_OF_TILES = {"xy", "sigma_xy", "pair_tile", "pair_images", "pair_block", "block", "groups", "f"}
_OF_POINTS = {"points", "datum_points", "point_free", "l"}


def usable(wanted: int) -> int:
    """The most devices, up to `wanted`, that are equally many of each process; 1 where that would be none.

    With 1, every process computes all of a block by itself.
    """
    each = min(wanted // jax.process_count(), *map(len, _devices_by_process()))
    return max(1, each * jax.process_count())


def mesh_of(shards: int) -> Mesh:
    """`shards` devices, equally many of each process: one without any would have no part in the result."""
    each = shards // jax.process_count()
    return Mesh(np.array([device for own in _devices_by_process() for device in own[:each]]), (AXIS,))


def _devices_by_process() -> list[list[Any]]:
    return [[device for device in jax.devices() if device.process_index == k] for k in range(jax.process_count())]


def sharded(function: Callable[..., Any], structure: Structure, out: Any) -> Callable[..., Any]:
    """`function` on what each device holds; itself where there is one device.

    Its arguments are cut by the names of their fields; `out` says how its result is, as a prefix of that tree.
    """
    shards = structure.in_tiles.shards
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
    return along_points(array.ndim) if name in _OF_POINTS else EVERYWHERE


def gathered(tree: Any) -> Any:
    """What a program gave on several devices, as the next one expects it; what several processes hold stays there."""
    return tree if jax.process_count() > 1 else jax.tree.map(still, tree)


def on_one_device(s: Structure) -> Structure:
    """The same structure for a program that no other device has a part in."""
    return s if s.in_tiles.shards == 1 else dataclasses.replace(s, tiles=dataclasses.replace(s.in_tiles, shards=1))
