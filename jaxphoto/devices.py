"""The devices of JAX that a computation is dealt out to."""

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

AXIS = "devices"
"""The only axis of a mesh."""


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
