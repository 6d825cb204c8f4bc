"""Derivatives of the optimum with respect to the values of a block, by the implicit function theorem.

At the optimum the gradient G(y, v) of half the weighted sum of squares vanishes, so dy = -H^-1 (dG/dv) dv with H the
full second derivative (Gauss-Newton part and curvature). H is never formed: conjugate gradients use products with it,
preconditioned by the factored normal matrix, from which it differs only by the curvature of the residuals.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxphoto.adjustment.layout.padded import PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.solver.band import factor_band
from jaxphoto.adjustment.solver.elimination import solve_factored
from jaxphoto.adjustment.solver.levenberg_marquardt import SolveMode
from jaxphoto.adjustment.solver.normal import Linearised
from jaxphoto.adjustment.solver.optimum import Optimum, typical_scale, unit_scale
from jaxphoto.adjustment.solver.reduced import reduce_normal
from jaxphoto.adjustment.vmap_rule import ImageRowLists, optimum_of


def find_optimum(values: PaddedValues, structure: PaddedStructure, task: SolveMode, rows: ImageRowLists) -> Optimum:
    """Run Levenberg-Marquardt from the start in `values`; under `jax.vmap`, use `side_by_side`.

    Differentiable with respect to every value in `values`.
    """
    # Indices stay concrete: they are not arguments of the differentiated and mapped function.
    find = eqx.filter_custom_jvp(lambda values: optimum_of(values, structure, task, rows))

    @find.def_jvp
    def derivative(primals, tangents):
        (values,), (direction,) = primals, tangents
        optimum = find(values)
        return optimum, _derivative(values, direction, optimum.increments, structure)

    return find(values)


def _derivative(values: PaddedValues, direction: Any, at: Increments, structure: PaddedStructure) -> Optimum:
    """Differentiate the optimum, at these increments, with respect to the values."""
    scale = typical_scale(values, structure)

    # Functions called by batching rules close over no array: a rule may run in another trace.
    def gradient(increments, numbers):
        unit = unit_scale(structure)
        residuals, jt_product = jax.vjp(lambda y: Linearised(y, unit, numbers, structure).residuals(), increments)
        return jt_product(residuals)[0]

    moved, still = eqx.partition(values, jax.tree.map(lambda t: t is not None, direction, is_leaf=lambda t: t is None))
    _, change = jax.jvp(lambda m: gradient(at, eqx.combine(m, still)), (moved,), (direction,))
    right, unravel = ravel_pytree(jax.tree.map(lambda c, k: -c * k, change, scale))
    # Use one flat vector: JAX can transpose the linear solve only if the entire right-hand side depends on the tangent.
    flat = lambda tree: ravel_pytree(tree)[0]  # noqa: E731

    # jit caches the trace for the product and for its inverse.
    @jax.jit
    def hessian(of_block, x):
        values, at, scale = of_block
        scaled = jax.tree.map(jnp.multiply, unravel(x), scale)
        product = jax.jvp(lambda y: gradient(y, values), (at,), (scaled,))[1]
        return flat(jax.tree.map(jnp.multiply, product, scale))

    @jax.custom_batching.custom_vmap
    def solve(of_block, rights):
        """Solve H x = b for the rows of `rights`."""
        values, at, scale = of_block
        # The preconditioner is evaluated at the optimum, in scaled increments.
        place = jax.tree.map(lambda a, k: jnp.where(k > 0, a / jnp.where(k > 0, k, 1.0), 0.0), at, scale)
        there = Linearised(place, scale, values, structure).for_normal_equations
        a, reduced, _ = reduce_normal(there, 0.0)
        factor = factor_band(a)

        def one(b):
            product = partial(hessian, of_block)
            precondition = lambda b: flat(solve_factored(reduced, factor, unravel(b), there))  # noqa: E731
            return jax.scipy.sparse.linalg.cg(product, b, tol=1e-13, maxiter=100, M=precondition)[0]

        return one(rights[0])[None] if len(rights) == 1 else jax.vmap(one)(rights)

    @solve.def_vmap
    def rule(size: int, batched: list[Any], of_block: Any, rights: Array) -> tuple[Array, bool]:
        """Batching rule: right-hand sides of one block share its factor; several blocks are solved sequentially."""
        if not any(jax.tree.leaves(batched[0])):
            found = solve(of_block, rights.reshape(-1, rights.shape[-1]))
            return found.reshape(rights.shape), True
        mapped, common = eqx.partition((of_block, rights), tuple(batched))
        return jax.lax.map(lambda own: solve(*eqx.combine(own, common)), mapped), True

    of_block = values, at, scale
    inverse = lambda _, b: solve(of_block, b[None])[0]  # noqa: E731
    x = unravel(jax.lax.custom_linear_solve(partial(hessian, of_block), right, inverse, symmetric=True))
    return Optimum(jax.tree.map(jnp.multiply, x, scale), None, None, None)
