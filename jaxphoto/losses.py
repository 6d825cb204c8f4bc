"""Robust loss functions: large residuals of a row have less influence than their squares.

With v the whitened residual of a row (k components: an image point has two) and u = v'v / (s k0)^2 for a scale s and a
constant k0, the cost of a row is v'v gain(u) instead of v'v. It is implemented as the residual v sqrt(gain(u)), whose
square is the cost: derivatives of any order are exact, and one solver supports all losses. The weight of the row is the
derivative of its cost with respect to v'v.

k0 is chosen for 95 % efficiency: estimates from normal errors have standard deviations as if 5 % of the observations
were missing. For scalar rows these are the constants of textbooks (Huber 1.345, Tukey 4.685).

Sources: Huber (1981), Robust statistics; Beaton and Tukey (1974), Technometrics 16; Geman and McClure (1987), Bulletin
of the ISI 52; Lange, Little and Taylor (1989), Robust statistical modeling using the t distribution, JASA 84.
"""

import abc
import dataclasses
import functools
import math
from typing import ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.compiling import call_compiled

EFFICIENCY = 0.95
"""Efficiency for normal errors relative to least squares; determines k0."""


class AbstractLoss(eqx.Module):
    """Loss of the rows of a group. All fields are values: a change of them requires no recompilation."""

    name: eqx.AbstractClassVar[str]
    threshold: Float[ArrayLike, ""] | float | None = None
    """k0, in standard deviations, beyond which rows have less weight. None: derived from `EFFICIENCY`."""
    scale: Float[ArrayLike, ""] | float = 1.0
    """s: standard deviation of whitened residuals. Scales the threshold; the sigmas of rows are unchanged."""

    @abc.abstractmethod
    def gain(self, u: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the cost of a row over its square: 1 for u = 0, and smooth there."""

    def for_rows_of(self, numbers: int) -> Self:
        """Return the loss with k0 for rows of this number of components, as arrays."""
        k0 = _usual_threshold(type(self), numbers) if self.threshold is None else self.threshold
        return jax.tree.map(lambda v: np.asarray(v, float), dataclasses.replace(self, threshold=k0))

    def reduced(self, *v: Float[Array, "..."]) -> tuple[Float[Array, "..."], ...]:
        """Return residuals whose sums of squares are the costs of the rows."""
        root = jnp.sqrt(self.factor(jnp.asarray(sum(x * x for x in v))))
        return tuple(x * root for x in v)

    def weights(self, square: Float[np.ndarray, "n"], numbers: int) -> Float[np.ndarray, "n"]:
        """Return weights of rows with this number of components and v'v: 1 full, 0 none."""
        return np.asarray(call_compiled(_weights, self.for_rows_of(numbers), np.asarray(square, float)))

    def factor(self, square: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the cost of rows over their v'v."""
        assert self.threshold is not None, "`for_rows_of` gives it"
        return self.gain(square / (self.scale * self.threshold) ** 2)


class LinearisedLoss(eqx.Module):
    """Linearisation of a loss for normal equations: J'r is half the gradient of the cost, J'J approximately half its
    second derivative.

    The second derivative of a row with respect to its whitened residual v is w across v, and w + 2 w' v'v along it,
    with w' the derivative of the weight with respect to v'v. The latter is zero or negative for large residuals: it is
    limited to at least `_LEAST_SLOPE` w.
    """

    loss: AbstractLoss

    def reduced(self, *v: Float[Array, "..."]) -> tuple[Float[Array, "..."], ...]:
        """Return residuals for normal equations; their squares are meaningless."""
        at = [jax.lax.stop_gradient(x) for x in v]
        square = jnp.asarray(sum(x * x for x in at))
        ones = jnp.ones_like(square)
        weight = lambda q: jax.jvp(lambda q: _cost(q, self.loss), (q,), (ones,))[1]  # noqa: E731
        w, slope = jax.jvp(weight, (square,), (ones,))
        root = jnp.sqrt(jnp.where(w > 0, w, 0.0))
        along = jnp.sqrt(jnp.maximum(1 + 2 * slope * square / jnp.where(w > 0, w, 1.0), _LEAST_SLOPE))
        step = [x - x0 for x, x0 in zip(v, at, strict=True)]
        both = sum(x0 * d for x0, d in zip(at, step, strict=True)) / jnp.where(square > 0, square, 1.0)
        return tuple(root * (d + (along - 1) * both * x0 + x0 / along) for d, x0 in zip(step, at, strict=True))


# Minimum second derivative along the residual, relative to the weight. Closer to zero, points with contradicting rays
# diverge; 1 (reweighting) takes twice as many steps.
_LEAST_SLOPE = 0.5


class Huber(AbstractLoss):
    """Huber loss: squares up to k0, linear beyond: a unique optimum, and every row retains some influence."""

    name: ClassVar[str] = "huber"

    def gain(self, u: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return 1 up to u = 1, then (2 sqrt(u) - 1) / u."""
        far = jnp.where(u > 1, u, 1.0)
        return jnp.where(u > 1, (2 * jnp.sqrt(far) - 1) / far, 1.0)


class Tukey(AbstractLoss):
    """Tukey biweight: rows beyond k0 have no influence."""

    name: ClassVar[str] = "tukey"

    def gain(self, u: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return 1 - u + u^2 / 3 up to u = 1, then 1 / (3 u)."""
        near, far = jnp.minimum(u, 1.0), jnp.where(u > 1, u, 1.0)
        return jnp.where(u > 1, 1 / (3 * far), 1 - near + near**2 / 3)


class GemanMcClure(AbstractLoss):
    """Geman-McClure loss: the weight decreases with the fourth power of the residual."""

    name: ClassVar[str] = "geman_mcclure"

    def gain(self, u: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return 1 / (1 + u)."""
        return 1 / (1 + u)


class StudentT(AbstractLoss):
    """Student's t: -2 log of the density of `scale` s and k0^2 degrees of freedom, multivariate for rows of several
    components.

    Scaled to a weight of 1 at zero residual: the sigmas of rows retain their meaning relative to other groups.
    """

    name: ClassVar[str] = "student_t"

    def gain(self, u: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return log(1 + u) / u."""
        # For smaller u the quotient loses digits; the neglected terms of the series are below rounding errors.
        small = u < 1e-3
        far = jnp.where(small, 1.0, u)
        return jnp.where(small, 1 - u / 2 + u**2 / 3 - u**3 / 4 + u**4 / 5, jnp.log1p(far) / far)


LOSSES: dict[str, type[AbstractLoss]] = {loss.name: loss for loss in (Huber, Tukey, GemanMcClure, StudentT)}
"""Losses by name."""


def _cost(q, loss: AbstractLoss):
    return q * loss.factor(q)


@eqx.filter_jit
def _weights(loss: AbstractLoss, square: Array) -> Array:
    return jax.vmap(jax.grad(_cost), (0, None))(square, loss)


@functools.cache
def _usual_threshold(kind: type[AbstractLoss], numbers: int) -> float:
    """Return k0 of efficiency `EFFICIENCY` for normal errors by bisection.

    The efficiency is E[w q]^2 / (k E[w^2 q]), with q chi-square of k degrees of freedom. (E[w q] / k is the mean second
    derivative, by Stein's lemma.)
    """
    s = np.linspace(0.0, _FARTHEST, _NODES)
    density = s ** (numbers - 1) * np.exp(-(s**2) / 2)
    density /= np.trapezoid(density, s)

    def efficiency(k0: float) -> float:
        w = kind(k0).weights(s**2, numbers)
        mean = lambda v: float(np.trapezoid(v * density, s))  # noqa: E731
        return mean(w * s**2) ** 2 / (numbers * mean(w**2 * s**2))

    low, high = 0.1, 100.0
    while high / low > 1 + 1e-10:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if efficiency(middle) < EFFICIENCY else (low, middle)
    return high


# Maximum residual of a row with normal errors (standard deviations), the limit of the integrals of `_usual_threshold`,
# and number of nodes.
_FARTHEST, _NODES = 12.0, 2401
