"""Orientation and camera parameters of each image, on which image rows depend, and their derivatives."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.model.camera_groups import CameraGroup, interior_of
from jaxphoto.adjustment.model.numbers import AbstractValues, Increments, UnknownArrays
from jaxphoto.adjustment.model.structure import AbstractStructure
from jaxphoto.arrays import sum_terms
from jaxphoto.georeferencing import Exposure
from jaxphoto.rotation import small_rotation


class ImageOrientations(NamedTuple):
    """Orientation and camera parameters by image."""

    centre: Float[Array, "images 3"]
    rotation: Float[Array, "images 3 3"]
    cameras: tuple[Array, ...]
    """Parameters of each camera group: (m) for a single unmodified camera, else (images, m)."""


class OrientationDerivatives(NamedTuple):
    """Derivatives of `ImageOrientations` with respect to scaled increments."""

    centre: Float[Array, "images 3"]
    rotation: Float[Array, "images 3 3 3"]
    """The last axis runs over the increments."""
    cameras: tuple[Array, ...]
    """(colours, free) where parameters are (m), else (images, colours, free)."""


def orientations_of(state: UnknownArrays, values: AbstractValues, s: AbstractStructure) -> ImageOrientations:
    """Evaluate orientations and camera parameters of all images at `state`."""
    return ImageOrientations(
        state.position.T, state.rotation.transpose(2, 0, 1), cameras_at(jnp.asarray(state.shared), values, s)
    )


def cameras_at(shared: Array, values: AbstractValues, s: AbstractStructure) -> tuple[Array, ...]:
    """Evaluate the camera parameters (see `ImageOrientations`), including declared modifications."""
    cameras = []
    for g in s.groups:
        m = g.treedef.num_leaves
        table = shared[g.offset : g.offset + m * len(g.names)].reshape(-1, m)
        cameras.append(_bent(g, table[g.camera], shared, values, s) if by_image(g, s) else table[0])
    return tuple(cameras)


def _bent(
    g: CameraGroup, cameras: Float[Array, "images m"], shared: Array, v: AbstractValues, s: AbstractStructure
) -> Array:
    if not s.modifies_interior:
        return cameras
    bending = [
        (jax.tree.map(lambda p, t=t: p[..., t.of_image], t.all_owners(shared))) for t in s.tables if t.modifies_interior
    ]

    def one(camera: Array, parameters: list, *exposure: Array) -> Array:
        interior = interior_of(g, list(camera))
        for own in parameters:
            interior = own.interior(interior, Exposure(*exposure))
        return jnp.stack([jnp.asarray(leaf, float) for leaf in jax.tree.leaves(interior)])

    return jax.vmap(one, (0, -1, *[-1] * len(v.exposures)))(cameras, bending, *v.exposures)


def by_image(g: CameraGroup, s: AbstractStructure) -> bool:
    """Return True if the parameters of a camera group are stored by image."""
    return s.modifies_interior or len(g.names) > 1


def orientation_derivatives(
    y: Increments, scale: Increments, values: AbstractValues, s: AbstractStructure
) -> OrientationDerivatives:
    """Differentiate orientations and camera parameters at the increments `y`."""

    turned = jax.vmap(jax.jacfwd(small_rotation), in_axes=-1, out_axes=-1)(y.eop[3:] * scale.eop[3:]) * scale.eop[3:]
    # Expand the products: a batch of 3 x 3 matrix products takes several times as long.
    rotation = sum_terms(turned[:, j, None] * values.rotation[j, :, None] for j in range(3))
    rotation = rotation.transpose(3, 0, 1, 2)
    own, n = slice(0, s.n_interior), s.n_image_colours
    by_colour = jnp.zeros((len(values.shared), n)).at[s.free[own], s.colour[own]].set(scale.shared[own])
    cameras = []
    if s.modifies_interior:
        shared = jnp.asarray(values.shared).at[s.free].add(y.shared * scale.shared, unique_indices=True)
        # One product per colour: an image has one owner per kind, so parameters of other owners do not contribute.
        along = jax.vmap(lambda d: jax.jvp(lambda p: cameras_at(p, values, s), (shared,), (d,))[1], -1, 1)(by_colour)
        cameras = [c[..., list(g.free_leaves)] for g, c in zip(s.groups, along, strict=True)]
    else:
        for g in s.groups:
            m = g.treedef.num_leaves
            table = by_colour[g.offset : g.offset + m * len(g.names)].reshape(len(g.names), m, n)
            table = table[:, list(g.free_leaves)].transpose(0, 2, 1)
            cameras.append(table[0] if len(g.names) == 1 else table[g.camera])
    return OrientationDerivatives(scale.eop[:3].T, rotation, tuple(cameras))


def of_images(tree: Any, image: Array, s: AbstractStructure) -> Any:
    """Select the entries of `ImageOrientations` or `OrientationDerivatives` that belong to the images of chunks."""
    take = lambda a: a.at[image].get(mode="promise_in_bounds")  # noqa: E731
    cameras = tuple(take(c) if by_image(g, s) else c for g, c in zip(s.groups, tree.cameras, strict=True))
    return type(tree)(take(tree.centre), take(tree.rotation), cameras)
