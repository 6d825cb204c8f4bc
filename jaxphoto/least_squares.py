"""Levenberg-Marquardt for small least-squares problems, one or many together under `jax.vmap`.

    r'r -> min,    (N + lambda diag N) step = -J'r,    N = J'J

optimistix runs the iteration, with the solver of this module. `optimistix.LevenbergMarquardt` is not used: it damps all
unknowns equally, whatever their units, and calls LAPACK for many problems at once, which may deadlock
(`jaxphoto.linear_algebra`). The adjustment of a block has its own solver, `jaxphoto.adjustment.solver`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

# Relative change of r'r below which it is a rounding error, and minimum lambda: with a smaller one, the rounding errors
# of a step in a weakly determined direction would be large.
_ROUNDING, _LEAST_DAMPING = 1e-13, 1e-12


class Fit(NamedTuple):
    """Solution of one least-squares problem."""

    unknowns: Float[Array, "u"]
    normal: Float[Array, "u u"]
    """N = J'J."""
    cost: Float[Array, ""]
    """r'r."""
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


class _State(NamedTuple):
    trial: Float[Array, "u"]
    """Unknowns to evaluate next."""
    normal: Float[Array, "u u"]
    gradient: Float[Array, "u"]
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    is_small: Bool[Array, ""]
    """True if the step to `trial` is small enough to be the last."""
    converged: Bool[Array, ""]


class _LevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    rtol: float
    atol: float
    norm: Callable
    damping: float

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        u = len(y)
        first, no = jnp.asarray(10 * self.damping), jnp.asarray(False)
        return _State(y, jnp.zeros((u, u)), jnp.zeros(u), jnp.asarray(jnp.inf), first, no, no)

    def step(self, fn, y, args, options, state, tags):
        def residuals(y):
            r, _ = fn(y, args)
            return r, r

        jacobian, r = jax.jacfwd(residuals, has_aux=True)(state.trial)
        cost = r @ r
        better = (cost <= (1 + _ROUNDING) * state.cost) | (state.cost == jnp.inf)
        candidate = (state.trial, jacobian.T @ jacobian, jacobian.T @ r, cost)
        y, normal, gradient, cost = (jnp.where(better, a, b) for a, b in zip(candidate, (y, *state[1:4]), strict=True))
        damping = jnp.maximum(state.damping * jnp.where(better, 0.1, 10.0), _LEAST_DAMPING)
        diagonal = jnp.diagonal(normal)
        step = -_solve(normal + jnp.diag(damping * jnp.where(diagonal > 0, diagonal, 1.0)), gradient)
        limit = self.atol + self.rtol * jnp.sqrt(cost)
        is_small = jnp.abs(step @ normal @ step) <= limit**2
        return y, _State(y + step, normal, gradient, cost, damping, is_small, state.is_small), None

    def terminate(self, fn, y, args, options, state, tags):
        return state.converged, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def _solve(a: Float[Array, "n n"], b: Float[Array, "n"]) -> Float[Array, "n"]:
    """Solve a positive definite system of a few unknowns by elimination, without LAPACK under `jax.vmap`."""
    rows = jnp.column_stack([a, b])

    def eliminate(k, rows):
        pivot = rows[k] / rows[k, k]
        return (rows - rows[:, k, None] * pivot).at[k].set(pivot)

    return jax.lax.fori_loop(0, len(b), eliminate, rows)[:, -1]


def least_squares(
    residuals: Callable[[Array, Any], Float[Array, "n"]],
    start: Float[Array, "u"],
    data: Any = None,
    *,
    damping: float = 1e-3,
    rtol: float = 1e-8,
    atol: float = 1e-12,
    max_steps: int = 50,
) -> Fit:
    """Minimise the sum of squares of `residuals(unknowns, data)` from `start`.

    `damping` is the initial lambda. The iteration converges if a step changes the residuals by less than `rtol` of
    their norm or by `atol`; otherwise it ends after `max_steps`, not converged.
    """
    solver: Any = _LevenbergMarquardt(rtol, atol, optx.two_norm, damping)
    solution: Any = optx.least_squares(residuals, solver, start, data, max_steps=max_steps, throw=False)
    state = solution.state
    return Fit(solution.value, state.normal, state.cost, state.converged, solution.stats["num_steps"])
