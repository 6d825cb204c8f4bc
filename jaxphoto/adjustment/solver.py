"""Levenberg-Marquardt for a block, as a solver of optimistix that knows the block's structure.

optimistix runs the iteration. A step sums and factors the normal equations with their points eliminated (`reduced`,
`band`), or, once steps shrink fast, keeps the factor and only takes the gradient anew: a chord step, which costs a
third and near the optimum gains nearly as much.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, PyTree, Scalar

from jaxphoto.adjustment.band import BandFactor, factor_band
from jaxphoto.adjustment.normal import At, Reduced, dot, gradient, norm2, solve_reduced
from jaxphoto.adjustment.reduced import Right, reduce_normal
from jaxphoto.adjustment.residuals import Increments, Values
from jaxphoto.adjustment.structure import Structure


class System(NamedTuple):
    """Normal equations summed and factored at some increments."""

    increments: Increments
    reduced: Reduced
    factor: BandFactor
    damping: Scalar


def zero_system(y: Increments, values: Values, s: Structure) -> System:
    """A system of the right shapes, to begin with."""
    n, q, k = 6 * s.n_images, s.n_shared, len(values.distances) + len(values.datum_eop)
    m, inner, points = n // s.in_tiles.columns, s.in_tiles.columns - 1, y.points.shape[1]
    factor = BandFactor(jnp.zeros((inner, 2 * m, m)), jnp.zeros((q, inner * m)), jnp.zeros((m + q, m + q)))
    reduced = Reduced(
        diagonal=jnp.zeros(n + q),
        g=jnp.zeros((n + q, k)),
        k=jnp.zeros((k, k)),
        l=jnp.zeros((6, points)),
        rows_e=jnp.zeros((k, s.n_images, 6)),
        rows_p=jnp.zeros((k, 3, points)),
        weight=jax.tree.map(jnp.zeros_like, y),
    )
    return System(y, reduced, factor, jnp.zeros(()))


class Progress(NamedTuple):
    """The solver's state between two steps."""

    damping: Scalar
    length: Scalar
    """Of the last accepted step, in the metric of the normal matrix."""
    chord: Bool[Array, ""]
    """Whether the next step uses the system as it is."""
    system: System
    done: Bool[Array, ""]


# The first damping: what is added to the normal matrix, relative to its diagonal.
_FIRST_DAMPING = 1e-8
# Trust region by the ratio of actual to promised reduction: accept above the first, trust more above the second.
_ACCEPT, _GOOD = 0.01, 0.99
_LESS_DAMPING, _MORE_DAMPING = 1 / 3.5, 4.0
# Ratio of successive steps that is assumed at least when the missing part is estimated.
_SLOWEST_SHOWN = 0.1
# Steps that shrink like this go on with the same factor; a chord step that shrinks less than the second ends it.
_CHORD, _CHORD_FAILS = 0.01, 0.3


class LevenbergMarquardt(optx.AbstractLeastSquaresSolver[Increments, Scalar, Any, Progress]):
    """Levenberg-Marquardt, stopped by what is still missing to the optimum in standard deviations.

    The function it minimises returns the length of the residual vector; derivatives are the solver's own business.

    The length of a step d in the metric of the normal matrix, sqrt(d' N d), bounds |d| / sigma of every single
    unknown. After a step of length l that follows one of length k about l (l / k) is missing; a tenth of l is assumed
    at least, because the first ratios flatter: they shrink quadratically until the residuals' curvature tells. Once the
    missing part is below `tolerance`, the (practically undamped) step is taken, and is the last.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    structure: Structure
    values: Values
    scale: Increments
    tolerance: float
    only_factor: Bool[Array, ""]
    """One undamped step, for the sake of its system: what has a program to solve needs none to factor."""

    def __init__(self, structure: Structure, values: Values, scale: Increments, tolerance: float, only_factor):
        # optimistix' own test of convergence is not used: `step` decides.
        self.rtol, self.atol, self.norm = 0.0, 0.0, optx.max_norm
        self.structure, self.values, self.scale = structure, values, scale
        self.tolerance, self.only_factor = tolerance, only_factor

    def _at(self, y: Increments) -> At:
        return At(y, self.scale, self.values, self.structure)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Progress:
        """Almost Gauss-Newton to begin with."""
        damping = jnp.where(self.only_factor, 0.0, _FIRST_DAMPING)
        empty = zero_system(y, self.values, self.structure)
        return Progress(damping, jnp.array(jnp.inf), jnp.array(False), empty, jnp.array(False))

    def _factored(self, y: Increments, damping) -> tuple[System, Right]:
        a, reduced, right = reduce_normal(self._at(y), damping)
        return System(y, reduced, factor_band(a), jnp.asarray(damping, float)), right

    def _kept(self, y: Increments, system: System) -> tuple[System, Right]:
        """The gradient at `y`, taken down by the system that there is."""
        return system, Right(*gradient(self._at(y), system.reduced.l, system.reduced.rows_p))

    def step(self, fn, y, args, options, state: Progress, tags):
        """Propose a step; take it if it is good, and damp more if not."""
        system, right = jax.lax.cond(
            state.chord, lambda: self._kept(y, state.system), lambda: self._factored(y, state.damping)
        )
        place = self._at(system.increments)
        x = jax.lax.cond(
            self.only_factor,
            lambda: jax.tree.map(jnp.zeros_like, y),
            lambda: solve_reduced(place, system.reduced, system.factor, right.reduced, right.d, right.b.points),
        )
        proposal = jax.tree.map(jnp.negative, x)
        # (N + D) d = -b, so d'N d = -d'b - d'D d, and the linear model promises d'N d / 2 + d'D d.
        damped = system.damping * norm2(x, system.reduced.weight, self.structure)
        seen = dot(x, right.b, self.structure) - damped
        length = jnp.sqrt(jnp.maximum(seen, 0.0))
        ratio = length / state.length
        missing = length * jnp.clip(ratio, _SLOWEST_SHOWN, 1.0)
        settled = (missing <= self.tolerance) & (damped <= seen + self.tolerance**2)
        new_y = jax.tree.map(jnp.add, y, proposal)
        # The last step is short and was computed from an accepted iterate: it needs no proof.
        square_sum = jax.lax.cond(settled | self.only_factor, lambda: right.square_sum, lambda: fn(new_y, args)[0] ** 2)
        reduction, promised = right.square_sum - square_sum, seen + 2 * damped
        accept = settled | (reduction >= _ACCEPT * promised)
        chord_failed = state.chord & ~(accept & (ratio < _CHORD_FAILS))
        good = reduction >= _GOOD * promised
        factor = jnp.where(accept, jnp.where(good, _LESS_DAMPING, 1.0), jnp.where(state.chord, 1.0, _MORE_DAMPING))
        pick = lambda a, b: jax.tree.map(lambda a, b: jnp.where(accept, a, b), a, b)  # noqa: E731
        progress = Progress(
            damping=state.damping * factor,
            length=pick(length, state.length),
            chord=accept & ~chord_failed & (state.chord | ((ratio < _CHORD) & jnp.isfinite(state.length))),
            system=system,
            done=settled | self.only_factor,
        )
        return pick(new_y, y), progress, None

    def terminate(self, fn, y, args, options, state: Progress, tags):
        """After the step that settled it, or the only one."""
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Nothing is left to do."""
        return y, aux, {}
