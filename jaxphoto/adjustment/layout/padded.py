"""A block as it is computed with: its rays in chunks (`rays`), and in padded sizes (`padding`)."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from jaxphoto.adjustment.layout.rays import GROUP
from jaxphoto.adjustment.model.numbers import AbstractValues, NonImageResiduals
from jaxphoto.adjustment.model.structure import AbstractStructure
from jaxphoto.arrays import Numbers
from jaxphoto.devices import AXIS
from jaxphoto.short_repr import shown


class RayLists(eqx.Module):
    """Rays in chunks of one image, pairs of rays in chunks of two images; chunks in batches.

    A batch is all that is computed with at a time, so that what it needs stays in the cache of a core. Batches are
    dealt out to devices. Slots that are empty have rows of infinite sigma, at any image and point.
    """

    chunk_image: Int[np.ndarray, "batches chunks"]
    ray_point: Int[np.ndarray, "batches chunks p"]
    pair: Int[np.ndarray, "pair_batches pair_chunks 2 q"]
    """Numbers of two rays of a free point, the image of the first not before that of the second."""
    block: Int[np.ndarray, "pair_batches pair_chunks 3"]
    """Where the two images meet: column block of the band, row (of two column blocks) and column in it."""
    used: Int[np.ndarray, "devices 2"]
    """How many of its batches, of rays and of pairs, a device needs: the first ones; the others are padding."""
    met: Int[np.ndarray, "groups b"]
    """Shared unknowns that rows at the points of each group touch; the number of these where it has fewer than most."""
    free_points: bool = eqx.field(static=True)
    """Whether any point has a free coordinate; else nothing is eliminated."""
    by_image: bool = eqx.field(static=True)
    """Whether unknowns of cameras are eliminated from points as those of images are, rather than as unknowns that all
    points may meet: where there are many more cameras than an image has."""
    columns: int = eqx.field(static=True)
    """Column blocks of the reduced matrix, K."""
    shards: int = eqx.field(static=True)
    """Devices that the batches are dealt out to, in equal parts."""


def each_batch(body: Callable, carry: Any, numbers: Any, used: Array, into: Any = None) -> tuple[Any, Any]:
    """`jax.lax.scan` over the `used` first batches; what the others give is zero. Of one batch without a loop.

    Results are written `into` arrays that are given, and `body` gets what its own were before.
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
    return jax.lax.fori_loop(0, used, step, (carry, found))


class PaddedStructure(AbstractStructure):
    """Index arrays and sizes of a block in padded sizes; image rows are the slots of its rays."""

    rays: RayLists

    @property
    def shards(self) -> int:
        """Devices that rays and points are dealt out to."""
        return self.rays.shards

    @property
    def ray_points(self) -> Int[Array, "batches chunks p"]:
        """The point of each ray, among those that this device has."""
        return self._here(self.rays.ray_point, self.n_points // self.shards)

    @property
    def pairs(self) -> Int[Array, "pair_batches pair_chunks 2 q"]:
        """Numbers of rays among those that this device has."""
        # Where batches are dealt out, a device sees its own rays alone.
        return self._here(self.rays.pair, math.prod(self.rays.ray_point.shape))

    def _here(self, index: Any, of_device: int) -> Array:
        if self.shards == 1:
            return jnp.asarray(index)
        return index - jax.lax.axis_index(AXIS) * of_device

    def each(self, body: Callable, carry: Any, numbers: Any, into: Any = None) -> tuple[Any, Any]:
        """`each_batch` of rays: `body` of the carry and of (images, points, *numbers)."""
        rays = self.rays
        return each_batch(body, carry, (rays.chunk_image, self.ray_points, *numbers), rays.used[0, 0], into)

    def each_ray(self, function: Callable, numbers: tuple) -> Any:
        """`function` of (images, points, *numbers) of every batch of rays."""
        return self.each(lambda _, own: ((), function(own)), (), numbers)[1]

    def by_group(self, array: Shaped[Array, "*c points"]) -> Shaped[Array, "groups *c p"]:
        """Numbers of points, group by group."""
        return jnp.moveaxis(array.reshape(*array.shape[:-1], -1, GROUP), -2, 0)

    @property
    def on_one_device(self) -> "PaddedStructure":
        """The same for a program that no other device has a part in."""
        if self.shards == 1:
            return self
        used = np.array([[len(self.rays.chunk_image), len(self.rays.pair)]])
        return dataclasses.replace(self, rays=dataclasses.replace(self.rays, shards=1, used=used))


@shown
class PaddedValues(AbstractValues):
    """The numbers of a block in padded sizes; empty slots have infinite sigmas."""

    xy: Float[Array, "batches 2 chunks p"]
    sigma_xy: Float[Array, "batches 2 chunks p"]


class PaddedResiduals(NonImageResiduals):
    """Observed minus computed over sigma, in the slots of the rays."""

    image: Float[Numbers, "batches 2 chunks p"]
