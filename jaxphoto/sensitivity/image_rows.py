"""Second derivatives of half the weighted sum of squares of image rows, listed without padding slots.

A row depends on its image and its point only through u, the point in the camera frame. It also depends on the
parameters t of its camera and on the measurement m. With J the derivatives of its two weighted residuals r by
z = (u, t, m), and U the derivatives of u by the unknowns y of the image and of the point,

    G = J'J + sum_r r d2r/dz2       H_yy = U' G_uu U + sum_k g_k d2u_k/dy2,   g = J_u' r
                                    H_ty = G_tu U,   B_ym = U' G_um,   B_tm = G_tm

G is computed by automatic differentiation along u (three directions) and a few more. A small rotation theta of the
image maps u to u + u x theta + (u x theta) x theta / 2, so

    sum_k g_k d2u_k / dtheta dy = g . (du/dy x dtheta)        for y = theta: mean of this and its transpose

The last axis of all arrays is the row axis.
"""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment, PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.camera_groups import CameraGroup, interior_of
from jaxphoto.adjustment.model.image_orientations import by_image, orientation_derivatives, orientations_of
from jaxphoto.adjustment.model.numbers import Increments, state_at
from jaxphoto.arrays import ArrayLike, sum_terms, to_numpy
from jaxphoto.collinearity import camera_residual
from jaxphoto.compiling import once
from jaxphoto.georeferencing import Corrections, apparent_point
from jaxphoto.georeferencing.corrections import NO_CORRECTIONS

Scalars = tuple[Array, ...]
"""One component of every row in each array; separate arrays let XLA vectorise over the rows."""

# Number of rows per batch.
_BATCH = 8192


class ListedRows(NamedTuple):
    """Image rows in the block's order, then at least one row of zero weight. Indices refer to the padded structure."""

    image: Int[ArrayLike, "rows"]
    point: Int[ArrayLike, "rows"]
    xy: Float[ArrayLike, "2 rows"]
    weight: Float[ArrayLike, "2 rows"]
    """1 / standard deviation (1/mm)."""
    of_slot: Int[np.ndarray, "batches chunks p"]
    """Row index of each ray; the last row for padding."""


class RowProducts(NamedTuple):
    """Sums of H over the rows, and B by the measured x and y (mm)."""

    eop: Float[Array, "images 6 6"]
    """Sums by image, not yet symmetrised."""
    shared_eop: Float[Array, "images colours 6"]
    shared: Float[Array, "images colours colours"]
    by_point: Float[Array, "touched 3 rows"]
    """H of each row by its exterior orientation (6), point (3) and camera unknowns, and by its point."""
    measured: Float[Array, "rows 2 touched"]
    """-B of each row by its exterior orientation (6), point (3) and camera unknowns."""


def image_rows(adjusted: Adjustment) -> ListedRows:
    """List the image rows of an adjustment."""
    s, places, rays = adjusted.structure, adjusted.padded.places, adjusted.padded.structure.rays
    n, size = len(s.image), _size(len(s.image) + 1)

    def pad(values: np.ndarray) -> np.ndarray:
        # Rows of zero weight repeat the first row, so all their values are finite.
        return np.concatenate([values, np.repeat(values[..., :1], size - n, axis=-1)], axis=-1)

    weight = pad(1 / to_numpy(adjusted.values.sigma_xy))
    weight[:, n:] = 0.0
    of_slot = np.full(rays.ray_point.shape, size - 1, np.int32)
    of_slot.reshape(-1)[places.row] = np.arange(n)
    image, point = places.image[s.image].astype(np.int32), places.point[s.point].astype(np.int32)
    return ListedRows(pad(image), pad(point), pad(to_numpy(adjusted.values.xy)), weight, of_slot)


def _size(rows: int) -> int:
    """Return the padded number of rows: size classes at most 1/8 apart, then multiples of the batch size."""
    step = min(1 << max((rows - 1).bit_length() - 4, 0), _BATCH) if rows <= _BATCH else _BATCH
    return -(-rows // step) * step


def row_products(
    values: PaddedValues, scale: Increments, rows: ListedRows, curved: Float[ArrayLike, ""], s: PaddedStructure
) -> RowProducts:
    """Compute H and B of all rows in scaled increments; without the terms in r if `curved` is 0."""
    count = -(-len(rows.image) // _BATCH)
    if count == 1:
        return _batch_products(values, scale, rows, curved, s)
    arrays = (rows.image, rows.point, rows.xy, rows.weight)
    split = tuple(jnp.moveaxis(jnp.reshape(v, (*v.shape[:-1], count, -1)), -2, 0) for v in arrays)

    def batch_products(batch: tuple[Array, Array, Array, Array]) -> RowProducts:
        image, point, xy, weight = batch
        return _batch_products(values, scale, ListedRows(image, point, xy, weight, rows.of_slot), curved, s)

    batches = jax.lax.map(batch_products, split)
    by_point = jnp.moveaxis(batches.by_point, 0, 2)
    return RowProducts(
        batches.eop.sum(0),
        batches.shared_eop.sum(0),
        batches.shared.sum(0),
        by_point.reshape(*by_point.shape[:2], -1),
        batches.measured.reshape(-1, *batches.measured.shape[2:]),
    )


def _batch_products(
    values: PaddedValues, scale: Increments, rows: ListedRows, curved: Float[ArrayLike, ""], s: PaddedStructure
) -> RowProducts:
    image, point = rows.image, rows.point
    q, zero = s.n_image_colours, jax.tree.map(jnp.zeros_like, scale)
    scene = orientations_of(state_at(zero, scale, values, s), values, s)
    slopes = orientation_derivatives(zero, scale, values, s)
    ends = jnp.concatenate([_at(values.position, image), _at(values.points, point)])
    rotation, image_step, point_step = _at(values.rotation, image), _at(scale.eop, image), _at(scale.points, point)
    u, du = once(partial(_camera_points, s.corrections), s.eop_free, rotation, ends, image_step, point_step)

    g, g_u = jnp.zeros(()), (jnp.zeros(()),) * 3
    for group, camera, slope in zip(s.groups, scene.cameras, slopes.cameras, strict=True):
        if by_image(group, s):
            camera, slope = camera[image].T, jnp.moveaxis(slope[image], 0, -1)
        weight = tuple(jnp.where(jnp.asarray(group.member)[image], rows.weight, 0.0))
        g_group, g_u_group = once(
            partial(_camera_second, group), s.eop_free, camera, slope, u, tuple(rows.xy), weight, curved
        )
        g, g_u = g + g_group, tuple(a + b for a, b in zip(g_u, g_u_group, strict=True))

    cross = once(lambda g, du: sum(g[k, :, None] * d for k, d in enumerate(du)), s.eop_free, g, du)
    rotated = curved * image_step[3:, None] * jnp.stack(_cross(g_u, du))
    eop = sum_terms(d[:6, None] * cross[k, None, :6] for k, d in enumerate(du))
    by_point = sum_terms(d[:, None] * cross[k, None, 6:] for k, d in enumerate(du))
    # Twice the lower triangle; it is symmetrised with the transpose later.
    eop = eop.at[3:].add(rotated[:, :6]).at[3:, :3].add(rotated[:, :3])
    by_point = by_point.at[3:6].add(rotated[:, 6:])
    if s.corrections != NO_CORRECTIONS:
        g_ray = _dot(g_u, rotation)
        bending = curved * _ray_second(s.corrections, ends, g_ray, jnp.concatenate([image_step[:3], point_step]))
        eop = eop.at[:3, :3].add(bending[:3, :3])
        by_point = by_point.at[:3].add(bending[:3, 3:]).at[6:].add(bending[3:, 3:])
    by_row = eop, cross[3 : 3 + q, :6], g[3:, 3 : 3 + q]
    sums = [jax.ops.segment_sum(v.reshape(-1, len(image)).T, image, s.n_images) for v in by_row]
    eop, shared_eop, shared = (v.reshape(s.n_images, *rows_.shape[:2]) for v, rows_ in zip(sums, by_row, strict=True))
    measured = jnp.concatenate([cross[3 + q :], g[3:, 3 + q :].swapaxes(0, 1)], axis=1)
    return RowProducts(
        eop, shared_eop, shared, jnp.concatenate([by_point, cross[3 : 3 + q, 6:]]), -measured.transpose(2, 0, 1)
    )


def _at(array: Array, index: ArrayLike) -> Array:
    return jnp.asarray(array).at[..., index].get(mode="promise_in_bounds")


def _dot(a: Iterable[Array], b: Iterable[Array]) -> Array:
    return sum_terms(x * y for x, y in zip(a, b, strict=True))


def _cross(a: Sequence[Array] | Array, b: Sequence[Array] | Array) -> Scalars:
    return tuple(a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1)))


def _camera_points(
    corrections: Corrections,
    rotation: Float[Array, "3 3 rows"],
    ends: Float[Array, "6 rows"],
    image_step: Float[Array, "6 rows"],
    point_step: Float[Array, "3 rows"],
) -> tuple[Scalars, Scalars]:
    """Return u of every row, and its derivatives (9, rows) by scaled increments of image and point."""
    ray = _rays(corrections, ends)
    u = tuple(_dot(row, ray) for row in rotation)
    by_rotation = _cross(u, jnp.eye(3)[:, :, None])
    if corrections == NO_CORRECTIONS:
        by_ends = (jnp.concatenate([-row, row]) for row in rotation)
    else:
        unit = jnp.broadcast_to(jnp.eye(6)[:, :, None], (6, *ends.shape))
        rays = jax.vmap(lambda d: jax.jvp(partial(_rays, corrections), (ends,), (d,))[1])(unit)
        by_ends = (_dot(row, rays.swapaxes(0, 1)) for row in rotation)
    du = (
        jnp.concatenate([by_end[:3] * image_step[:3], by_turn * image_step[3:], by_end[3:] * point_step])
        for by_end, by_turn in zip(by_ends, by_rotation, strict=True)
    )
    return u, tuple(du)


def _rays(corrections: Corrections, ends: Float[Array, "6 rows"]) -> Float[Array, "3 rows"]:
    """Return the vectors from the projection centres to the apparent points, in the object frame."""
    return apparent_point(ends[:3], ends[3:], corrections) - ends[:3]


def _ray_second(
    corrections: Corrections, ends: Float[Array, "6 rows"], g_ray: Float[Array, "3 rows"], step: Float[Array, "6 rows"]
) -> Float[Array, "6 6 rows"]:
    """Compute the weighted sum of second derivatives of the ray components, by scaled increments of both ends."""
    weighted = lambda ends: _dot(g_ray, _rays(corrections, ends))  # noqa: E731

    def second(seed: Array, other: Array) -> Array:
        return jax.jvp(lambda ends: jax.jvp(weighted, (ends,), (seed,))[1], (ends,), (other,))[1]

    seeds = jnp.eye(6)[:, :, None] * step
    return jax.vmap(jax.vmap(second, (None, 0)), (0, None))(seeds, seeds)


def _camera_second(
    group: CameraGroup,
    camera: Array,
    slope: Array,
    u: Scalars,
    xy: Scalars,
    weight: Scalars,
    curved: Float[ArrayLike, ""],
) -> tuple[Float[Array, "u_and_colours directions rows"], Scalars]:
    """Return G of every row, (u, t) by (u, t, m), and J_u' r."""
    q = len(slope)
    z = (*u, *(jnp.zeros_like(u[0]),) * q, *xy)
    seeds = tuple(jnp.broadcast_to(unit[:, None], (len(z), *u[0].shape)) for unit in jnp.eye(len(z)))

    def residual(z: Scalars) -> Scalars:
        leaves = list(camera)
        for k, leaf in enumerate(group.free_leaves):
            leaves[leaf] = leaves[leaf] + _dot(z[3 : 3 + q], slope[:, k])
        # Vectorise over the rows: camera models are defined for a single image point.
        by_row = jax.vmap(
            lambda parameters, u, xy: camera_residual(interior_of(group, parameters), u, xy),
            ([0 if jnp.ndim(leaf) else None for leaf in leaves], 0, -1),
            -1,
        )
        r = by_row(leaves, z[:3], jnp.stack(z[3 + q :]))
        return tuple(w * v for w, v in zip(weight, r, strict=True))

    r, j = residual(z), jax.vmap(lambda seed: jax.jvp(residual, (z,), (seed,))[1])(seeds)
    weighted = lambda z: _dot(r, residual(z))  # noqa: E731

    def second(seed: Scalars, other: Scalars) -> Array:
        return jax.jvp(lambda z: jax.jvp(weighted, (z,), (seed,))[1], (z,), (other,))[1]

    # G is symmetric: compute every pair once.
    row, column = np.triu_indices(3 + q, m=len(z))
    index = np.zeros((len(z), len(z)), int)
    index[row, column] = index[column, row] = np.arange(len(row))
    curvature = jax.vmap(second)(tuple(seed[row] for seed in seeds), tuple(seed[column] for seed in seeds))
    g = _dot((v[row] for v in j), (v[column] for v in j)) + curved * curvature
    return g[index[: 3 + q]], tuple(_dot(r, tuple(v[k] for v in j)) for k in range(3))
