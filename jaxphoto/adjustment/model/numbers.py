"""Arrays of an adjustment: observations, start values, increments, unknowns, residuals.

Increments are scaled and small: `unknown = start (+) scale * increment`; rotations change by a small rotation in the
camera frame. Arrays are batch-last (components first, rows last), which XLA vectorises best on a CPU. Image rows are
evaluated in chunks of rays of one image (`solver.ray_rows`), all other rows by group (`row_functions`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.model.observed_groups import RowsAtPoints, RowsInList
from jaxphoto.adjustment.model.structure import AbstractStructure, total
from jaxphoto.arrays import ArrayLike, sum_terms
from jaxphoto.rotation import small_rotation
from jaxphoto.short_repr import pretty_repr

IMAGE_POINTS = "image_points"
"""Name of the image rows in tables and files."""


class Increments(NamedTuple):
    """Scaled changes of the unknowns from the start values: the iterate of the solver."""

    eop: Float[Array, "6 images"]
    shared: Float[Array, "shared"]
    points: Float[Array, "3 points"]


class NonImageResiduals(eqx.Module):
    """Residuals (observed minus computed, over sigma) of all groups except image rows; `datum` contains the datum
    constraints.

    In padded sizes: (components, rows), or (components, rows, points) for rows stored by point. In a result, a group
    with scalar rows has shape (rows).
    """

    others: tuple[Float[ArrayLike, "..."], ...]
    datum: Float[ArrayLike, "constraints"]
    names: tuple[str, ...] = eqx.field(static=True)
    """Names of the groups in `others`."""


@pretty_repr
class Residuals(NonImageResiduals):
    """Residuals (observed minus computed, over sigma) by group, in the order of the block."""

    image: Float[ArrayLike, "2 rows"]

    @property
    def named(self) -> dict[str, Float[ArrayLike, "..."]]:
        """Residuals by group name, image points first, without the datum."""
        return {IMAGE_POINTS: self.image, **dict(zip(self.names, self.others, strict=True))}

    def __getitem__(self, name: str) -> Float[ArrayLike, "..."]:
        return self.named[name]


class AbstractValues(eqx.Module):
    """Batch-last arrays of an adjustment: observations, sigmas, start values, datum constraints."""

    groups: tuple[RowsInList | RowsAtPoints, ...]
    """Observed values of the rows of `Structure.observed`, which contains their indices."""
    time: Float[Array, "images"]
    velocity: Float[Array, "3 images"]
    rate: Float[Array, "3 images"]
    nominal: Float[Array, "3 3 images"]
    flight_time: Float[Array, "images"]
    height: Float[Array, "images"]
    temperature: Float[Array, "images"]
    position: Float[Array, "3 images"]
    rotation: Float[Array, "3 3 images"]
    shared: Float[Array, "parameters"]
    points: Float[Array, "3 points"]
    datum_eop: Float[Array, "constraints 6 images"]
    datum_points: Float[Array, "constraints 3 points"]

    @property
    def exposures(self) -> tuple[Float[Array, "... images"], ...]:
        """Fields of the `Exposure` of each image."""
        return self.time, self.velocity, self.rate, self.nominal, self.flight_time, self.height, self.temperature


@pretty_repr
class Values(AbstractValues):
    """Arrays of a block in its own order."""

    xy: Float[Array, "2 rows"]
    sigma_xy: Float[Array, "2 rows"]


class UnknownArrays(NamedTuple):
    """Unknowns, batch-last."""

    position: Float[Array, "3 images"]
    rotation: Float[Array, "3 3 images"]
    shared: Float[Array, "parameters"]
    points: Float[Array, "3 points"]


def zero_increments(structure: AbstractStructure) -> Increments:
    """Return increments of zero."""
    s = structure
    return Increments(jnp.zeros((6, s.n_images)), jnp.zeros(s.n_shared), jnp.zeros((3, s.n_points)))


def state_at(
    increments: Increments, scale: Increments, values: AbstractValues, structure: AbstractStructure
) -> UnknownArrays:
    """Move the start values by scaled increments; fixed unknowns do not move."""
    eop = increments.eop * scale.eop
    turn = jax.vmap(small_rotation, in_axes=-1, out_axes=-1)(eop[3:])
    # Expand the products: a batch of 3 x 3 matrix products takes several times as long.
    rotation = sum_terms(turn[:, j, None] * values.rotation[j] for j in range(3))
    return UnknownArrays(
        values.position + eop[:3],
        rotation,
        jnp.asarray(values.shared).at[structure.free].add(increments.shared * scale.shared, unique_indices=True),
        values.points + increments.points * scale.points,
    )


def datum_residuals(
    increments: Increments, scale: Increments, values: AbstractValues, structure: AbstractStructure
) -> Float[Array, "constraints"]:
    """Evaluate the violation of the datum constraints."""
    eop = jnp.einsum("kci,ci->k", values.datum_eop * scale.eop, increments.eop)
    points = jnp.einsum("kcp,cp->k", values.datum_points * scale.points, increments.points)
    return eop + total(points, structure)
