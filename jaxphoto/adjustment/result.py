"""What an adjustment gives: unknowns, residuals, sigma naught, redundancy, the factored normal matrix, an outcome."""

import enum

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment.band import BandFactor, factor_band
from jaxphoto.adjustment.normal import At, Reduced
from jaxphoto.adjustment.optimum import typical_scale, weigh_datum, zero_increments
from jaxphoto.adjustment.padding import Places
from jaxphoto.adjustment.reduced import reduce_normal
from jaxphoto.adjustment.residuals import GROUPS, Increments, Residuals, Values
from jaxphoto.adjustment.shards import on_one_device
from jaxphoto.adjustment.structure import Structure
from jaxphoto.arrays import Numbers, still
from jaxphoto.block import Block
from jaxphoto.compiling import call_compiled
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

    @property
    def computed(self) -> Padded:
        """What statistics are computed from; inside a transformation of JAX it is made anew each time."""
        if self.padded is None:
            assert self.unfactored is not None
            return self.unfactored.padded()
        return self.padded

    @property
    def square_sum(self) -> Float[Numbers, ""]:
        """v'Pv: the weighted square sum of all observations' residuals."""
        return sum(((v**2).sum() for v in self.residuals[:-1]), np.zeros(()))

    @property
    def outcome(self) -> Outcome:
        """Converged or not, and why; a member of `Outcome`."""
        if bool(self.converged):
            return Outcome.CONVERGED
        return Outcome.STEPS if np.isfinite(float(self.square_sum)) else Outcome.DIVERGED

    @property
    def n_observations(self) -> dict[str, int]:
        """Observations by group: image_points, stations, attitudes, control_points, surfaces, distances, priors."""
        return {name: int(np.size(getattr(self.residuals, field))) for field, name in GROUPS.items()}

    @property
    def n_unknowns(self) -> dict[str, int]:
        """Unknowns by group: interior, scanner, mounts, strips, exterior, points."""
        s = self.structure
        mounts = int(((s.free >= s.mount_offset) & (s.free < s.strip_offset)).sum())
        return {
            "interior": s.n_interior,
            "scanner": s.n_scanner,
            "mounts": mounts,
            "strips": s.n_shared - s.n_border - mounts,
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
    def sigma0(self) -> Float[Numbers, ""]:
        """Square root of the a posteriori variance factor; 1 where there is no redundancy."""
        redundancy = self.redundancy
        return (self.square_sum / redundancy) ** 0.5 if redundancy > 0 else self.square_sum * 0 + 1.0
