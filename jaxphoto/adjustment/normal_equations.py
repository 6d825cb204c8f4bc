"""Normal equations of a block at its optimum: interface of statistics and sensitivity to the solver.

In scaled increments and padded order; `Adjustment.padded` converts to the order of the block.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment.layout.padded import PaddedResiduals, PaddedStructure, PaddedValues
from jaxphoto.adjustment.layout.rays import GROUP
from jaxphoto.adjustment.model.numbers import Increments, NonImageResiduals, UnknownArrays, state_at, zero_increments
from jaxphoto.adjustment.solver.band import Band, dense, factor_band, invert_band, pivots
from jaxphoto.adjustment.solver.elimination import (
    FactoredNormal,
    j_product,
    j_product_others,
    jt_product,
    jt_product_others,
    solve_factored,
)
from jaxphoto.adjustment.solver.inverse import Cofactors, RowCofactors, cofactors_of, row_variances
from jaxphoto.adjustment.solver.levenberg_marquardt import IterationHistory, SolveMode
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.adjustment.solver.optimum import iterate, typical_scale, unit_scale, weigh_datum
from jaxphoto.adjustment.solver.reduced import (
    ProductSums,
    interior_in_border,
    reduce_normal,
    reduced_columns,
)
from jaxphoto.arrays import to_numpy
from jaxphoto.compiling import call_compiled
from jaxphoto.short_repr import pretty_repr


@pretty_repr
class NormalEquations(eqx.Module):
    """N x = b at the optimum, undamped and factored."""

    values: PaddedValues
    """Values of the block; the start values are the optimum."""
    structure: PaddedStructure
    factored: FactoredNormal
    is_weighed: bool = eqx.field(static=True, default=False)
    """True if the datum constraints already have the scale required by `at`."""

    @property
    def scale(self) -> Increments:
        """Scale of the increments; zero for fixed unknowns."""
        return self.factored.scale

    @property
    def at(self) -> Linearised:
        """Linearisation point: zero increments, with scaled datum constraints."""
        s = self.structure
        values = self.values if self.is_weighed else weigh_datum(self.values, s)
        return Linearised(jax.tree.map(jnp.zeros_like, self.scale), self.scale, values, s)

    @property
    def weighed(self) -> "NormalEquations":
        """Scale the datum constraints once, for programs that run many times."""
        if self.is_weighed or not self.values.datum_eop.shape[0]:
            return dataclasses.replace(self, is_weighed=True)
        return dataclasses.replace(self, values=call_compiled(_weighed, self.values, self.structure), is_weighed=True)

    @property
    def on_one_device(self) -> "NormalEquations":
        """Convert to one device."""
        values, factored = jax.tree.map(to_numpy, (self.values, self.factored))
        return dataclasses.replace(self, values=values, structure=self.structure.on_one_device, factored=factored)

    def solve(self, b: Increments) -> Increments:
        """Solve N x = b; use `jax.vmap` for many right-hand sides."""
        return solve_factored(self.factored.reduced, self.factored.factor, b, self.at)

    def jt_product(self, z: PaddedResiduals) -> Increments:
        """Return J'z of many weighted residual vectors (leading axis)."""
        return jt_product(z, self.at)

    def j_product(self, x: Increments) -> PaddedResiduals:
        """Return J x of many increments (leading axis): changes of the adjusted observations over their sigmas."""
        return j_product(x, self.at)

    def jt_product_others(self, z: NonImageResiduals) -> Increments:
        """Return J'z of all rows except image rows (leading axis)."""
        return jt_product_others(z, self.at)

    def j_product_others(self, x: Increments) -> NonImageResiduals:
        """Return J x of all rows except image rows (leading axis)."""
        return j_product_others(x, self.at)

    def cofactors(self, of_rows: bool) -> tuple[Cofactors, RowCofactors | None]:
        """Return the inverse of N for images, shared unknowns and each point, and of rows if requested."""
        return cofactors_of(self.at, self.factored, of_rows)

    def row_variances(self, q: Cofactors, of_rows: RowCofactors) -> tuple[Array, tuple[Array, ...]]:
        """Return J Q J' of the image rows, and of every other group as (c, c, ...), c components per row."""
        return row_variances(self.at, q, of_rows, self.factored)

    def inverse_of_reduced(self) -> Float[Array, "reduced reduced"]:
        """Return A^-1."""
        return invert_band(self.factored.factor)

    def pivots(self) -> Float[Array, "reduced"]:
        """Return the remaining information of each reduced unknown after elimination of the preceding ones: 1 full, 0
        rank defect.
        """
        return call_compiled(_pivots, self.factored.reduced.diagonal, self.factored.factor)

    def least_pivot(self) -> Float[Array, ""]:
        """Return the smallest pivot."""
        return jnp.min(self.pivots())

    def constraints(self) -> Increments:
        """Return derivatives of the datum constraints, along a leading axis."""
        return self.at.constraints()


class CoupledUnknowns(NamedTuple):
    """Unknowns coupled with points, as indices among the reduced unknowns and k constraints; larger for none."""

    of_images: Int[Array, "images e"]
    """Unknowns eliminated with an image: exterior orientation, and camera parameters if `RayLists.by_image`."""
    of_points: Int[Array, "points c"]
    """Interior unknowns, constraints, the right-hand side (none), and unknowns that rows at the points of a group
    involve.
    """
    interior: int
    """Number of interior unknowns in `of_points`."""

    @classmethod
    def of(cls, s: PaddedStructure, k: int) -> "CoupledUnknowns":
        """Return the coupled unknowns of a block."""
        of_images, of_groups = reduced_columns(s, k)
        return cls(of_images, jnp.repeat(of_groups, GROUP, axis=0), interior_in_border(s))

    @staticmethod
    def products(
        f: Float[Array, "batches m p 3 e"], border: Float[Array, "points 3 c"], s: PaddedStructure, k: int
    ) -> Float[Array, "size size"]:
        """Return F F' of rays and points, for all reduced unknowns and k constraints."""
        n, each = s.n_images, jnp.arange(s.n_images)
        sums = ProductSums.of(border, s, k)
        sums, _ = s.each(lambda sums, own: (sums.with_rays(*own, border, s, k), ()), sums, (f,))
        sums = sums.with_pairs(f, s, k)
        columns, last = sums.band
        width, size = len(last), s.n_shared + k
        # Only one triangle of the pairs of images is stored.
        none = jnp.zeros((0, 6 * (n - width)))
        pairs = dense(Band(columns.reshape(-1, 12 * width, 6 * width), none, last.reshape(6 * width, -1)))
        own = sums.own.reshape(n, -1, sums.across.shape[2])[:, :6, :6]
        own = jnp.zeros((n, 6, n, 6)).at[each, :, each].set(own).reshape(6 * n, -1)
        across = sums.across[:, :size, :6].transpose(1, 0, 2).reshape(-1, 6 * n)
        return jnp.block([[own - pairs, across.T], [across, sums.border[:size, :size]]])


# Without jit each operation would be compiled separately, and the first takes 0.5 s every time.
_weighed = eqx.filter_jit(weigh_datum)
_pivots = eqx.filter_jit(pivots)


def factor_normal(values: PaddedValues, structure: PaddedStructure) -> FactoredNormal:
    """Factor the normal equations of values at their optimum."""
    values, scale = weigh_datum(values, structure), typical_scale(values, structure)
    a, reduced, _ = reduce_normal(Linearised(zero_increments(structure), scale, values, structure), 0.0)
    return FactoredNormal(reduced, factor_band(a), scale)


class Optimised(eqx.Module):
    """End of an iteration, and its last normal equations."""

    state: UnknownArrays
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    factored: FactoredNormal
    history: IterationHistory


def optimise(values: PaddedValues, structure: PaddedStructure, task: SolveMode) -> Optimised:
    """Find the optimum; or factor the undamped normal equations of values at their optimum."""
    optimum, system, scale = iterate(weigh_datum(values, structure), structure, task)
    state = state_at(optimum.increments, unit_scale(structure), values, structure)
    factored = FactoredNormal(system.reduced, system.factor, scale)
    assert optimum.steps is not None and optimum.converged is not None, "only of a tangent is this unknown"
    assert optimum.history is not None
    return Optimised(state, optimum.steps, optimum.converged, factored, optimum.history)
