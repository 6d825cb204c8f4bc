"""Several devices: rays and their points are dealt out over a mesh, everything else is on every device.

Each device sums its own rays; the sums of the reduced normal matrix are added across devices
(`model.structure.total`), and each factors the result for itself. So nothing but sums the size of the reduced matrix
ever travels.
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
"""Dealt out along the first axis, that of batches."""


def along_points(ndim: int) -> Any:
    """Dealt out along the last axis, that of points."""
    return P(*[None] * (ndim - 1), AXIS)


_OF_RAYS = {"xy", "sigma_xy", "met", "chunk_image", "ray_point", "pair", "block", "used", "f", "border"}
_OF_ROWS = {"parameter", "column", "slot"}
_OF_POINTS = {"points", "datum_points", "point_free", "l"}


def sharded(function: Callable[..., Any], structure: PaddedStructure, out: Any) -> Callable[..., Any]:
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
    # Those of rays, not those of the rows of a group.
    if name in _OF_RAYS and "observed" not in names:
        return BATCHES
    # What rows by point touch, not what those in lists do.
    if name in _OF_ROWS and array.ndim == 3:
        return along_points(array.ndim)
    return along_points(array.ndim) if name in _OF_POINTS else EVERYWHERE
