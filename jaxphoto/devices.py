"""JAX devices and cores over which a computation is distributed."""

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

AXIS = "devices"
"""The only axis of a mesh."""


def usable(wanted: int) -> int:
    """Return the largest number of devices, up to `wanted`, with equally many per process; 1 if there is none.

    With 1, every process computes the whole block.
    """
    each = min(wanted // jax.process_count(), *map(len, _devices_by_process()))
    return max(1, each * jax.process_count())


def cores() -> int:
    """Return the number of threads that run programs of one device at the same time: the cores of this process."""
    return len(jax.local_devices()) if jax.default_backend() == "cpu" else 1


def mesh_of(shards: int) -> Mesh:
    """Return a mesh of `shards` devices, equally many per process: each process needs a part of the result."""
    each = shards // jax.process_count()
    return Mesh(np.array([device for own in _devices_by_process() for device in own[:each]]), (AXIS,))


def _devices_by_process() -> list[list[Any]]:
    return [[device for device in jax.devices() if device.process_index == k] for k in range(jax.process_count())]
