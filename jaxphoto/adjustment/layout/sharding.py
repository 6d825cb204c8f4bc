"""Sharding over devices: rays and their points are distributed over a mesh, everything else is replicated.

Each device sums its own rays. The sums of the reduced normal matrix are added across devices (`model.structure.total`),
and each device factors the result. Only sums of the size of the reduced matrix are communicated.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.sharding import PartitionSpec as P

from jaxphoto.adjustment.layout.padded import PaddedStructure
from jaxphoto.devices import AXIS, mesh_of

EVERYWHERE: Any = P()
BATCHES: Any = P(AXIS)
"""Sharded along the first axis (batches)."""


def along_points(ndim: int) -> Any:
    """Sharded along the last axis (points)."""
    return P(*[None] * (ndim - 1), AXIS)


_OF_RAYS = {"xy", "sigma_xy", "met", "chunk_image", "ray_point", "pair", "block", "used", "f", "border"}
_OF_ROWS = {"parameter", "column", "slot"}
_OF_POINTS = {"points", "datum_points", "point_free", "l"}


def sharded(function: Callable[..., Any], structure: PaddedStructure, out: Any) -> Callable[..., Any]:
    """Map `function` over shards; return it unchanged for one device.

    Arguments are sharded by field name; `out` gives the sharding of the result, as a prefix of its tree.
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
    # Fields of rays, not the fields of observation groups with the same names.
    if name in _OF_RAYS and "observed" not in names:
        return BATCHES
    # Rows stored by point, not rows in lists.
    if name in _OF_ROWS and array.ndim == 3:
        return along_points(array.ndim)
    return along_points(array.ndim) if name in _OF_POINTS else EVERYWHERE
