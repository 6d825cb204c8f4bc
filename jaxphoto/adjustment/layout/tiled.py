"""A block in tiles, as it is computed with: in the order of its tiles, and in padded sizes (`padding`)."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from jaxphoto.adjustment.model.numbers import AbstractValues, NonImageResiduals
from jaxphoto.adjustment.model.structure import AbstractStructure
from jaxphoto.arrays import Numbers
from jaxphoto.short_repr import shown


class Tiles(eqx.Module):
    """The tiles, and the lists that bring their sums to the reduced normal matrix.

    Tiles are cut into equal chunks (leading axis), so that the sums of one chunk are all that is held at a time. Empty
    slots have the last image, which nothing depends on.
    """

    image: Int[np.ndarray, "chunks tiles m"]
    per_tile: int = eqx.field(static=True)
    """Points of a tile, P."""
    free_points: bool = eqx.field(static=True)
    """Whether any point has a free coordinate; else nothing is eliminated, and F has no columns."""
    batches: Int[np.ndarray, "chunks"]
    """How many batches of `at_once` tiles hold the points of each chunk: the first ones; the others are padding."""
    at_once: int = eqx.field(static=True)
    """Tiles that are computed with at a time: few enough for the cache of a core, enough to be worth its while."""
    met: Int[np.ndarray, "chunks tiles b"]
    """Shared unknowns that rows at the points of each tile touch; the number of these where it has fewer than most."""
    pair_tile: Int[np.ndarray, "chunks pairs"]
    """Tile within its chunk of each pair of images of a tile that meet (first image not before second)."""
    pair_images: Int[np.ndarray, "chunks pairs 2"]
    """The two within the tile."""
    pair_block: Int[np.ndarray, "chunks pairs"]
    """Which of the chunk's blocks the pair adds to; sorted."""
    block: Int[np.ndarray, "chunks blocks 3"]
    """Column block of the band, and image row (of two column blocks) and image column in it."""
    columns: int = eqx.field(static=True)
    """Column blocks of the reduced matrix, K."""
    shards: int = eqx.field(static=True)
    """Devices that the chunks are dealt out to, in equal parts."""

    @property
    def few(self) -> bool:
        """Whether a device computes with all its tiles at a time: what is made of them is worth keeping."""
        return self.image.shape[:2] == (1, self.at_once) or not self.free_points

    @property
    def eliminated(self) -> int:
        """Columns of F: coordinates of a tile that are eliminated."""
        return 3 * self.per_tile if self.free_points else 0

    def each_of_chunk(self, function: Callable, numbers: Any, batches: Array) -> Any:
        """`function` of the numbers of every tile of a chunk, a few tiles at a time: what that needs stays in the cache
        of a core.

        Where there are several batches of `at_once` tiles, those after the first `batches` are padding; their results
        are zero.
        """
        # jit keeps the trace that the shape takes.
        n, some = self.at_once, jax.jit(jax.vmap(function))
        count = len(jax.tree.leaves(numbers)[0]) // n
        if count == 1:
            return some(numbers)
        split = jax.tree.map(lambda v: jnp.asarray(v).reshape(count, n, *v.shape[1:]), numbers)
        group = lambda k: some(jax.tree.map(lambda v: jax.lax.dynamic_index_in_dim(v, k, keepdims=False), split))  # noqa: E731
        zero = jax.tree.map(lambda v: jnp.zeros((count, *v.shape), v.dtype), jax.eval_shape(group, 0))

        def add(k, results):
            return jax.tree.map(lambda v, new: jax.lax.dynamic_update_index_in_dim(v, new, k, 0), results, group(k))

        results = jax.lax.fori_loop(0, batches, add, zero)
        return jax.tree.map(lambda v: v.reshape(count * n, *v.shape[2:]), results)


class TiledStructure(AbstractStructure):
    """Index arrays and sizes of a block in tiles; image rows are the slots of these."""

    tiles: Tiles

    @property
    def shards(self) -> int:
        """Devices that tiles and their points are dealt out to."""
        return self.tiles.shards

    def by_tile(self, array: Shaped[Array, "*c points"]) -> Shaped[Array, "chunks tiles *c p"]:
        """Numbers of points, tile by tile."""
        n_chunks, chunk, _ = self.tiles.image.shape
        split = array.reshape(*array.shape[:-1], n_chunks, chunk, self.tiles.per_tile)
        return jnp.moveaxis(split, (-3, -2), (0, 1))

    def by_point(self, array: Float[Array, "chunks tiles *c p"]) -> Float[Array, "*c points"]:
        """The reverse of `by_tile`."""
        joined = jnp.moveaxis(array, (0, 1), (-3, -2))
        return joined.reshape(*joined.shape[:-3], math.prod(joined.shape[-3:]))

    def by_unknown(self, met: Float[Array, "chunks tiles b"]) -> Float[Array, "shared"]:
        """Sums of numbers of `Tiles.met` by shared unknown."""
        return jnp.zeros(self.n_shared).at[jnp.asarray(self.tiles.met)].add(met, mode="drop")

    def each_tile(self, function: Callable, numbers: tuple) -> Any:
        """`function` of (images, *numbers) of every tile, chunks and tiles first."""
        given = ((self.tiles.image, *numbers), self.tiles.batches)
        return jax.lax.map(lambda chunk: self.tiles.each_of_chunk(function, *chunk), given)

    @property
    def on_one_device(self) -> "TiledStructure":
        """The same for a program that no other device has a part in."""
        if self.shards == 1:
            return self
        return dataclasses.replace(self, tiles=dataclasses.replace(self.tiles, shards=1))


@shown
class TiledValues(AbstractValues):
    """The numbers of a block in tiles; empty slots have infinite sigmas."""

    xy: Float[Array, "chunks tiles 2 m p"]
    sigma_xy: Float[Array, "chunks tiles 2 m p"]


class TiledResiduals(NonImageResiduals):
    """Observed minus computed over sigma, in the slots of the tiles."""

    image: Float[Numbers, "chunks tiles 2 m p"]
