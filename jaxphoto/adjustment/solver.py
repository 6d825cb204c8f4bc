"""Levenberg-Marquardt through optimistix, over a lineax solver that knows the structure of a block.

optimistix runs the iteration; `BlockDescent` gives it steps. At an accepted iterate it reads the Jacobian's blocks
off the linearised residuals by coloured products and sums the normal equations once; each damping is then one
`lx.linear_solve` of the operator `NormalMatrix` by `PointElimination`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Float, PyTree, Scalar

from jaxphoto.adjustment.local import blocks_at
from jaxphoto.adjustment.normal import (
    Normal,
    Reduced,
    factor_reduced,
    multiply_normal,
    reduce_normal,
    solve_factored,
    sum_normal,
    zero_normal,
)
from jaxphoto.adjustment.residuals import Increments, Values
from jaxphoto.adjustment.structure import Structure


class NormalMatrix(lx.AbstractLinearOperator):
    """N + damping I of a block, by its blocks."""

    normal: Normal
    damping: Scalar
    structure: Structure

    def mv(self, vector: Increments) -> Increments:
        """(N + damping I) x."""
        product = multiply_normal(self.normal, vector, self.structure)
        return jax.tree.map(lambda p, x: p + self.damping * x, product, vector)

    def as_matrix(self) -> Float[Array, "n n"]:
        """The dense matrix: for small blocks and tests."""
        flat, unravel = jax.flatten_util.ravel_pytree(self.normal.b)
        return jax.vmap(lambda row: jax.flatten_util.ravel_pytree(self.mv(unravel(row)))[0])(jnp.eye(len(flat)))

    def transpose(self) -> "NormalMatrix":
        """Itself: it is symmetric."""
        return self

    def in_structure(self) -> Increments:
        """Shapes of what it multiplies."""
        return jax.eval_shape(lambda: self.normal.b)

    def out_structure(self) -> Increments:
        """Shapes of the product."""
        return self.in_structure()


@lx.is_symmetric.register(NormalMatrix)
@lx.is_positive_semidefinite.register(NormalMatrix)
def _(operator: NormalMatrix) -> bool:
    return True


@lx.is_negative_semidefinite.register(NormalMatrix)
def _(operator: NormalMatrix) -> bool:
    return False


class _Factor(NamedTuple):
    """A normal matrix with its points eliminated, and the Cholesky factor of what is left."""

    matrix: NormalMatrix
    reduced: Reduced
    lower: Float[Array, "reduced reduced"]


class PointElimination(lx.AbstractLinearSolver[_Factor]):
    """Cholesky of a block's normal matrix, points first (the Schur complement)."""

    def init(self, operator: NormalMatrix, options: dict[str, Any]) -> _Factor:
        """Eliminate the points and factor the reduced matrix."""
        reduced = reduce_normal(operator.normal, operator.damping, operator.structure)
        return _Factor(operator, reduced, factor_reduced(reduced))

    def compute(
        self, state: _Factor, vector: Increments, options: dict[str, Any]
    ) -> tuple[Increments, lx.RESULTS, dict[str, Any]]:
        """The solution; not finite where the matrix is singular."""
        matrix = state.matrix
        x = solve_factored(matrix.normal, state.reduced, state.lower, vector, matrix.structure)
        return x, lx.RESULTS.successful, {}

    def transpose(self, state: _Factor, options: dict[str, Any]) -> tuple[_Factor, dict[str, Any]]:
        """The same: the matrix is symmetric."""
        return state, options

    def conj(self, state: _Factor, options: dict[str, Any]) -> tuple[_Factor, dict[str, Any]]:
        """The same: the matrix is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """A singular matrix gives numbers that are not finite, and so a result that says so."""
        return True


class BlockDescent(optx.AbstractDescent):
    """The damped Gauss-Newton step of a block; the normal equations are summed once an accepted iterate."""

    structure: Structure
    values: Values
    scale: Increments

    def init(self, y: Increments, f_info_struct: Any) -> Normal:
        """Normal equations of the right shapes; replaced before use."""
        return zero_normal(self.structure, len(self.values.datum_eop))

    def query(self, y: Increments, f_info: Any, state: Normal) -> Normal:
        """Sum the normal equations at `y`."""
        blocks, residuals = blocks_at(y, self.scale, self.values, self.structure)
        datum = (self.values.datum_eop * self.scale.eop, self.values.datum_points * self.scale.points)
        return sum_normal(blocks, residuals, datum, self.structure)

    def step(self, step_size: Scalar, state: Normal) -> tuple[Increments, optx.RESULTS]:
        """-(N + I / step_size)^-1 J' r."""
        matrix = NormalMatrix(state, 1 / step_size, self.structure)
        solution = lx.linear_solve(matrix, state.b, PointElimination(), throw=False)
        return jax.tree.map(jnp.negative, solution.value), optx.RESULTS.promote(solution.result)


class _Trust(NamedTuple):
    """Damping 1 / step_size; what the proposed step promises to take off half the square sum; its length."""

    step_size: Scalar
    promised: Scalar
    length: Scalar


class PromisedReduction(optx.AbstractSearch):
    """Trust region by the ratio of actual to promised reduction, with the constants of optimistix' classical one.

    Who proposes a step knows what it promises and leaves it in the state; the search need not compute it again.
    """

    low_cutoff: float = 0.01
    high_cutoff: float = 0.99
    low_constant: float = 0.25
    high_constant: float = 3.5

    def init(self, y: Increments, f_info_struct: Any) -> _Trust:
        """Step size 1: the first damping is the scaling's business."""
        return _Trust(jnp.ones(()), jnp.zeros(()), jnp.array(jnp.inf))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state: _Trust):
        """Accept or reject the proposal, and adapt the damping."""
        change = f_eval_info.as_min() - f_info.as_min()
        accept = first_step | (change <= -self.low_cutoff * state.promised)
        good = ~first_step & (change < -self.high_cutoff * state.promised)
        factor = jnp.where(accept, jnp.where(good, self.high_constant, 1.0), self.low_constant)
        size = state.step_size * factor
        return size, accept, optx.RESULTS.successful, _Trust(size, state.promised, state.length)


# Ratio of successive steps that is assumed at least when the missing part is estimated.
_SLOWEST_SHOWN = 0.1


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt of optimistix, stopped by what is still missing to the optimum in standard deviations.

    The length of a step d in the metric of the normal matrix, sqrt(d' N d), bounds |d| / sigma of every single
    unknown. After a step of length l that follows one of length k about l (l / k) is missing; a tenth of l is assumed
    at least, because the first ratios flatter: they shrink quadratically until the residuals' curvature tells. Once the
    missing part is below `tolerance`, the (practically undamped) step is taken, and is the last.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    descent: BlockDescent
    search: PromisedReduction
    verbose: Callable[..., None]
    tolerance: float

    def __init__(self, descent: BlockDescent, tolerance: float):
        # The Cauchy test of optimistix is switched off by zero tolerances: `step` below decides.
        self.rtol, self.atol, self.norm = 0.0, 0.0, optx.max_norm
        self.descent = descent
        self.search = PromisedReduction()
        self.verbose = _silent
        self.tolerance = tolerance

    def step(self, fn, y, args, options, state, tags):
        """One step of optimistix; afterwards `terminate` says whether the step just proposed is the last."""
        new_y, new, aux = super().step(fn, y, args, options, state, tags)
        proposal = jax.tree.map(jnp.subtract, new.y_eval, new_y)
        # (N + damping) d = -b, so d'N d = -d'b - damping d'd, and the linear model promises d'N d / 2 + damping d'd.
        damped = _dot(proposal, proposal) / new.search_state.step_size
        seen = -_dot(proposal, new.descent_state.b) - damped
        accepted = new.num_steps_since_acceptance == 0
        length, trust = jnp.sqrt(jnp.maximum(seen, 0.0)), new.search_state
        missing = length * jnp.clip(length / trust.length, _SLOWEST_SHOWN, 1.0)
        settled = accepted & (missing <= self.tolerance) & (damped <= seen + self.tolerance**2)
        trust = _Trust(trust.step_size, 0.5 * seen + damped, jnp.where(accepted, length, trust.length))
        return new_y, eqx.tree_at(lambda s: (s.terminate, s.search_state), new, (settled, trust)), aux

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """The last proposal is part of the answer: it was computed from an accepted iterate and is short."""
        y = jax.tree.map(lambda a, b: jnp.where(state.terminate, a, b), state.y_eval, y)
        return y, aux, {}


def _silent(**_: Any) -> None:
    """Progress is reported by the caller, after the solve."""


def _dot(a: Increments, b: Increments) -> Array:
    return sum((jnp.sum(x * y) for x, y in zip(a, b, strict=True)), jnp.zeros(()))
