"""A tile: residuals of its image rows, and their derivatives, in all its slots at once.

A row touches one image, one point and the parameters of one camera. In a tile its image is an axis and its point
another, so what depends on the image alone is computed once an image, and each column of the Jacobian is one forward
derivative of `image_residual`, mapped over both axes: nothing is gathered row by row. Arrays end in (m, p): images,
points.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.adjustment.residuals import Increments, State, Values
from jaxphoto.adjustment.structure import CameraGroup, Structure, Tiles, interior_of
from jaxphoto.collinearity import ExteriorOrientation, image_residual
from jaxphoto.georeferencing import apparent_point
from jaxphoto.rotation import small_rotation


class Scene(NamedTuple):
    """What image rows depend on besides their points, image by image."""

    centre: Float[Array, "images 3"]
    rotation: Float[Array, "images 3 3"]
    cameras: tuple[Array, ...]
    """Of each group of cameras, its parameters: (m) where the group is one camera, else (images, m)."""


class Seen(NamedTuple):
    """What was measured in a tile, with weights 1 / sigma; zero in empty slots."""

    xy: Float[Array, "2 m p"]
    weight: Float[Array, "2 m p"]
    member: tuple[Bool[Array, "m"], ...]
    """By group of cameras: whether the image's camera belongs to it."""


class Slopes(NamedTuple):
    """Derivatives of a `Scene` with respect to scaled increments."""

    centre: Float[Array, "images 3"]
    rotation: Float[Array, "images 3 3 3"]
    """The last axis is the increment's."""
    cameras: tuple[Array, ...]
    """(colours, free) where the group is one camera, else (images, colours, free)."""


class Columns(NamedTuple):
    """Weighted residuals of a tile's rows and their derivatives with respect to scaled increments."""

    residual: Float[Array, "2 m p"]
    eop: Float[Array, "6 2 m p"]
    shared: Float[Array, "colours 2 m p"]
    point: Float[Array, "3 2 m p"]


def scene_of(state: State, s: Structure) -> Scene:
    """The state, image by image."""
    cameras = []
    for g in s.groups:
        m = g.treedef.num_leaves
        table = state.shared[g.offset : g.offset + m * len(g.names)].reshape(-1, m)
        cameras.append(table[0] if len(g.names) == 1 else table[g.camera])
    return Scene(state.position.T, state.rotation.transpose(2, 0, 1), tuple(cameras))


def slopes_of(y: Increments, scale: Increments, values: Values, s: Structure) -> Slopes:
    """Derivatives of the scene at the increments `y`."""

    def turn(angles, k, start):
        return jax.jacfwd(lambda d: small_rotation((angles + d) * k) @ start)(jnp.zeros(3))

    rotation = jax.vmap(turn, in_axes=-1, out_axes=0)(y.eop[3:], scale.eop[3:], values.rotation)
    own, n = slice(0, s.n_interior), s.n_image_colours
    by_colour = jnp.zeros((len(values.shared), n)).at[s.free[own], s.colour[own]].set(scale.shared[own])
    cameras = []
    for g in s.groups:
        m = g.treedef.num_leaves
        table = by_colour[g.offset : g.offset + m * len(g.names)].reshape(len(g.names), m, n)
        table = table[:, list(g.free_leaves)].transpose(0, 2, 1)
        cameras.append(table[0] if len(g.names) == 1 else table[g.camera])
    return Slopes(scale.eop[:3].T, rotation, tuple(cameras))


def of_images(tree: Any, image: Array, s: Structure) -> Any:
    """The parts of a `Scene` or of `Slopes` that belong to a tile's images."""
    take = lambda a: a.at[image].get(mode="promise_in_bounds")  # noqa: E731
    cameras = tuple(c if len(g.names) == 1 else take(c) for g, c in zip(s.groups, tree.cameras, strict=True))
    return type(tree)(take(tree.centre), take(tree.rotation), cameras)


def seen_in(xy: Array, sigma: Array, image: Array, s: Structure) -> Seen:
    """What a tile's rows measured."""
    return Seen(xy, 1 / sigma, tuple(jnp.asarray(g.member)[image] for g in s.groups))


def rows(scene: Scene, points: Float[Array, "3 p"], seen: Seen, s: Structure) -> Float[Array, "2 m p"]:
    """Weighted residuals of a tile: observed minus computed over sigma."""
    parts = [_rows_of(g, c, scene, points, seen, s) for g, c in zip(s.groups, scene.cameras, strict=True)]
    if len(parts) == 1:
        return parts[0]
    mine = zip(seen.member, parts, strict=True)
    return sum((jnp.where(own[:, None], part, 0.0) for own, part in mine), jnp.zeros(()))


def _rows_of(g: CameraGroup, camera: Array, scene: Scene, points: Array, seen: Seen, s: Structure) -> Array:
    def one(camera, centre, rotation, point, xy, weight):
        aim = apparent_point(centre, point, s.corrections)
        # An empty slot looks straight ahead: whatever lies there, its numbers stay finite.
        aim = jnp.where(weight[0] > 0, aim, centre - rotation[2])
        exterior = ExteriorOrientation(centre, rotation)
        return image_residual(interior_of(g, list(camera)), exterior, aim, xy) * weight

    along_points = jax.vmap(one, (None, None, None, -1, -1, -1), -1)
    whose = None if camera.ndim == 1 else 0
    return jax.vmap(along_points, (whose, 0, 0, None, 1, 1), 1)(
        camera, scene.centre, scene.rotation, points, seen.xy, seen.weight
    )


def columns(
    scene: Scene, slopes: Slopes, points: Float[Array, "3 p"], scale: Float[Array, "3 p"], seen: Seen, s: Structure
) -> Columns:
    """Residuals and Jacobian of a tile."""
    free = tuple(c[..., list(g.free_leaves)] for g, c in zip(s.groups, scene.cameras, strict=True))

    def cameras_with(free):
        return tuple(
            c.at[..., list(g.free_leaves)].set(f) for g, c, f in zip(s.groups, scene.cameras, free, strict=True)
        )

    # jit keeps the trace: every derivative below uses it again.
    f = jax.jit(
        lambda free, centre, rotation, points: rows(Scene(centre, rotation, cameras_with(free)), points, seen, s)
    )

    def slope(function, x, direction):
        return jax.jvp(function, (x,), (direction,))[1]

    centre, rotation, unit = scene.centre, scene.rotation, jnp.eye(3)
    residual = f(free, centre, rotation, points)
    by_centre = jax.vmap(lambda d: slope(lambda x: f(free, x, rotation, points), centre, d * slopes.centre))(unit)
    by_rotation = jax.vmap(lambda d: slope(lambda x: f(free, centre, x, points), rotation, d), in_axes=-1)(
        slopes.rotation
    )
    by_point = jax.vmap(lambda d: slope(lambda x: f(free, centre, rotation, x), points, d[:, None] * scale))(unit)
    if s.n_image_colours:
        axes = tuple(0 if c.ndim == 2 else 1 for c in slopes.cameras)
        by_camera = jax.vmap(lambda d: slope(lambda x: f(x, centre, rotation, points), free, d), (axes,))(
            slopes.cameras
        )
    else:
        by_camera = jnp.zeros((0, *residual.shape))
    # Fused into what uses them, they would be computed again for every use.
    residual, by_centre, by_rotation, by_camera, by_point = jax.lax.optimization_barrier(
        (residual, by_centre, by_rotation, by_camera, by_point)
    )
    return Columns(residual, jnp.concatenate([by_centre, by_rotation]), by_camera, by_point)


def by_tile(array: Float[Array, "*c points"], tiles: Tiles) -> Float[Array, "chunks tiles *c p"]:
    """Numbers of points, tile by tile."""
    n_chunks, chunk, _ = tiles.image.shape
    split = array.reshape(*array.shape[:-1], n_chunks, chunk, tiles.per_tile)
    return jnp.moveaxis(split, (-3, -2), (0, 1))


def by_point(array: Float[Array, "chunks tiles *c p"]) -> Float[Array, "*c points"]:
    """The reverse of `by_tile`."""
    joined = jnp.moveaxis(array, (0, 1), (-3, -2))
    return joined.reshape(*joined.shape[:-3], -1)


def each_tile(function: Callable, numbers: Any, tiles: Tiles) -> Any:
    """`function` of every tile's numbers, a few tiles at a time: what that needs stays in the cache of a core."""
    n = tiles.at_once
    count = len(jax.tree.leaves(numbers)[0]) // n
    if count == 1:
        # As a loop would: what uses the results shall not compute them again.
        return jax.lax.optimization_barrier(jax.vmap(function)(numbers))
    if n == 1:
        return jax.lax.map(function, numbers)
    some = jax.tree.map(lambda v: v.reshape(count, n, *v.shape[1:]), numbers)
    return jax.tree.map(lambda v: v.reshape(count * n, *v.shape[2:]), jax.lax.map(jax.vmap(function), some))
