"""What an adjustment gives: unknowns, residuals, sigma naught, redundancy, the factored normal matrix, an outcome."""

import enum

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment.band import BandFactor, factor_band
from jaxphoto.adjustment.layout import Places
from jaxphoto.adjustment.normal import At, Reduced
from jaxphoto.adjustment.optimum import typical_scale, weigh_datum, zero_increments
from jaxphoto.adjustment.reduced import reduce_normal
from jaxphoto.adjustment.residuals import Increments, Residuals, Values
from jaxphoto.adjustment.shards import on_one_device
from jaxphoto.adjustment.structure import Structure
from jaxphoto.arrays import Numbers, still
from jaxphoto.block import Block
from jaxphoto.compiling import call_compiled
from jaxphoto.observations import PRIORS
from jaxphoto.short_repr import adjustment_repr
from jaxphoto.unknowns import Unknowns


class Outcome(enum.Enum):
    """How the adjustment ended; the member's value is the sentence shown to the user."""

    CONVERGED = "converged: every unknown is within a hundred-thousandth of its standard deviation of the optimum"
    STEPS = (
        "not converged: the step limit was reached; check the approximate values, look for blunders among the largest "
        "residuals, or hold weakly determined unknowns fixed"
    )
    DIVERGED = (
        "not converged: the numbers became infinite; check units, approximate values, and whether points lie behind "
        "their cameras"
    )


class Factored(eqx.Module):
    """The normal equations at the optimum in scaled increments, undamped, factored: all statistics come from here."""

    reduced: Reduced
    factor: BandFactor
    scale: Increments
    n_constraints: int = eqx.field(static=True)
    """Constraints of the datum: the last of the rows of D."""


class Padded(eqx.Module):
    """The adjustment as it was computed: everything in the sizes and order of `padding.pad_structure`."""

    structure: Structure
    values: Values
    factored: Factored
    places: Places

    @property
    def on_one_device(self) -> "Padded":
        """The same for programs that no other device has a part in."""
        values, factored = jax.tree.map(still, (self.values, self.factored))
        return Padded(on_one_device(self.structure), values, factored, self.places)


class Unfactored(eqx.Module):
    """What `Padded` is made of where that may never be wanted: inside a transformation of JAX."""

    structure: Structure
    values: Values
    places: Places

    def padded(self) -> Padded:
        """With the normal equations, factored."""
        if self.values.xy.ndim != _DIMENSIONS:
            raise ValueError(
                "statistics of many adjustments at once: ask for them inside the function that jax.vmap maps"
            )
        factored = call_compiled(_factored, self.values, self.structure)
        return Padded(self.structure, self.values, factored, self.places)


# Of the image coordinates of one adjustment: chunks, tiles, x and y, images, points.
_DIMENSIONS = 5


@eqx.filter_jit
def _factored(values: Values, structure: Structure) -> Factored:
    values, scale = weigh_datum(values, structure), typical_scale(values, structure)
    a, reduced, _ = reduce_normal(At(zero_increments(structure), scale, values, structure), 0.0)
    return Factored(reduced, factor_band(a), scale, values.datum_eop.shape[0])


class Adjustment(eqx.Module):
    """The result of `jaxphoto.adjust`; see `jaxphoto.statistics` for what can be asked of it.

    `residuals` are observed minus computed over the a priori sigma, by group. `sigma0` is the square root of the a
    posteriori variance factor v'Pv / redundancy.
    """

    block: Block
    priors: Unknowns
    unknowns: Unknowns
    residuals: Residuals
    values: Values
    structure: Structure
    padded: Padded | None
    """None in an adjustment that is being differentiated or mapped over; see `computed`."""
    unfactored: Unfactored | None
    """None in any other."""
    steps: Int[Array, ""]
    converged: Array
    seconds: dict[str, float]

    __repr__ = adjustment_repr

    @property
    def computed(self) -> Padded:
        """What statistics are computed from; inside a transformation of JAX it is made anew each time."""
        if self.padded is None:
            assert self.unfactored is not None
            return self.unfactored.padded()
        return self.padded

    @property
    def square_sum(self) -> Float[Numbers, ""] | float:
        """v'Pv: the weighted square sum of all observations' residuals."""
        return sum(((v**2).sum() for v in self.residuals.named.values()), np.zeros(()))

    @property
    def outcome(self) -> Outcome:
        """Converged or not, and why; a member of `Outcome`."""
        if bool(self.converged):
            return Outcome.CONVERGED
        return Outcome.STEPS if np.isfinite(float(self.square_sum)) else Outcome.DIVERGED

    @property
    def n_observations(self) -> dict[str, int]:
        """Observations by group: image_points, those of `Block.observations`, priors; 0 where there are none."""
        groups = (self.block.image_points, *self.block.observations)
        none = {rows.group: 0 for rows in groups} | {PRIORS: 0}
        return none | {name: int(np.size(v)) for name, v in self.residuals.named.items()}

    @property
    def n_unknowns(self) -> dict[str, int]:
        """Unknowns by kind: interior, scanner, mounts, strips and further declared ones, exterior, points."""
        s = self.structure
        declared = {"scanner": 0} | dict.fromkeys(self.unknowns.tables, 0)
        for t in s.tables:
            stop = t.offset + t.size * len(t.owners)
            declared[t.kind] = int(((s.free >= t.offset) & (s.free < stop)).sum())
        return {
            "interior": int((s.free < s.n_cameras).sum()),
            **declared,
            "exterior": int(s.eop_free.sum()),
            "points": int(s.point_free.sum()),
        }

    @property
    def n_constraints(self) -> int:
        """Constraints that close the datum."""
        return self.residuals.datum.shape[0]

    @property
    def redundancy(self) -> int:
        """Observations plus constraints of the datum minus unknowns."""
        return sum(self.n_observations.values()) + self.n_constraints - sum(self.n_unknowns.values())

    @property
    def sigma0(self) -> Float[Numbers, ""] | float:
        """Square root of the a posteriori variance factor; 1 where there is no redundancy."""
        redundancy = self.redundancy
        return (self.square_sum / redundancy) ** 0.5 if redundancy > 0 else self.square_sum * 0 + 1.0
