"""The distribution of S = v'v where v is normal: generalised chi-square, exactly.

With the covariance of v written U diag(w) U' and b = U' mean(v), S is a constant plus the sum of squares
(b_i + sqrt(w_i) z_i)^2 over independent standard normal z_i, and its cumulant function is

    K(t) = constant t + sum [ b_i^2 t / (1 - 2 w_i t) - log(1 - 2 w_i t) / 2 ],   t < 1 / (2 max w)

P(S > x) is the integral of exp(K(t) - t x) / (2 pi i t) upwards across the real axis in 0 < t < 1 / (2 max w). The path
here crosses it at the saddle point of the integrand, so that nothing cancels however far x lies in the tail, and bends
to the right, where exp(-t x) dies out; crossing at t < 0 gives -P(S < x) in the same way.
Source: contour integration of the saddle point, Rice (1980), SIAM J. Sci. Stat. Comput. 1, 438-448.
"""

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.short_repr import shown

# Variances below this part of the largest add their mean, and no spread that could be seen.
_NEGLIGIBLE = 1e-14
# The standard deviation over the mean of S, squared, below which sqrt(S) is as good as normal.
_CONCENTRATED = 1e-10
_NODES = 800
# Exponent at which the integrand has died out.
_DEAD = 40.0


@shown
class QuadraticForm(eqx.Module):
    """S = constant + sum (sqrt(shift_i) + sqrt(weight_i) z_i)^2, z_i independent standard normal.

    `weights` are positive variances and `shifts` squared means along the same axes; all in one unit squared.
    """

    weights: Float[np.ndarray, "axes"]
    shifts: Float[np.ndarray, "axes"]
    constant: float = 0.0

    @staticmethod
    def of_normal(
        mean: Float[np.ndarray, "n"], jacobian: Float[np.ndarray, "n parameters"], covariance: Float[np.ndarray, "p p"]
    ) -> "QuadraticForm":
        """That of v'v, v normal with this mean and the covariance J Q J'; a singular Q is welcome."""
        root = covariance_root(covariance)
        axes, spread, _ = np.linalg.svd(np.asarray(jacobian) @ root, full_matrices=False)
        weights = spread**2
        kept = weights > _NEGLIGIBLE * weights.max(initial=0.0)
        along = (np.asarray(mean) @ axes)[kept] ** 2
        rest = max(float((np.asarray(mean) ** 2).sum() - along.sum()), 0.0) + float(weights[~kept].sum())
        return QuadraticForm(weights[kept], along, rest)

    @property
    def mean(self) -> float:
        """E[S] = constant + sum (weights + shifts)."""
        return self.constant + self._spread

    @property
    def _spread(self) -> float:
        """E[S] - constant."""
        return float((self.weights + self.shifts).sum())

    @property
    def variance(self) -> float:
        """Var[S] = sum (2 weights^2 + 4 weights shifts)."""
        return float((2 * self.weights**2 + 4 * self.weights * self.shifts).sum())

    @property
    def mean_of_root(self) -> float:
        """E[sqrt(S)]: 1 / (2 sqrt(pi)) times the integral of (1 - E[exp(-t S)]) t^(-3/2) over t > 0."""
        if not len(self.weights):
            return self.constant**0.5
        # In log t the integrand is smooth and falls as exp(-|log t| / 2): the trapezoidal rule is exact to rounding.
        log_t, step = np.linspace(-80.0, 80.0, 1601, retstep=True)
        t = np.exp(log_t) / self.mean
        integrand = -np.expm1(self._cumulant(-t) - self.constant * t) * np.exp(-log_t / 2)
        return float(integrand.sum() * step * (self.mean / np.pi) ** 0.5 / 2)

    @property
    def sigma_of_root(self) -> float:
        """The standard deviation of sqrt(S)."""
        if self.variance < _CONCENTRATED * self.mean**2:
            # Of first order, which is exact here; the difference below would be rounding.
            return (self.variance / self.mean) ** 0.5 / 2 if self.mean > 0 else 0.0
        return max(self.mean - self.mean_of_root**2, 0.0) ** 0.5

    def exceeded(self, x: float) -> float:
        """P(S > x)."""
        if x <= self.constant or not len(self.weights):
            return float(x < self.constant or len(self.weights) > 0)
        tail = float(np.exp(self._log_tail(x - self.constant)))
        return tail if x - self.constant > self._spread else 1 - tail

    def quantile(self, probability: float) -> float:
        """The x with P(S < x) = `probability`, which lies between 0 and 1."""
        if not len(self.weights):
            return self.constant
        spread, sigma = self._spread, self.variance**0.5
        upper = probability > 1 - self.exceeded(self.mean)
        wanted = 1 - probability if upper else probability

        def place(u):
            return spread + sigma * u if upper else spread * np.exp(-u * sigma / spread)

        def off(u):
            return self._log_tail(place(u)) - np.log(wanted)

        far = 1.0
        while off(far) > 0:
            far *= 2
        # From just beyond the mean, on the side whose tail `_log_tail` is.
        return float(self.constant + place(scipy.optimize.brentq(off, 1e-9, far, xtol=1e-13)))

    def _cumulant(self, t):
        """K(t) but for the constant, of one t or many, real or complex."""
        t = np.asarray(t)[..., None]
        apart = 1 - 2 * self.weights * t
        return (self.shifts * t / apart - np.log1p(-2 * self.weights * t) / 2).sum(-1)

    def _slope(self, t: float, x: float) -> float:
        """The derivative of K(t) - t x - log|t| at a real t."""
        apart = 1 - 2 * self.weights * t
        return float((self.shifts / apart**2 + self.weights / apart).sum() - x - 1 / t)

    def _log_tail(self, x: float) -> float:
        """The logarithm of P(S - constant > x) above the mean, of P(S - constant < x) at and below it."""
        pole = 1 / (2 * self.weights.max())
        # Between their poles the exponents are convex; the root of the slope is looked for in a logarithm of t.
        if x > self._spread:
            place, ends = (lambda q: pole / (1 + np.exp(-q))), (-40.0, 34.0)
        else:
            place, ends = (lambda q: -pole * np.exp(-q)), (-200.0, 80.0)
        saddle = place(scipy.optimize.brentq(lambda q: self._slope(place(q), x), *ends, xtol=1e-13))
        w, apart = self.weights, 1 - 2 * self.weights * saddle
        second = (4 * w * self.shifts / apart**3 + 2 * w**2 / apart**2).sum()
        third = (24 * w**2 * self.shifts / apart**4 + 8 * w**3 / apart**3).sum()
        # The parabola that osculates the steepest descent of exp(K(t) - t x); the pole at 0 would bend it too far.
        bend, reach = self._path(x, saddle, third / (6 * second), (second + 1 / saddle**2) ** -0.5)
        y = np.linspace(0.0, reach, _NODES + 1)
        t = saddle + 1j * y + bend * y**2
        height = self._cumulant(saddle) - saddle * x
        integrand = np.exp(self._cumulant(t) - t * x - height) / t * (1j + 2 * bend * y)
        half = (integrand[0] / 2 + integrand[1:].sum()) * y[1]
        return float(height + np.log(abs(half.imag) / np.pi))

    def _path(self, x: float, saddle: float, bend: float, width: float) -> tuple[float, float]:
        """The bend of a path on which the integrand falls all the way, and where it has died out.

        With variances of very different size the osculating parabola may turn off the descent: then a straighter one.
        """
        y = width * np.geomspace(0.05, 1e5, 300)
        for straighter in 0.25 ** np.arange(12.0):
            t = saddle + 1j * y + straighter * bend * y**2
            fallen = (self._cumulant(saddle) - saddle * x) - (self._cumulant(t) - t * x).real
            dead = int(np.argmax(fallen > _DEAD))
            if dead and (np.diff(fallen[: dead + 1]) > 0).all():
                break
        return straighter * bend, float(y[dead])


def covariance_root(covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """A matrix B with B B' = Q of a covariance that may be singular, scaled so that units do not matter."""
    covariance = np.asarray(covariance, float)
    sigma = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    scale = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
