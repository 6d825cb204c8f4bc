"""The optimum of a block as a function of its numbers: its derivatives by the implicit function theorem.

At the optimum the gradient G(y, v) of half the weighted square sum vanishes, so dy = -H^-1 (dG/dv) dv with H the full
second derivative (Gauss-Newton part and curvature). H is never formed: conjugate gradients on products with it,
preconditioned by the factored normal matrix, from which it differs by the residuals' curvature only.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from jaxphoto.adjustment.layout.tiled import TiledStructure, TiledValues
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.side_by_side import ImageRows, optimum_of
from jaxphoto.adjustment.solver.band import factor_band
from jaxphoto.adjustment.solver.elimination import solve_factored
from jaxphoto.adjustment.solver.levenberg_marquardt import Task
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.adjustment.solver.optimum import Optimum, typical_scale, unit_scale
from jaxphoto.adjustment.solver.reduced import reduce_normal


def find_optimum(values: TiledValues, structure: TiledStructure, task: Task, rows: ImageRows) -> Optimum:
    """Levenberg-Marquardt from the start in `values`; under `jax.vmap`, `side_by_side`.

    Differentiable in every number of `values`.
    """
    # Indices stay concrete: they are no arguments of what is differentiated and mapped.
    find = eqx.filter_custom_jvp(lambda values: optimum_of(values, structure, task, rows))

    @find.def_jvp
    def derivative(primals, tangents):
        (values,), (direction,) = primals, tangents
        optimum = find(values)
        return optimum, _derivative(values, direction, optimum.increments, structure)

    return find(values)


def _derivative(values: TiledValues, direction: Any, at: Increments, structure: TiledStructure) -> Optimum:
    """How the optimum, which is `at` these increments, moves with the values."""
    unit = unit_scale(structure)

    def gradient(increments, numbers):
        residuals, pull = jax.vjp(lambda y: Linearised(y, unit, numbers, structure).residuals(), increments)
        return pull(residuals)[0]

    moved, still = eqx.partition(values, jax.tree.map(lambda t: t is not None, direction, is_leaf=lambda t: t is None))
    _, change = jax.jvp(lambda m: gradient(at, eqx.combine(m, still)), (moved,), (direction,))
    scale = typical_scale(values, structure)
    # The preconditioner belongs to the optimum: it wants its place in scaled increments.
    place = jax.tree.map(lambda a, k: jnp.where(k > 0, a / jnp.where(k > 0, k, 1.0), 0.0), at, scale)
    there = Linearised(place, scale, values, structure).for_normal_equations
    a, reduced, _ = reduce_normal(there, 0.0)
    factor = factor_band(a)

    right, unravel = ravel_pytree(jax.tree.map(lambda c, k: -c * k, change, scale))
    # One flat vector: the transposed solve wants all of its right-hand side to depend on the direction, or none.
    flat = lambda tree: ravel_pytree(tree)[0]  # noqa: E731

    def hessian(x):
        scaled = jax.tree.map(jnp.multiply, unravel(x), scale)
        product = jax.jvp(lambda y: gradient(y, values), (at,), (scaled,))[1]
        return flat(jax.tree.map(jnp.multiply, product, scale))

    def precondition(b):
        return flat(solve_factored(reduced, factor, unravel(b), there))

    def solve(product, b):
        return jax.scipy.sparse.linalg.cg(product, b, tol=1e-13, maxiter=100, M=precondition)[0]

    x = unravel(jax.lax.custom_linear_solve(hessian, right, solve, symmetric=True))
    increments = jax.tree.map(jnp.multiply, x, scale)
    return Optimum(increments, None, None, None)
