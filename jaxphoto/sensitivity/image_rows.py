"""Second derivatives of half the weighted square sum of image rows, listed as they are: no slot is empty.

A row depends on its image and its point through u alone, the point in the camera frame; besides on the parameters t of
its camera and on what was measured, m. With J the derivatives of its two weighted residuals r by z = (u, t, m), and U
those of u by the unknowns y of the image and of the point,

    G = J'J + sum_r r d2r/dz2       H_yy = U' G_uu U + sum_k g_k d2u_k/dy2,   g = J_u' r
                                    H_ty = G_tu U,   B_ym = U' G_um,   B_tm = G_tm

G by automatic differentiation, in three and a few directions. A small rotation theta of the image takes u to
u + u x theta + (u x theta) x theta / 2, so that

    sum_k g_k d2u_k / dtheta dy = g . (du/dy x dtheta)        of y = theta the mean of that and its transpose

Arrays end in the rows.
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
from jaxphoto.arrays import Numbers, added, still
from jaxphoto.collinearity import camera_residual
from jaxphoto.compiling import once
from jaxphoto.georeferencing import Corrections, apparent_point
from jaxphoto.georeferencing.corrections import NO_CORRECTIONS

Scalars = tuple[Array, ...]
"""One number of every row each. Joined to one array they would be computed number by number, not as vectors."""

# Rows that are computed with at a time.
_AT_ONCE = 8192


class ListedRows(NamedTuple):
    """Image rows in the block's order, then at least one of no weight; what they touch in a padded structure."""

    image: Int[Numbers, "rows"]
    point: Int[Numbers, "rows"]
    xy: Float[Numbers, "2 rows"]
    weight: Float[Numbers, "2 rows"]
    """1 / sigma (1/mm)."""
    of_slot: Int[np.ndarray, "batches chunks p"]
    """The row of each ray; the last one where it is none."""


class RowProducts(NamedTuple):
    """H of the rows, by what is wanted of it, and B by the measured x and y (mm)."""

    eop: Float[Array, "images 6 6"]
    """Sums by image; symmetric when the transpose is added and half of it taken."""
    shared_eop: Float[Array, "images colours 6"]
    shared: Float[Array, "images colours colours"]
    by_point: Float[Array, "touched 3 rows"]
    """Of each row's eop (6), point (3) and colours with its point."""
    measured: Float[Array, "rows 2 touched"]
    """-B of each row's eop (6), point (3) and colours."""


def image_rows(adjusted: Adjustment) -> ListedRows:
    """The image rows of an adjustment."""
    s, places, rays = adjusted.structure, adjusted.padded.places, adjusted.padded.structure.rays
    n, size = len(s.image), _size(len(s.image) + 1)

    def pad(values: np.ndarray) -> np.ndarray:
        # Rows of no weight repeat the first: whatever is computed of them stays finite.
        return np.concatenate([values, np.repeat(values[..., :1], size - n, axis=-1)], axis=-1)

    weight = pad(1 / still(adjusted.values.sigma_xy))
    weight[:, n:] = 0.0
    of_slot = np.full(rays.ray_point.shape, size - 1, np.int32)
    of_slot.reshape(-1)[places.row] = np.arange(n)
    image, point = places.image[s.image].astype(np.int32), places.point[s.point].astype(np.int32)
    return ListedRows(pad(image), pad(point), pad(still(adjusted.values.xy)), weight, of_slot)


def _size(rows: int) -> int:
    """Sizes come in classes, each at most an eighth larger than the one before; then multiples of the last."""
    step = min(1 << max((rows - 1).bit_length() - 4, 0), _AT_ONCE) if rows <= _AT_ONCE else _AT_ONCE
    return -(-rows // step) * step


def row_products(
    values: PaddedValues, scale: Increments, rows: ListedRows, curved: Float[Numbers, ""], s: PaddedStructure
) -> RowProducts:
    """H and B of all rows at the values, in scaled increments; without the terms that carry r where `curved` is 0."""
    count = -(-len(rows.image) // _AT_ONCE)
    if count == 1:
        return _of_some(values, scale, rows, curved, s)
    whole = (rows.image, rows.point, rows.xy, rows.weight)
    split = tuple(jnp.moveaxis(jnp.reshape(v, (*v.shape[:-1], count, -1)), -2, 0) for v in whole)

    def of_some(some: tuple[Array, Array, Array, Array]) -> RowProducts:
        image, point, xy, weight = some
        return _of_some(values, scale, ListedRows(image, point, xy, weight, rows.of_slot), curved, s)

    found = jax.lax.map(of_some, split)
    by_point = jnp.moveaxis(found.by_point, 0, 2)
    return RowProducts(
        found.eop.sum(0),
        found.shared_eop.sum(0),
        found.shared.sum(0),
        by_point.reshape(*by_point.shape[:2], -1),
        found.measured.reshape(-1, *found.measured.shape[2:]),
    )


def _of_some(
    values: PaddedValues, scale: Increments, rows: ListedRows, curved: Float[Numbers, ""], s: PaddedStructure
) -> RowProducts:
    image, point = rows.image, rows.point
    q, zero = s.n_image_colours, jax.tree.map(jnp.zeros_like, scale)
    scene, slopes = (
        orientations_of(state_at(zero, scale, values, s), values, s),
        orientation_derivatives(zero, scale, values, s),
    )
    ends = jnp.concatenate([_at(values.position, image), _at(values.points, point)])
    rotation, of_image, of_point = _at(values.rotation, image), _at(scale.eop, image), _at(scale.points, point)
    u, by_place = once(partial(_places, s.corrections), s.eop_free, rotation, ends, of_image, of_point)

    g, to_u = jnp.zeros(()), (jnp.zeros(()),) * 3
    for group, camera, slope in zip(s.groups, scene.cameras, slopes.cameras, strict=True):
        if by_image(group, s):
            camera, slope = camera[image].T, jnp.moveaxis(slope[image], 0, -1)
        weight = tuple(jnp.where(jnp.asarray(group.member)[image], rows.weight, 0.0))
        of_group = once(partial(_by_camera, group), s.eop_free, camera, slope, u, tuple(rows.xy), weight, curved)
        g, to_u = g + of_group[0], tuple(a + b for a, b in zip(to_u, of_group[1], strict=True))

    across = once(lambda g, by_place: sum(g[k, :, None] * d for k, d in enumerate(by_place)), s.eop_free, g, by_place)
    turned = curved * of_image[3:, None] * jnp.stack(_cross(to_u, by_place))
    eop = added(d[:6, None] * across[k, None, :6] for k, d in enumerate(by_place))
    by_point = added(d[:, None] * across[k, None, 6:] for k, d in enumerate(by_place))
    # Twice, because of the transpose: only its rows are here.
    eop = eop.at[3:].add(turned[:, :6]).at[3:, :3].add(turned[:, :3])
    by_point = by_point.at[3:6].add(turned[:, 6:])
    if s.corrections != NO_CORRECTIONS:
        to_ray = _dot(to_u, rotation)
        bent = curved * _bent_rays(s.corrections, ends, to_ray, jnp.concatenate([of_image[:3], of_point]))
        eop = eop.at[:3, :3].add(bent[:3, :3])
        by_point = by_point.at[:3].add(bent[:3, 3:]).at[6:].add(bent[3:, 3:])
    wanted = eop, across[3 : 3 + q, :6], g[3:, 3 : 3 + q]
    sums = [jax.ops.segment_sum(v.reshape(-1, len(image)).T, image, s.n_images) for v in wanted]
    own, shared_eop, shared = (
        v.reshape(s.n_images, *of_rows.shape[:2]) for v, of_rows in zip(sums, wanted, strict=True)
    )
    measured = jnp.concatenate([across[3 + q :], g[3:, 3 + q :].swapaxes(0, 1)], axis=1)
    return RowProducts(
        own, shared_eop, shared, jnp.concatenate([by_point, across[3 : 3 + q, 6:]]), -measured.transpose(2, 0, 1)
    )


def _at(array: Array, index: Numbers) -> Array:
    return jnp.asarray(array).at[..., index].get(mode="promise_in_bounds")


def _dot(a: Iterable[Array], b: Iterable[Array]) -> Array:
    return added(x * y for x, y in zip(a, b, strict=True))


def _cross(a: Sequence[Array] | Array, b: Sequence[Array] | Array) -> Scalars:
    return tuple(a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1)))


def _places(
    corrections: Corrections,
    rotation: Float[Array, "3 3 rows"],
    ends: Float[Array, "6 rows"],
    of_image: Float[Array, "6 rows"],
    of_point: Float[Array, "3 rows"],
) -> tuple[Scalars, Scalars]:
    """u of every row, and its derivatives (9, rows) by scaled increments of image and point."""
    ray = _rays(corrections, ends)
    u = tuple(_dot(row, ray) for row in rotation)
    turned = _cross(u, jnp.eye(3)[:, :, None])
    if corrections == NO_CORRECTIONS:
        moved = (jnp.concatenate([-row, row]) for row in rotation)
    else:
        unit = jnp.broadcast_to(jnp.eye(6)[:, :, None], (6, *ends.shape))
        by_ends = jax.vmap(lambda d: jax.jvp(partial(_rays, corrections), (ends,), (d,))[1])(unit)
        moved = (_dot(row, by_ends.swapaxes(0, 1)) for row in rotation)
    step = (of_image[:3], of_image[3:], of_point)
    by_place = (
        jnp.concatenate([by_end[:3] * step[0], by_turn * step[1], by_end[3:] * step[2]])
        for by_end, by_turn in zip(moved, turned, strict=True)
    )
    return u, tuple(by_place)


def _rays(corrections: Corrections, ends: Float[Array, "6 rows"]) -> Float[Array, "3 rows"]:
    """From the projection centres to where they see their points, in the object frame."""
    return apparent_point(ends[:3], ends[3:], corrections) - ends[:3]


def _bent_rays(
    corrections: Corrections, ends: Float[Array, "6 rows"], to_ray: Float[Array, "3 rows"], step: Float[Array, "6 rows"]
) -> Float[Array, "6 6 rows"]:
    """Second derivatives of the rays' components, weighted and added, by scaled increments of both ends."""
    weighed = lambda ends: _dot(to_ray, _rays(corrections, ends))  # noqa: E731

    def second(seed: Array, other: Array) -> Array:
        return jax.jvp(lambda ends: jax.jvp(weighed, (ends,), (seed,))[1], (ends,), (other,))[1]

    seeds = jnp.eye(6)[:, :, None] * step
    return jax.vmap(jax.vmap(second, (None, 0)), (0, None))(seeds, seeds)


def _by_camera(
    group: CameraGroup,
    camera: Array,
    slope: Array,
    u: Scalars,
    xy: Scalars,
    weight: Scalars,
    curved: Float[Numbers, ""],
) -> tuple[Float[Array, "u_and_colours directions rows"], Scalars]:
    """G of every row, (u, t) by (u, t, m), and J_u' r."""
    q = len(slope)
    z = (*u, *(jnp.zeros_like(u[0]),) * q, *xy)
    seeds = tuple(jnp.broadcast_to(unit[:, None], (len(z), *u[0].shape)) for unit in jnp.eye(len(z)))

    def residual(z: Scalars) -> Scalars:
        leaves = list(camera)
        for k, leaf in enumerate(group.free_leaves):
            leaves[leaf] = leaves[leaf] + _dot(z[3 : 3 + q], slope[:, k])
        # Row by row: what is written for one image point need not know of many.
        of_one = jax.vmap(
            lambda own, u, xy: camera_residual(interior_of(group, own), u, xy),
            ([0 if jnp.ndim(leaf) else None for leaf in leaves], 0, -1),
            -1,
        )
        r = of_one(leaves, z[:3], jnp.stack(z[3 + q :]))
        return tuple(w * v for w, v in zip(weight, r, strict=True))

    r, j = residual(z), jax.vmap(lambda seed: jax.jvp(residual, (z,), (seed,))[1])(seeds)
    weighed = lambda z: _dot(r, residual(z))  # noqa: E731

    def second(seed: Scalars, other: Scalars) -> Array:
        return jax.jvp(lambda z: jax.jvp(weighed, (z,), (seed,))[1], (z,), (other,))[1]

    # Every pair once: G is symmetric.
    one, other = np.triu_indices(3 + q, m=len(z))
    number = np.zeros((len(z), len(z)), int)
    number[one, other] = number[other, one] = np.arange(len(one))
    bent = jax.vmap(second)(tuple(seed[one] for seed in seeds), tuple(seed[other] for seed in seeds))
    g = _dot((v[one] for v in j), (v[other] for v in j)) + curved * bent
    return g[number[: 3 + q]], tuple(_dot(r, tuple(v[k] for v in j)) for k in range(3))
