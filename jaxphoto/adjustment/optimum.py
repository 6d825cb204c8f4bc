"""The optimum of a block: Levenberg-Marquardt forwards, the implicit function theorem for its derivatives.

At the optimum the gradient G(y, v) of half the weighted square sum vanishes, so dy = -H^-1 (dG/dv) dv with H the full
second derivative (Gauss-Newton part and curvature). H is never formed: conjugate gradients on products with it,
preconditioned by the factored normal matrix, from which it differs by the residuals' curvature only.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Int

from jaxphoto.adjustment.colouring import jacobian_blocks
from jaxphoto.adjustment.normal import Normal, factor_reduced, reduce_normal, solve_factored, sum_normal
from jaxphoto.adjustment.residuals import Increments, Residuals, Values, residuals_at
from jaxphoto.adjustment.solver import LevenbergMarquardt, PointElimination
from jaxphoto.adjustment.structure import Structure

# The first damping relative to the normal matrix is the square of this: almost Gauss-Newton.
_FIRST_DAMPING = 1e-4
# The last step moves no unknown by more than this fraction of its standard deviation.
TOLERANCE = 1e-4


class Optimum(NamedTuple):
    """Where the solver ended, after how many steps, and whether the last step was negligible."""

    increments: Increments
    steps: Int[Array, ""]
    converged: Array


def linearise(
    increments: Increments, scale: Increments, values: Values, structure: Structure
) -> tuple[Normal, Residuals]:
    """Undamped normal equations and residuals at start + scale * increments."""
    fn = lambda y: residuals_at(y, scale, values, structure)  # noqa: E731
    residuals, product = jax.linearize(fn, increments)
    blocks = jacobian_blocks(product, structure)
    datum = (values.datum_eop * scale.eop, values.datum_points * scale.points)
    return sum_normal(blocks, residuals, datum, structure), residuals


def zero_increments(structure: Structure) -> Increments:
    """No change from the start."""
    s = structure
    return Increments(jnp.zeros((6, s.n_images)), jnp.zeros(s.n_shared), jnp.zeros((3, s.n_points)))


def unit_scale(structure: Structure) -> Increments:
    """Increments in metres, radians and the parameters' own units; zero for what is held fixed."""
    s = structure
    return Increments(jnp.asarray(s.eop_free), jnp.ones(s.n_shared), jnp.asarray(s.point_free))


def column_scale(normal: Normal) -> Increments:
    """The reciprocal column norms of the Jacobian; zero for what is held fixed."""

    def reciprocal(diagonal):
        return jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), 0.0)

    return Increments(
        reciprocal(jnp.einsum("nii->in", normal.u)),
        reciprocal(jnp.diagonal(normal.uss)),
        reciprocal(jnp.einsum("iip->ip", normal.v)),
    )


@eqx.filter_custom_jvp
def find_optimum(values: Values, *, structure: Structure, max_steps: int) -> Optimum:
    """Levenberg-Marquardt from the start in `values`. Differentiable in every number of `values`."""
    zero = zero_increments(structure)
    scale = starting_scale(values, structure)
    datum = (values.datum_eop * scale.eop, values.datum_points * scale.points)
    solver = LevenbergMarquardt(PointElimination(structure, datum), TOLERANCE)
    solution = optx.least_squares(
        lambda y, args: residuals_at(y, *args),
        solver,
        zero,
        args=(scale, values, structure),
        max_steps=max_steps,
        throw=False,
    )
    converged = (solution.result == optx.RESULTS.successful) & jnp.all(jnp.isfinite(solution.value.eop))
    increments = jax.tree.map(lambda y, k: y * k, solution.value, scale)
    return Optimum(increments, solution.stats["num_steps"], converged)


@find_optimum.def_jvp
def _find_optimum_jvp(primals, tangents, *, structure: Structure, max_steps: int):
    (values,), (direction,) = primals, tangents
    optimum = find_optimum(values, structure=structure, max_steps=max_steps)
    unit, at = unit_scale(structure), optimum.increments

    def gradient(increments, numbers):
        residuals, pull = jax.vjp(lambda y: residuals_at(y, unit, numbers, structure), increments)
        return pull(residuals)[0]

    moved, still = eqx.partition(values, jax.tree.map(lambda t: t is not None, direction, is_leaf=lambda t: t is None))
    _, change = jax.jvp(lambda m: gradient(at, eqx.combine(m, still)), (moved,), (direction,))
    scale = column_scale(linearise(at, unit, values, structure)[0])
    normal = linearise(at, scale, values, structure)[0]
    reduced = reduce_normal(normal, 0.0, structure)
    lower = factor_reduced(reduced)

    def hessian(x: Increments) -> Increments:
        scaled = jax.tree.map(jnp.multiply, x, scale)
        product = jax.jvp(lambda y: gradient(y, values), (at,), (scaled,))[1]
        return jax.tree.map(jnp.multiply, product, scale)

    def precondition(b: Increments) -> Increments:
        right = normal._replace(b_e=b.eop.T, b_s=b.shared, b_p=b.points, rows_b=jnp.zeros_like(normal.rows_b))
        return solve_factored(right, reduced, lower, structure)

    def solve(product, b: Increments) -> Increments:
        return jax.scipy.sparse.linalg.cg(product, b, tol=1e-13, maxiter=100, M=precondition)[0]

    right = jax.tree.map(lambda c, k: -c * k, change, scale)
    x = jax.lax.custom_linear_solve(hessian, right, solve, symmetric=True)
    increments = jax.tree.map(jnp.multiply, x, scale)
    return optimum, Optimum(increments, None, None)


def starting_scale(values: Values, structure: Structure) -> Increments:
    """Column norms at the start, times the square root of the first relative damping."""
    normal, _ = linearise(zero_increments(structure), unit_scale(structure), values, structure)
    return jax.tree.map(lambda k: jax.lax.stop_gradient(k) / _FIRST_DAMPING, column_scale(normal))
