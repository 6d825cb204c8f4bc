"""A tile: residuals of its image rows, and their derivatives, in all its slots at once.

A row touches one image, one point and the parameters of one camera. In a tile its image is an axis and its point
another, so what depends on the image alone is computed once an image, and each column of the Jacobian is one forward
derivative of `image_residual`, mapped over both axes: nothing is gathered row by row. Arrays end in (m, p): images,
points.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxphoto.adjustment.residuals import Increments, State, Values
from jaxphoto.adjustment.structure import CameraGroup, Structure, Tiles, interior_of
from jaxphoto.collinearity import ExteriorOrientation, camera_coordinates, camera_residual
from jaxphoto.georeferencing import Exposure, apparent_point
from jaxphoto.rotation import small_rotation


class Scene(NamedTuple):
    """What image rows depend on besides their points, image by image."""

    centre: Float[Array, "images 3"]
    rotation: Float[Array, "images 3 3"]
    cameras: tuple[Array, ...]
    """Of each group of cameras, its parameters: (m) where it is one camera that nothing bends, else (images, m)."""


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
    """(colours, free) where parameters are (m), else (images, colours, free)."""


Pair = tuple[Float[Array, "m p"], Float[Array, "m p"]]
"""Of a tile's rows, x and y. Joined to one array they would be computed number by number, not as vectors."""


Triple = tuple[Float[Array, "m p"], Float[Array, "m p"], Float[Array, "m p"]]
"""The three coordinates of a tile's points in its cameras' frames."""


class Columns(NamedTuple):
    """Weighted residuals of a tile's rows, x or y, and their derivatives with respect to scaled increments."""

    residual: Float[Array, "m p"]
    eop: Float[Array, "6 m p"]
    shared: Float[Array, "colours m p"]
    point: Float[Array, "3 m p"]


def scene_of(state: State, values: Values, s: Structure) -> Scene:
    """The state, image by image."""
    return Scene(state.position.T, state.rotation.transpose(2, 0, 1), _cameras_at(jnp.asarray(state.shared), values, s))


def _cameras_at(shared: Array, values: Values, s: Structure) -> tuple[Array, ...]:
    """The parameters of the cameras (see `Scene`), bent by what is declared to bend them."""
    cameras = []
    for g in s.groups:
        m = g.treedef.num_leaves
        table = shared[g.offset : g.offset + m * len(g.names)].reshape(-1, m)
        cameras.append(_bent(g, table[g.camera], shared, values, s) if by_image(g, s) else table[0])
    return tuple(cameras)


def _bent(g: CameraGroup, cameras: Float[Array, "images m"], shared: Array, v: Values, s: Structure) -> Array:
    if not s.bends:
        return cameras
    bending = [(jax.tree.map(lambda p, t=t: p[..., t.of_image], t.all_owners(shared))) for t in s.tables if t.bends]

    def one(camera: Array, parameters: list, *exposure: Array) -> Array:
        interior = interior_of(g, list(camera))
        for own in parameters:
            interior = own.interior(interior, Exposure(*exposure))
        return jnp.stack([jnp.asarray(leaf, float) for leaf in jax.tree.leaves(interior)])

    return jax.vmap(one, (0, -1, *[-1] * 5))(cameras, bending, v.time, v.velocity, v.rate, v.nominal, v.flight_time)


def by_image(g: CameraGroup, s: Structure) -> bool:
    """Whether the parameters of a group of cameras are listed by image."""
    return s.bends or len(g.names) > 1


def slopes_of(y: Increments, scale: Increments, values: Values, s: Structure) -> Slopes:
    """Derivatives of the scene at the increments `y`."""

    turned = jax.vmap(jax.jacfwd(small_rotation), in_axes=-1, out_axes=-1)(y.eop[3:] * scale.eop[3:]) * scale.eop[3:]
    # Term by term: a batch of products of 3 x 3 matrices takes several times as long.
    rotation = sum((turned[:, j, None] * values.rotation[j, :, None] for j in range(3)), jnp.zeros(()))
    rotation = rotation.transpose(3, 0, 1, 2)
    own, n = slice(0, s.n_interior), s.n_image_colours
    by_colour = jnp.zeros((len(values.shared), n)).at[s.free[own], s.colour[own]].set(scale.shared[own])
    cameras = []
    if s.bends:
        shared = jnp.asarray(values.shared).at[s.free].add(y.shared * scale.shared, unique_indices=True)
        # A product for each colour: an image has one owner of each kind, so nothing of another's comes in.
        along = jax.vmap(lambda d: jax.jvp(lambda p: _cameras_at(p, values, s), (shared,), (d,))[1], -1, 1)(by_colour)
        cameras = [c[..., list(g.free_leaves)] for g, c in zip(s.groups, along, strict=True)]
    else:
        for g in s.groups:
            m = g.treedef.num_leaves
            table = by_colour[g.offset : g.offset + m * len(g.names)].reshape(len(g.names), m, n)
            table = table[:, list(g.free_leaves)].transpose(0, 2, 1)
            cameras.append(table[0] if len(g.names) == 1 else table[g.camera])
    return Slopes(scale.eop[:3].T, rotation, tuple(cameras))


def of_images(tree: Any, image: Array, s: Structure) -> Any:
    """The parts of a `Scene` or of `Slopes` that belong to a tile's images."""
    take = lambda a: a.at[image].get(mode="promise_in_bounds")  # noqa: E731
    cameras = tuple(take(c) if by_image(g, s) else c for g, c in zip(s.groups, tree.cameras, strict=True))
    return type(tree)(take(tree.centre), take(tree.rotation), cameras)


def seen_in(xy: Array, sigma: Array, image: Array, s: Structure) -> Seen:
    """What a tile's rows measured."""
    return Seen(xy, 1 / sigma, tuple(jnp.asarray(g.member)[image] for g in s.groups))


def rows(scene: Scene, points: Float[Array, "3 p"], seen: Seen, s: Structure) -> Pair:
    """Weighted residuals of a tile: observed minus computed over sigma."""
    return _residuals(
        [_leaves_of(c) for c in scene.cameras], _in_cameras(scene.centre, scene.rotation, points, seen, s), seen, s
    )


def _in_cameras(centre: Array, rotation: Array, points: Array, seen: Seen, s: Structure) -> Triple:
    """Points in the frames of a tile's cameras."""

    def one(centre, rotation, point, weight):
        aim = apparent_point(centre, point, s.corrections)
        # An empty slot looks straight ahead: whatever lies there, its numbers stay finite.
        aim = jnp.where(weight > 0, aim, centre - rotation[2])
        u, v, w = camera_coordinates(ExteriorOrientation(centre, rotation), aim)
        return u, v, w

    along_points = jax.vmap(one, (None, None, -1, -1), -1)
    return jax.vmap(along_points, (0, 0, None, 0))(centre, rotation, points, seen.weight[0])


def _leaves_of(camera: Array) -> list[Array]:
    return list(jnp.moveaxis(camera, -1, 0))


def _residuals(cameras: list[list[Array]], in_camera: Triple, seen: Seen, s: Structure) -> Pair:
    parts = [_residuals_of(g, c, in_camera, seen) for g, c in zip(s.groups, cameras, strict=True)]
    if len(parts) == 1:
        return parts[0]
    x, y = (
        sum((jnp.where(own[:, None], v, 0.0) for own, v in zip(seen.member, of_groups, strict=True)), jnp.zeros(()))
        for of_groups in zip(*parts, strict=True)
    )
    return x, y


def _residuals_of(g: CameraGroup, camera: list[Array], in_camera: Triple, seen: Seen) -> Pair:
    def one(camera, in_camera, xy, weight):
        x, y = camera_residual(interior_of(g, camera), in_camera, xy)
        return x * weight[0], y * weight[1]

    along_points = jax.vmap(one, (None, -1, -1, -1), -1)
    whose = None if camera[0].ndim == 0 else 0
    return jax.vmap(along_points, (whose, 0, 1, 1))(camera, in_camera, seen.xy, seen.weight)


def columns(
    scene: Scene, slopes: Slopes, points: Float[Array, "3 p"], scale: Float[Array, "3 p"], seen: Seen, s: Structure
) -> tuple[Columns, Columns]:
    """Residuals and Jacobian of a tile, x and y."""
    return once(partial(_columns, s=s), s, scene, slopes, points, scale, seen)


def once(function: Callable, s: Structure, *given: Any) -> Any:
    """`function(*given)`, computed once: XLA on a CPU fuses what is cheap into all that uses it, barriers or not.

    It leaves a branch alone that may not be taken; that this one always is, XLA cannot know.
    """
    # jit keeps the trace that the shape takes.
    function = jax.jit(function)
    shape = jax.eval_shape(function, *given)
    nothing = lambda *_: jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), shape)  # noqa: E731
    return jax.lax.cond(jnp.asarray(s.eop_free)[0, 0] >= 0, function, nothing, *given)


def _columns(
    scene: Scene, slopes: Slopes, points: Float[Array, "3 p"], scale: Float[Array, "3 p"], seen: Seen, s: Structure
) -> tuple[Columns, Columns]:
    """By the chain rule: through the points in the cameras' frames, three numbers a slot."""
    centre, rotation, unit = scene.centre, scene.rotation, jnp.eye(3)
    # One loop for all six: joined afterwards, they would be computed number by number.
    still, turns = jnp.zeros((3, *rotation.shape)), jnp.moveaxis(slopes.rotation, -1, 0)
    seeds = jnp.concatenate([unit[:, None] * slopes.centre, still[:, :, 0]]), jnp.concatenate([still, turns])
    # jit keeps the trace: every derivative below uses it again.
    place = jax.jit(partial(_in_cameras, seen=seen, s=s))
    by_eop = _slope(lambda *x: place(*x, points), centre, rotation)(*seeds)
    by_point = _by_point(lambda x: place(centre, rotation, x), points, scale, s)
    residual, by_place, by_camera = once(
        partial(_camera_columns, s=s), s, scene.cameras, slopes.cameras, place(centre, rotation, points), seen
    )

    def of_one(k: int) -> Columns:
        eop, point = (
            sum((b[k] * v for b, v in zip(by_place, moved, strict=True)), jnp.zeros(())) for moved in (by_eop, by_point)
        )
        return Columns(residual[k], eop, by_camera[k], point)

    return of_one(0), of_one(1)


def _by_point(place: Callable, points: Float[Array, "3 p"], scale: Float[Array, "3 p"], s: Structure):
    """Derivatives of the places in the cameras' frames by the points' coordinates; none where all are fixed."""
    if not s.in_tiles.free_points:
        return tuple(jnp.zeros((3, *v.shape)) for v in jax.eval_shape(place, points))
    return _slope(place, points)(jnp.eye(3)[:, :, None] * scale)


def _camera_columns(cameras: tuple[Array, ...], slopes: tuple[Array, ...], in_camera: Triple, seen: Seen, s: Structure):
    """Residuals, and their derivatives by the point in the camera's frame and by the cameras' unknowns."""
    leaves = [_leaves_of(c) for c in cameras]
    # Only what is free: derivatives of the rest would be computed, though they are zero.
    free = [[own[k] for k in g.free_leaves] for g, own in zip(s.groups, leaves, strict=True)]

    def with_free(free):
        new = [dict(zip(g.free_leaves, f, strict=True)) for g, f in zip(s.groups, free, strict=True)]
        return [[of_group.get(k, v) for k, v in enumerate(own)] for of_group, own in zip(new, leaves, strict=True)]

    f = jax.jit(lambda free, in_camera: _residuals(with_free(free), in_camera, seen, s))

    def along(k: int) -> Pair:
        move = lambda x: f(free, (*in_camera[:k], x, *in_camera[k + 1 :]))  # noqa: E731
        return jax.jvp(move, (in_camera[k],), (jnp.ones_like(in_camera[k]),))[1]

    by_camera = (jnp.zeros((0, *in_camera[0].shape)),) * 2
    if s.n_image_colours:
        by_camera = _slope(lambda x: f(x, in_camera), free)([_leaves_of(jnp.moveaxis(c, -2, 0)) for c in slopes])
    return f(free, in_camera), tuple(map(along, range(3))), by_camera


def _slope(function: Callable, *x: Any) -> Callable:
    """Directions, along a leading axis, to derivatives of `function` at `x`."""
    return jax.vmap(lambda *d: jax.jvp(function, x, d)[1])


def by_tile(array: Float[Array, "*c points"], tiles: Tiles) -> Float[Array, "chunks tiles *c p"]:
    """Numbers of points, tile by tile."""
    n_chunks, chunk, _ = tiles.image.shape
    split = array.reshape(*array.shape[:-1], n_chunks, chunk, tiles.per_tile)
    return jnp.moveaxis(split, (-3, -2), (0, 1))


def by_point(array: Float[Array, "chunks tiles *c p"]) -> Float[Array, "*c points"]:
    """The reverse of `by_tile`."""
    joined = jnp.moveaxis(array, (0, 1), (-3, -2))
    return joined.reshape(*joined.shape[:-3], math.prod(joined.shape[-3:]))


def each_tile(function: Callable, numbers: Any, groups: Array, tiles: Tiles) -> Any:
    """`function` of every tile's numbers, a few tiles at a time: what that needs stays in the cache of a core.

    Where there are several groups of `at_once` tiles, those after the first `groups` are padding; their results are
    zero.
    """
    # jit keeps the trace that the shape takes.
    n, some = tiles.at_once, jax.jit(jax.vmap(function))
    count = len(jax.tree.leaves(numbers)[0]) // n
    if count == 1:
        return some(numbers)
    split = jax.tree.map(lambda v: jnp.asarray(v).reshape(count, n, *v.shape[1:]), numbers)
    group = lambda k: some(jax.tree.map(lambda v: jax.lax.dynamic_index_in_dim(v, k, keepdims=False), split))  # noqa: E731
    zero = jax.tree.map(lambda v: jnp.zeros((count, *v.shape), v.dtype), jax.eval_shape(group, 0))

    def add(k, results):
        return jax.tree.map(lambda v, new: jax.lax.dynamic_update_index_in_dim(v, new, k, 0), results, group(k))

    results = jax.lax.fori_loop(0, groups, add, zero)
    return jax.tree.map(lambda v: v.reshape(count * n, *v.shape[2:]), results)
