"""Gradients of many adjustments of one block.

Adjustments that differ only in their values (draws) are computed together. The last axis runs over the draws, so the
values of an image row are contiguous. Unlike the rays of a single adjustment (`adjustment.layout`) there are no empty
slots: image rows are listed, and contiguous values are gathered and scattered in chunks that fit in the cache of a
core.

With u the point of an image row in the camera frame and q half the sum of its squared weighted residuals,

    dq/d(image) = (du/d(image))' dq/du,    dq/d(point) = (du/d(point))' dq/du,    dq/d(camera)

by automatic differentiation of the model of one row. Each is stored before it is summed: XLA would recompute fused
terms for every result that uses them.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment.layout.padded import PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.camera_groups import CameraGroup, interior_of
from jaxphoto.adjustment.model.image_orientations import cameras_at
from jaxphoto.adjustment.model.numbers import Increments, UnknownArrays, state_at
from jaxphoto.adjustment.model.row_functions import non_image_residuals
from jaxphoto.adjustment.row_lists import RowList
from jaxphoto.adjustment.solver.elimination import FactoredNormal, solve_factored
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.arrays import ArrayLike, sum_terms
from jaxphoto.collinearity import ExteriorOrientation, camera_coordinates, camera_residual
from jaxphoto.compiling import once
from jaxphoto.georeferencing import apparent_point
from jaxphoto.georeferencing.corrections import NO_CORRECTIONS
from jaxphoto.rotation import rotate

Varying = dict[str, Array]
"""Leaves of `Values`, by `path_name`, that differ between draws (last axis); `xy` and `sigma_xy` by row of the block.
"""


class Common(eqx.Module):
    """Data common to all draws, padded. `xy` and `sigma_xy` have one column per image row of the block."""

    at: Linearised
    """Nominal optimum, the start of all draws."""
    factored: FactoredNormal
    xy: Float[ArrayLike, "2 rows"]
    sigma_xy: Float[ArrayLike, "2 rows"]
    lists: tuple[RowList, ...]

    @property
    def values(self) -> PaddedValues:
        """Nominal values."""
        return self.at.values

    @property
    def scale(self) -> Increments:
        """Scale of the increments."""
        return self.at.scale

    @property
    def structure(self) -> PaddedStructure:
        """Structure of the nominal adjustment."""
        return self.at.structure

    def solve(self, b: Increments) -> Increments:
        """Solve N x = b with the nominal N; use `jax.vmap` for many right-hand sides."""
        return solve_factored(self.factored.reduced, self.factored.factor, b, self.at)


def held_in(structure: PaddedStructure, parameters: int) -> dict[str, np.ndarray]:
    """Return masks of fixed values by leaf of `Values` with start values: draws differ only in fixed ones."""
    s = structure
    return {
        "position": s.eop_free[:3] == 0,
        "rotation": (s.eop_free[3:] == 0).all(axis=0),
        "shared": ~np.isin(np.arange(parameters), s.free),
        "points": s.point_free == 0,
    }


def states(y: Increments, varying: Varying, common: Common) -> UnknownArrays:
    """Return the unknowns of every draw at its increments, draws last."""

    def one(y: Increments, varying: Varying) -> UnknownArrays:
        return state_at(y, common.scale, _values_with(varying, common), common.structure)

    return jax.vmap(one, -1, -1)(y, varying)


def other_gradients(y: Increments, varying: Varying, common: Common) -> Increments:
    """Return the part of J'r of all rows except image rows, draws last."""

    def one(y: Increments, varying: Varying) -> Increments:
        values = _values_with(varying, common)
        r, jt_product = jax.vjp(lambda y: non_image_residuals(y, common.scale, values, common.structure), y)
        return jt_product(r)[0]

    return jax.vmap(one, -1, -1)(y, varying)


def image_gradients(y: Increments, varying: Varying, common: Common) -> Increments:
    """Return the part of J'r of the image rows, draws last."""
    state, jt_product = jax.vjp(lambda y: states(y, varying, common), y)
    xy, sigma = (jnp.asarray(varying.get(name, getattr(common, name))) for name in ("xy", "sigma_xy"))
    cotangent = jax.tree.map(jnp.zeros_like, state)
    bent, pull_bent = None, None
    if common.structure.modifies_interior:
        bent, pull_bent = jax.vjp(lambda shared: _bent_cameras(shared, varying, common), state.shared)
    of_images = []
    for k, (group, rows) in enumerate(zip(common.structure.groups, common.lists, strict=True)):
        by_image = None if bent is None else bent[k]
        of_group, of_bent = _group_cotangent(group, rows, state, by_image, (xy, sigma), common.structure)
        of_images.append(of_bent)
        cotangent = jax.tree.map(jnp.add, cotangent, of_group)
    if pull_bent is not None:
        cotangent = cotangent._replace(shared=cotangent.shared + pull_bent(tuple(of_images))[0])
    return jt_product(cotangent)[0]


def _bent_cameras(shared: Float[Array, "parameters draws"], varying: Varying, common: Common) -> tuple[Array, ...]:
    """Return the parameters of each camera group by image (images, m, draws), including declared modifications."""
    return jax.vmap(
        lambda shared, varying: cameras_at(shared, _values_with(varying, common), common.structure), (-1, -1), -1
    )(shared, varying)


def _values_with(varying: Varying, common: Common) -> PaddedValues:
    def of_draw(path: Any, nominal: Any) -> Any:
        name = path_name(path)
        # Image rows are not padded here; their parameters are not needed.
        return nominal if name in ("xy", "sigma_xy") else varying.get(name, nominal)

    return jax.tree_util.tree_map_with_path(of_draw, common.values)


def path_name(path: Any) -> str:
    """Return the name of a leaf of `Values`, such as `shared` and `groups[0].listed.value`."""
    return jax.tree_util.keystr(path)[1:]


def _each_row(function: Callable, *arrays: Any) -> Any:
    """Map `function` over rows (first axis) and draws (last axis)."""
    return jax.vmap(jax.vmap(function, -1, -1))(*arrays)


class _Sums(NamedTuple):
    """Sums over the image rows of a group: derivatives of the sum of q, draws last."""

    centre: Float[Array, "images 3 draws"]
    turn: Float[Array, "images 3 draws"]
    cameras: Float[Array, "owners m draws"]
    """By camera of the group; by image if declared parameters modify it."""
    points: Float[Array, "points 3 draws"]


def _group_cotangent(
    group: CameraGroup,
    rows: RowList,
    state: UnknownArrays,
    bent: Array | None,
    seen: tuple[Array, Array],
    s: PaddedStructure,
) -> tuple[UnknownArrays, Array]:
    """Differentiate the sum of q over the rows of a group with respect to the state and to `bent`.

    `bent` contains the camera parameters by image if declared parameters modify them; derivatives by the state's camera
    parameters are then zero.
    """
    n, size = state.position.shape[1:]
    of_images = jnp.concatenate([state.rotation.reshape(9, n, size), state.position]).transpose(1, 0, 2)
    of_points = state.points.transpose(1, 0, 2)
    nothing = jnp.zeros((n, 3, size))
    m, cameras = group.treedef.num_leaves, len(group.names)
    own = slice(group.offset, group.offset + m * cameras)
    table = state.shared[own].reshape(cameras, m, size) if bent is None else bent
    zero = _Sums(nothing, nothing, jnp.zeros_like(table), jnp.zeros_like(of_points))
    if bent is not None:
        # Treat each image as a separate camera.
        rows = eqx.tree_at(lambda r: r.camera, rows, rows.image)

    def add(sums: _Sums, rows: RowList) -> tuple[_Sums, None]:
        return _with_chunk(sums, group, rows, of_images, of_points, table, seen, s), None

    sums, _ = jax.lax.scan(add, zero, rows)
    # Project the cotangent of a rotation matrix R onto its changes -t x R.
    rotation = -0.5 * jnp.cross(sums.turn.transpose(1, 0, 2)[:, None], state.rotation, axis=0)
    shared = jnp.zeros_like(state.shared)
    if bent is None:
        shared = shared.at[own].set(sums.cameras.reshape(-1, size))
    of_state = UnknownArrays(sums.centre.transpose(1, 0, 2), rotation, shared, sums.points.transpose(1, 0, 2))
    return of_state, sums.cameras


def _with_chunk(
    sums: _Sums,
    group: CameraGroup,
    rows: RowList,
    of_images: Float[Array, "images 12 draws"],
    of_points: Float[Array, "points 3 draws"],
    table: Float[Array, "owners m draws"],
    seen: tuple[Array, Array],
    s: PaddedStructure,
) -> _Sums:
    """Add the sums of one chunk of rows."""
    rotation_of = lambda image: image[:9].reshape(3, 3)  # noqa: E731

    def aim_of(image, point):
        return apparent_point(image[9:], point, s.corrections)

    def from_place(image, point):
        return tuple(camera_coordinates(ExteriorOrientation(image[9:], rotation_of(image)), aim_of(image, point)))

    def back_to_aim(image, to_u):
        """Differentiate with respect to the point that the ray aims at, in the object frame."""
        here = lambda aim: tuple(rotate(rotation_of(image), aim))  # noqa: E731
        return jax.linear_transpose(here, jnp.zeros(3))(to_u)[0]

    def back_to_turn(u, to_u):
        """Differentiate with respect to a small rotation t of the image, which adds u x t to u."""

        def turned(t):
            return u[1] * t[2] - u[2] * t[1], u[2] * t[0] - u[0] * t[2], u[0] * t[1] - u[1] * t[0]

        return jax.linear_transpose(turned, jnp.zeros(3))(to_u)[0]

    def back_to_place(image, point, to_aim):
        _, jt_product = jax.vjp(lambda centre, point: apparent_point(centre, point, s.corrections), image[9:], point)
        return jt_product(to_aim)

    u = once(
        lambda i, p: _each_row(from_place, _at(i, rows.image), _at(p, rows.point)), s.eop_free, of_images, of_points
    )
    xy, sigma = (v[:, rows.row] for v in seen)
    weight = jnp.expand_dims(rows.counts, range(1, sigma.ndim - 1)) / sigma
    to_chosen, to_u = _camera_cotangent(group, rows, table, u, (xy, weight), s)
    to_aim = once(lambda i, to_u: _each_row(back_to_aim, _at(i, rows.image), to_u), s.eop_free, of_images, to_u)
    to_centre, to_point = 0.0, to_aim
    if s.corrections != NO_CORRECTIONS:
        to_centre, to_point = _each_row(back_to_place, _at(of_images, rows.image), _at(of_points, rows.point), to_aim)
    return _Sums(
        sums.centre.at[rows.image].add(to_centre - to_aim),
        sums.turn.at[rows.image].add(_each_row(back_to_turn, u, to_u)),
        sums.cameras + to_chosen,
        sums.points.at[rows.point].add(to_point, indices_are_sorted=True),
    )


def _units(of: tuple[Array, ...]) -> list[tuple[Array, ...]]:
    """Return the unit vectors of the space of a tuple of scalars, as tuples."""
    return [tuple(jnp.ones(()) if j == k else jnp.zeros(()) for j in range(len(of))) for k in range(len(of))]


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return sum_terms(x * y for x, y in zip(a, b, strict=True))


def _at(array: Array, index: ArrayLike) -> Array:
    return array.at[index].get(mode="promise_in_bounds")


def _camera_cotangent(
    group: CameraGroup,
    rows: RowList,
    table: Float[Array, "owners m draws"],
    u: tuple[Array, ...],
    seen: tuple[Array, Array],
    s: PaddedStructure,
) -> tuple[Array, tuple[Array, ...]]:
    """Return dq/d(table), summed over the rows of a group, and dq/du of each row."""
    cameras, m = table.shape[:2]
    # One camera: its parameters are the same for all rows.
    leaves = [table[rows.camera, k] if cameras > 1 else table[0, k] for k in range(m)]
    chosen = tuple(leaves[k] for k in group.free_leaves)

    def residual(chosen, u, leaves, xy) -> tuple[Array, ...]:
        for k, leaf in zip(group.free_leaves, chosen, strict=True):
            leaves = [*leaves[:k], leaf, *leaves[k + 1 :]]
        return tuple(camera_residual(interior_of(group, leaves), u, xy))

    def weighed(chosen, u, leaves, xy, weight):
        return tuple(w * w * r for w, r in zip(weight, residual(chosen, u, leaves, xy), strict=True))

    # Use forward derivatives of two components with respect to a few scalars: less than half the work of reverse mode.
    def back(function: Callable, at: tuple[Array, ...], to_residual) -> tuple[Array, ...]:
        along = (jax.jvp(function, (at,), (unit,))[1] for unit in _units(at))
        return tuple(_dot(to_residual, slope) for slope in along)

    def back_to_camera(chosen, u, leaves, xy, to_residual):
        return back(lambda chosen: residual(chosen, u, leaves, xy), chosen, to_residual)

    def back_to_u(chosen, u, leaves, xy, to_residual):
        return back(lambda u: residual(chosen, u, leaves, xy), u, to_residual)

    of_camera = 0 if cameras > 1 else None
    xy_last, weight_last = (-1 if v.ndim == 3 else None for v in seen)

    def each(function: Callable, last_axis: int | None, row_axis: int) -> Callable:
        of_draws = jax.vmap(function, (-1, -1, -1, xy_last, last_axis), -1)
        return jax.vmap(of_draws, (of_camera, 0, of_camera, 1, row_axis))

    given = chosen, u, leaves, seen[0]
    to_residual = once(each(weighed, weight_last, 1), s.eop_free, *given, seen[1])
    to_chosen, to_u = (once(each(by, -1, 0), s.eop_free, *given, to_residual) for by in (back_to_camera, back_to_u))
    cotangent = jnp.zeros_like(table)
    for k, of_rows in zip(group.free_leaves, to_chosen, strict=True):
        if cameras > 1:
            summed = jax.ops.segment_sum(of_rows, rows.camera, cameras)
        else:
            # Many times faster than a sum along the first axis.
            summed = jnp.ones((1, len(of_rows))) @ of_rows
        cotangent = cotangent.at[:, k].set(summed)
    return cotangent, to_u
