"""The numbers of an adjustment: observations and start, increments, the unknowns that these lead to, residuals.

Increments are scaled and small: `unknown = start (+) scale * increment`, rotations by a small rotation in the
camera frame. Arrays are batch-last (components first, rows last), which XLA vectorises best on a CPU. Image rows are
computed in chunks of an image's rays (`solver.ray_rows`), all others row by row (`row_functions`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxphoto.adjustment.model.observed_groups import RowsAtPoints, RowsInList
from jaxphoto.adjustment.model.structure import AbstractStructure, total
from jaxphoto.arrays import Numbers, added
from jaxphoto.rotation import small_rotation
from jaxphoto.short_repr import shown

IMAGE_POINTS = "image_points"
"""The name of the image rows in tables and files."""


class Increments(NamedTuple):
    """Scaled changes of the unknowns since the start: what the solver iterates on."""

    eop: Float[Array, "6 images"]
    shared: Float[Array, "shared"]
    points: Float[Array, "3 points"]


class NonImageResiduals(eqx.Module):
    """Observed minus computed over sigma of all but image rows, by group; `datum` holds the constraints that
    observations leave open.

    While they are computed, in padded sizes, they are (components, rows), or (components, rows, points) where rows lie
    at points. Of a result, a group whose rows are single numbers has (rows).
    """

    others: tuple[Float[Numbers, "..."], ...]
    datum: Float[Numbers, "constraints"]
    names: tuple[str, ...] = eqx.field(static=True)
    """Of the groups of `others`."""


@shown
class Residuals(NonImageResiduals):
    """Observed minus computed over sigma, by group, in the block's own order."""

    image: Float[Numbers, "2 rows"]

    @property
    def named(self) -> dict[str, Float[Numbers, "..."]]:
        """All but the datum by the names of their groups, image points first."""
        return {IMAGE_POINTS: self.image, **dict(zip(self.names, self.others, strict=True))}

    def __getitem__(self, name: str) -> Float[Numbers, "..."]:
        return self.named[name]


class AbstractValues(eqx.Module):
    """The numbers of an adjustment, batch-last: observations, sigmas, start, and constraint rows of the datum."""

    groups: tuple[RowsInList | RowsAtPoints, ...]
    """The numbers of the rows of `Structure.observed`; their indices are there."""
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
        """What an `Exposure` of each image holds."""
        return self.time, self.velocity, self.rate, self.nominal, self.flight_time, self.height, self.temperature


@shown
class Values(AbstractValues):
    """Those of a block as given."""

    xy: Float[Array, "2 rows"]
    sigma_xy: Float[Array, "2 rows"]


class UnknownArrays(NamedTuple):
    """The unknowns themselves, batch-last."""

    position: Float[Array, "3 images"]
    rotation: Float[Array, "3 3 images"]
    shared: Float[Array, "parameters"]
    points: Float[Array, "3 points"]


def zero_increments(structure: AbstractStructure) -> Increments:
    """No change from the start."""
    s = structure
    return Increments(jnp.zeros((6, s.n_images)), jnp.zeros(s.n_shared), jnp.zeros((3, s.n_points)))


def state_at(
    increments: Increments, scale: Increments, values: AbstractValues, structure: AbstractStructure
) -> UnknownArrays:
    """Start values moved by scaled increments; what is fixed does not move."""
    eop = increments.eop * scale.eop
    turn = jax.vmap(small_rotation, in_axes=-1, out_axes=-1)(eop[3:])
    # Term by term: a batch of products of 3 x 3 matrices takes several times as long.
    rotation = added(turn[:, j, None] * values.rotation[j] for j in range(3))
    return UnknownArrays(
        values.position + eop[:3],
        rotation,
        jnp.asarray(values.shared).at[structure.free].add(increments.shared * scale.shared, unique_indices=True),
        values.points + increments.points * scale.points,
    )


def datum_residuals(
    increments: Increments, scale: Increments, values: AbstractValues, structure: AbstractStructure
) -> Float[Array, "constraints"]:
    """By how much the constraints of the datum are violated."""
    eop = jnp.einsum("kci,ci->k", values.datum_eop * scale.eop, increments.eop)
    points = jnp.einsum("kcp,cp->k", values.datum_points * scale.points, increments.points)
    return eop + total(points, structure)
