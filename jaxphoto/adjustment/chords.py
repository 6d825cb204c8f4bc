"""Adjustments of many draws of one block with one factor: chord steps from the nominal optimum, with exact gradients.

With N the nominal normal matrix, factored once, and G_i the gradient of draw i,

    y <- y - N^-1 G_i(y)        until the remaining distance is small

converges to the optimum of draw i, because its gradient is exact. The rate of convergence depends on the difference
between N and the draw's own normal matrix. Draws whose steps do not contract need a full adjustment.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment.draw_gradients import Common, Varying, image_gradients, other_gradients, states
from jaxphoto.adjustment.model.numbers import Increments, UnknownArrays

TOLERANCE = 1e-6
"""Maximum remaining distance of an unknown of a draw from its optimum, as a fraction of its standard deviation."""
# Ratio of successive step lengths above which a draw is abandoned, and maximum number of steps.
_CONTRACTS, _MOST_STEPS = 0.5, 20
# Ratio of successive step lengths assumed for the first step.
_FIRST_RATIO = 0.1
# Leaves other than image coordinates that change the residuals of image rows.
_OF_IMAGE_ROWS = {"xy", "sigma_xy", "position", "rotation", "shared", "points"}


class Found(NamedTuple):
    """Unknowns of each draw (draws last), convergence, and number of steps."""

    state: UnknownArrays
    settled: Bool[Array, "draws"]
    steps: Int[Array, "draws"]


class Way(NamedTuple):
    """State of the draws (last axis), in scaled increments from the nominal start."""

    y: Increments
    length: Float[Array, "draws"]
    """Length of the last step, sqrt(x' N x): at least |x| / sigma of every unknown."""
    ratio: Float[Array, "draws"]
    """Ratio of the last two lengths."""
    settled: Bool[Array, "draws"]
    failed: Bool[Array, "draws"]
    steps: Int[Array, "draws"]


@eqx.filter_jit
def find_optima(varying: Varying, common: Common, first_only: bool) -> Found:
    """Find the optimum of every draw; `first_only` returns the first-order approximation."""
    way = chord_steps(varying, common, first_only)
    return Found(states(way.y, varying, common), way.settled, way.steps)


def chord_steps(varying: Varying, common: Common, first_only: bool = False, polished: bool = True) -> Way:
    """Iterate chord steps of every draw from the nominal optimum. `polished`: the nominal gradient is exactly zero."""
    size = next(iter(varying.values())).shape[-1]
    y = jax.tree.map(lambda v: jnp.broadcast_to(jnp.asarray(v)[..., None], (*v.shape, size)), common.at.increments)
    of_image_rows = bool(_OF_IMAGE_ROWS & set(varying))
    none = jnp.zeros(size, bool)
    way = Way(y, jnp.full(size, jnp.inf), jnp.zeros(size), none, none, jnp.zeros(size, int))
    if not of_image_rows:
        way = _taken(way, _others_alone(y, varying, common), common)
        # Without `polished`, the remaining nominal gradient may exceed the tolerance.
        way = way if polished else way._replace(settled=none)
    elif first_only:
        way = _taken(way, _all(y, varying, common), common)
    if not first_only:
        way = jax.lax.while_loop(
            lambda way: ~jnp.all(way.settled | way.failed),
            lambda way: _taken(way, _all(way.y, varying, common), common),
            way,
        )
    return way


def _taken(way: Way, b: Increments, common: Common) -> Way:
    """Take one step with the gradients `b` for the draws that have not finished."""
    x = _solutions(b, common)
    length = _length(x, b)
    ratio = jnp.where(jnp.isinf(way.length), _FIRST_RATIO, length / jnp.maximum(way.length, 1e-300))
    active = ~(way.settled | way.failed)
    contracts = (ratio <= _CONTRACTS) & (way.steps < _MOST_STEPS)
    worst = jnp.maximum(ratio, way.ratio)
    missing = length * worst / jnp.maximum(1 - worst, 1e-3)
    # Steps below the tolerance are rounding errors, which need not contract.
    settled = active & ((missing <= TOLERANCE) & contracts | (length <= 0.1 * TOLERANCE))
    return Way(
        y=jax.tree.map(lambda a, d: jnp.where(active, a - d, a), way.y, x),
        length=length,
        # The assumed contraction of the first step does not apply to the second.
        ratio=jnp.where(jnp.isinf(way.length), 0.0, ratio),
        settled=way.settled | settled,
        failed=way.failed | (active & ~settled & ~contracts),
        steps=way.steps + active,
    )


def _all(y: Increments, varying: Varying, common: Common) -> Increments:
    """Return the gradient of each draw."""
    return jax.tree.map(jnp.add, image_gradients(y, varying, common), other_gradients(y, varying, common))


def _others_alone(zero: Increments, varying: Varying, common: Common) -> Increments:
    """Return the gradient at the nominal optimum for draws with nominal image rows: the change of all other rows."""
    nominal = other_gradients(jax.tree.map(lambda v: v[..., :1], zero), {}, common)
    return jax.tree.map(jnp.subtract, other_gradients(zero, varying, common), nominal)


def _solutions(b: Increments, common: Common) -> Increments:
    return jax.vmap(common.solve, -1, -1)(b)


def _length(x: Increments, b: Increments) -> Float[Array, "draws"]:
    """Return sqrt(x' N x) of x = N^-1 b."""
    along = (jnp.sum(u * v, axis=tuple(range(u.ndim - 1))) for u, v in zip(x, b, strict=True))
    return jnp.sqrt(jnp.maximum(sum(along, jnp.zeros(())), 0.0))
