"""Levenberg-Marquardt through optimistix, over a lineax solver that knows the structure of a block.

`optx.LevenbergMarquardt` hands its linear solver the operator [J; sqrt(lambda) I] and the vector (r, 0).
`PointElimination` reads J's blocks and lambda off that operator by coloured products, eliminates the points and
solves (J'J + lambda I) x = J'r exactly.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Float, PyTree, Scalar

from jaxphoto.adjustment.colouring import jacobian_blocks
from jaxphoto.adjustment.normal import factor_reduced, reduce_normal, solve_factored, sum_normal
from jaxphoto.adjustment.residuals import Increments, Residuals
from jaxphoto.adjustment.structure import Structure


class PointElimination(lx.AbstractLinearSolver[lx.AbstractLinearOperator]):
    """Least squares of a damped block Jacobian by its normal equations, points first."""

    structure: Structure
    datum: tuple[Float[Array, "constraints 6 images"], Float[Array, "constraints 3 points"]]

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> lx.AbstractLinearOperator:
        """The state is the operator itself."""
        return operator

    def compute(
        self, state: lx.AbstractLinearOperator, vector: tuple[Residuals, Increments], options: dict[str, Any]
    ) -> tuple[Increments, lx.RESULTS, dict[str, Any]]:
        """The increments x of least |J x - r|^2 + lambda |x|^2."""
        s = self.structure
        blocks = jacobian_blocks(lambda x: state.mv(x)[0], s)
        one = Increments(jnp.ones((6, s.n_images)), jnp.ones(s.n_shared), jnp.ones((3, s.n_points)))
        damping = state.mv(one)[1].points[0, 0] ** 2
        normal = sum_normal(blocks, vector[0], self.datum, s)
        reduced = reduce_normal(normal, damping, s)
        return solve_factored(normal, reduced, factor_reduced(reduced), s), lx.RESULTS.successful, {}

    def transpose(self, state: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        """Not defined: derivatives of an adjustment go through `jaxphoto.adjustment.implicit`."""
        raise ValueError("the least-squares operator of a block has no transposed solve")

    def conj(self, state: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        """Real operators are their own conjugates."""
        return state, options

    def assume_full_rank(self) -> bool:
        """Damping makes every solve full rank."""
        return True


class _Trust(NamedTuple):
    """Damping 1 / step_size, and the reduction of half the square sum that the proposed step promises."""

    step_size: Scalar
    promised: Scalar


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
        return _Trust(jnp.ones(()), jnp.zeros(()))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state: _Trust):
        """Accept or reject the proposal, and adapt the damping."""
        change = f_eval_info.as_min() - f_info.as_min()
        accept = first_step | (change <= -self.low_cutoff * state.promised)
        good = ~first_step & (change < -self.high_cutoff * state.promised)
        factor = jnp.where(accept, jnp.where(good, self.high_constant, 1.0), self.low_constant)
        size = state.step_size * factor
        return size, accept, optx.RESULTS.successful, _Trust(size, state.promised)


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix' Levenberg-Marquardt, stopped by what the next step would do to the unknowns.

    The length of a step d in the metric of the normal matrix, sqrt(d' J'J d), bounds |d| / sigma of every single
    unknown. Once a proposed, practically undamped step is shorter than `tolerance`, it is taken and the work ends: no
    unknown still moves by more than that fraction of its standard deviation.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Scalar]
    descent: optx.DampedNewtonDescent
    search: PromisedReduction
    verbose: Callable[..., None]
    tolerance: float

    def __init__(self, linear_solver: lx.AbstractLinearSolver, tolerance: float):
        # The Cauchy test of optimistix is switched off by zero tolerances: `step` below decides.
        self.rtol, self.atol, self.norm = 0.0, 0.0, optx.max_norm
        self.descent = optx.DampedNewtonDescent(linear_solver=linear_solver)
        self.search = PromisedReduction()
        self.verbose = _silent
        self.tolerance = tolerance

    def step(self, fn, y, args, options, state, tags):
        """One step of optimistix; afterwards `terminate` says whether the step just proposed is negligible."""
        new_y, new, aux = super().step(fn, y, args, options, state, tags)
        proposal = _difference(new.y_eval, new_y)
        seen = _square(new.f_info.jac.mv(proposal))
        damped = _square(proposal) / new.search_state.step_size
        # (J'J + lambda) d = -J'r, so the linear model promises half of d'J'J d + 2 lambda d'd.
        promised = 0.5 * seen + damped
        accepted = new.num_steps_since_acceptance == 0
        settled = accepted & (seen <= self.tolerance**2) & (damped <= seen + self.tolerance**2)
        where = lambda s: (s.terminate, s.search_state.promised)  # noqa: E731
        return new_y, eqx.tree_at(where, new, (settled, promised)), aux

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """The last proposal is part of the answer: it was computed from an accepted iterate and is negligible."""
        y = _where(state.terminate, state.y_eval, y)
        return y, aux, {}


def _silent(**_: Any) -> None:
    """Progress is reported by the caller, after the solve."""


def _difference(a: Increments, b: Increments) -> Increments:
    """a - b."""
    return Increments(*(x - y for x, y in zip(a, b, strict=True)))


def _where(condition: Array, a: Increments, b: Increments) -> Increments:
    """`a` where the condition holds, else `b`."""
    return Increments(*(jnp.where(condition, x, y) for x, y in zip(a, b, strict=True)))


def _square(tree: tuple[Array, ...]) -> Array:
    return sum((jnp.sum(x**2) for x in tree), jnp.zeros(()))
