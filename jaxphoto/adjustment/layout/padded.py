"""Padded form of a block: rays in chunks (`rays`) and padded sizes (`padding`)."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from jaxphoto.adjustment.layout.rays import GROUP
from jaxphoto.adjustment.model.numbers import AbstractValues, NonImageResiduals
from jaxphoto.adjustment.model.structure import AbstractStructure
from jaxphoto.arrays import ArrayLike
from jaxphoto.devices import AXIS
from jaxphoto.short_repr import pretty_repr


class RayLists(eqx.Module):
    """Rays in chunks of one image, pairs of rays in chunks of two images; chunks in batches.

    One batch is processed at a time to keep its intermediate arrays in the cache of a core. Batches are sharded over
    devices. Empty slots are rows of infinite sigma at an arbitrary image and point.
    """

    chunk_image: Int[np.ndarray, "batches chunks"]
    ray_point: Int[np.ndarray, "batches chunks p"]
    pair: Int[np.ndarray, "pair_batches pair_chunks 2 q"]
    """Indices of two rays of a free point; the image of the first does not precede that of the second."""
    block: Int[np.ndarray, "pair_batches pair_chunks 3"]
    """Position of the two images in the band: column block, row (of two column blocks) and column."""
    used: Int[np.ndarray, "devices 2"]
    """Number of batches, of rays and of pairs, that each device uses; the rest is padding."""
    met: Int[np.ndarray, "groups b"]
    """Shared unknowns involved in rows at the points of each group; padded with the number of shared unknowns."""
    free_points: bool = eqx.field(static=True)
    """True if any point has a free coordinate; otherwise nothing is eliminated."""
    by_image: bool = eqx.field(static=True)
    """True if camera unknowns are eliminated with the unknowns of their images, not as border unknowns that every point
    may involve. Used if there are many more cameras than one image depends on.
    """
    columns: int = eqx.field(static=True)
    """Number of column blocks of the reduced matrix, K."""
    shards: int = eqx.field(static=True)
    """Number of devices over which batches are sharded equally."""


def each_batch(body: Callable, carry: Any, numbers: Any, used: Array, into: Any = None) -> tuple[Any, Any]:
    """Scan over the first `used` batches; results of the others are zero. A single batch needs no loop.

    If `into` is given, results are written into these arrays, and `body` receives their previous content.
    """
    count = len(jax.tree.leaves(numbers)[0])
    given = lambda found: (numbers,) if into is None else (numbers, found)  # noqa: E731
    if count == 1:
        carry, found = body(carry, *jax.tree.map(lambda v: v[0], given(into)))
        return carry, jax.tree.map(lambda v: v[None], found)
    numbers = jax.tree.map(jnp.asarray, numbers)
    at = lambda tree, k: jax.tree.map(lambda v: jax.lax.dynamic_index_in_dim(v, k, keepdims=False), tree)  # noqa: E731

    def step(k: Array, state: tuple[Any, Any]) -> tuple[Any, Any]:
        carry, found = state
        carry, new = body(carry, *at(given(found), k))
        put = lambda v, one: jax.lax.dynamic_update_index_in_dim(v, one, k, 0)  # noqa: E731
        return carry, jax.tree.map(put, found, new)

    found = into
    if found is None:
        like = jax.eval_shape(lambda c: body(c, at(numbers, 0))[1], carry)
        found = jax.tree.map(lambda v: jnp.zeros((count, *v.shape), v.dtype), like)

    # A scan, unlike a loop of `used` steps, can be differentiated in reverse.
    def only_used(state: tuple[Any, Any], k: Array) -> tuple[tuple[Any, Any], None]:
        return jax.lax.cond(k < used, partial(step, k), lambda state: state, state), None

    return jax.lax.scan(only_used, (carry, found), jnp.arange(count))[0]


class PaddedStructure(AbstractStructure):
    """Index arrays and sizes of a padded block; image rows are the slots of its rays."""

    rays: RayLists

    @property
    def shards(self) -> int:
        """Number of devices over which rays and points are sharded."""
        return self.rays.shards

    @property
    def ray_points(self) -> Int[Array, "batches chunks p"]:
        """Point of each ray, as an index into the points of this device."""
        return self._here(self.rays.ray_point, self.n_points // self.shards)

    @property
    def pairs(self) -> Int[Array, "pair_batches pair_chunks 2 q"]:
        """Pairs as indices into the rays of this device."""
        # Each device stores only its own shard of rays.
        return self._here(self.rays.pair, math.prod(self.rays.ray_point.shape))

    def _here(self, index: Any, of_device: int) -> Array:
        if self.shards == 1:
            return jnp.asarray(index)
        return index - jax.lax.axis_index(AXIS) * of_device

    def each(self, body: Callable, carry: Any, numbers: Any, into: Any = None) -> tuple[Any, Any]:
        """Scan rays with `each_batch`; `body` receives the carry and (images, points, *values)."""
        rays = self.rays
        return each_batch(body, carry, (rays.chunk_image, self.ray_points, *numbers), rays.used[0, 0], into)

    def each_ray(self, function: Callable, numbers: tuple) -> Any:
        """Apply `function` to (images, points, *values) of every batch of rays."""
        return self.each(lambda _, own: ((), function(own)), (), numbers)[1]

    def by_group(self, array: Shaped[Array, "*c points"]) -> Shaped[Array, "groups *c p"]:
        """Reshape the points axis to groups."""
        return jnp.moveaxis(array.reshape(*array.shape[:-1], -1, GROUP), -2, 0)

    @property
    def on_one_device(self) -> "PaddedStructure":
        """Return this structure for a program on one device."""
        if self.shards == 1:
            return self
        used = np.array([[len(self.rays.chunk_image), len(self.rays.pair)]])
        return dataclasses.replace(self, rays=dataclasses.replace(self.rays, shards=1, used=used))


@pretty_repr
class PaddedValues(AbstractValues):
    """Arrays of a padded block; empty slots have infinite sigmas."""

    xy: Float[Array, "batches 2 chunks p"]
    sigma_xy: Float[Array, "batches 2 chunks p"]


class PaddedResiduals(NonImageResiduals):
    """Residuals (observed minus computed, over sigma) in the slots of the rays."""

    image: Float[ArrayLike, "batches 2 chunks p"]
