"""Exact distribution of S = v'v for a normal v (generalised chi-square).

With the covariance U diag(w) U' of v and b = U' mean(v), S is a constant plus the sum of squares (b_i + sqrt(w_i)
z_i)^2 over independent standard normal z_i, and its cumulant function is

    K(t) = constant t + sum [ b_i^2 t / (1 - 2 w_i t) - log(1 - 2 w_i t) / 2 ],   t < 1 / (2 max w)

P(S > x) is the integral of exp(K(t) - t x) / (2 pi i t) upwards across the real axis in 0 < t < 1 / (2 max w). The path
crosses the real axis at the saddle point of the integrand, which avoids cancellation far in the tail, and bends to the
right, where exp(-t x) vanishes. Crossing at t < 0 gives -P(S < x).
Source: contour integration through the saddle point, Rice (1980), SIAM J. Sci. Stat. Comput. 1, 438-448.
"""

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.short_repr import pretty_repr

# Ratio to the largest variance below which a variance is replaced by its mean contribution.
_NEGLIGIBLE = 1e-14
# Squared ratio of standard deviation to mean of S below which sqrt(S) is treated as normal.
_CONCENTRATED = 1e-10
_NODES = 800
# Exponent at which the integrand is treated as zero.
_NEGLIGIBLE_EXPONENT = 40.0


@pretty_repr
class QuadraticForm(eqx.Module):
    """S = constant + sum (sqrt(shift_i) + sqrt(weight_i) z_i)^2, z_i independent standard normal.

    `weights` are positive variances, `shifts` squared means along the same axes, and `constant` the remainder; all in
    the same squared unit.
    """

    weights: Float[np.ndarray, "axes"]
    shifts: Float[np.ndarray, "axes"]
    constant: float = 0.0

    @staticmethod
    def of_normal(
        mean: Float[np.ndarray, "n"], jacobian: Float[np.ndarray, "n parameters"], covariance: Float[np.ndarray, "p p"]
    ) -> "QuadraticForm":
        """Return the form v'v for a normal v with this mean and the covariance J Q J'; Q may be singular."""
        root = covariance_root(covariance)
        axes, spread, _ = np.linalg.svd(np.asarray(jacobian) @ root, full_matrices=False)
        weights = spread**2
        significant = weights > _NEGLIGIBLE * weights.max(initial=0.0)
        along = (np.asarray(mean) @ axes)[significant] ** 2
        rest = max(float((np.asarray(mean) ** 2).sum() - along.sum()), 0.0) + float(weights[~significant].sum())
        return QuadraticForm(weights[significant], along, rest)

    @property
    def mean(self) -> float:
        """Return E[S] = constant + sum (weights + shifts)."""
        return self.constant + self._spread

    @property
    def _spread(self) -> float:
        """Return E[S] - constant."""
        return float((self.weights + self.shifts).sum())

    @property
    def variance(self) -> float:
        """Return Var[S] = sum (2 weights^2 + 4 weights shifts)."""
        return float((2 * self.weights**2 + 4 * self.weights * self.shifts).sum())

    @property
    def mean_of_root(self) -> float:
        """Return E[sqrt(S)] = 1 / (2 sqrt(pi)) times the integral of (1 - E[exp(-t S)]) t^(-3/2) over t > 0."""
        if not len(self.weights):
            return self.constant**0.5
        # Integrate over log t, where the integrand is smooth and decays as exp(-|log t| / 2): the trapezoidal rule is
        # exact to rounding.
        log_t, step = np.linspace(-80.0, 80.0, 1601, retstep=True)
        t = np.exp(log_t) / self.mean
        integrand = -np.expm1(self._cumulant(-t) - self.constant * t) * np.exp(-log_t / 2)
        return float(integrand.sum() * step * (self.mean / np.pi) ** 0.5 / 2)

    @property
    def sigma_of_root(self) -> float:
        """Return the standard deviation of sqrt(S)."""
        if self.variance < _CONCENTRATED * self.mean**2:
            # Use first-order propagation: exact to rounding here, unlike the difference below.
            return (self.variance / self.mean) ** 0.5 / 2 if self.mean > 0 else 0.0
        return max(self.mean - self.mean_of_root**2, 0.0) ** 0.5

    def tail_probability(self, x: float) -> float:
        """Return P(S > x)."""
        if x <= self.constant or not len(self.weights):
            return float(x < self.constant or len(self.weights) > 0)
        tail = float(np.exp(self._log_tail(x - self.constant)))
        return tail if x - self.constant > self._spread else 1 - tail

    def quantile(self, probability: float) -> float:
        """Return x with P(S < x) = `probability`, which is strictly between 0 and 1."""
        if not len(self.weights):
            return self.constant
        spread, sigma = self._spread, self.variance**0.5
        upper = probability > 1 - self.tail_probability(self.mean)
        target = 1 - probability if upper else probability

        def x_of(u):
            return spread + sigma * u if upper else spread * np.exp(-u * sigma / spread)

        def difference(u):
            return self._log_tail(x_of(u)) - np.log(target)

        far = 1.0
        while difference(far) > 0:
            far *= 2
        # Start just beyond the mean, on the side of the tail.
        return float(self.constant + x_of(scipy.optimize.brentq(difference, 1e-9, far, xtol=1e-13)))

    def _cumulant(self, t):
        """Return K(t) without the constant term, for real or complex t."""
        t = np.asarray(t)[..., None]
        denominator = 1 - 2 * self.weights * t
        return (self.shifts * t / denominator - np.log1p(-2 * self.weights * t) / 2).sum(-1)

    def _slope(self, t: float, x: float) -> float:
        """Return the derivative of K(t) - t x - log|t| at real t."""
        denominator = 1 - 2 * self.weights * t
        return float((self.shifts / denominator**2 + self.weights / denominator).sum() - x - 1 / t)

    def _log_tail(self, x: float) -> float:
        """Return the logarithm of P(S - constant > x) above the mean, of P(S - constant < x) at and below the mean."""
        pole = 1 / (2 * self.weights.max())
        # The exponent is convex between its poles: find the root of its slope on a logarithmic scale of t.
        if x > self._spread:
            t_of, ends = (lambda q: pole / (1 + np.exp(-q))), (-40.0, 34.0)
        else:
            t_of, ends = (lambda q: -pole * np.exp(-q)), (-200.0, 80.0)
        saddle = t_of(scipy.optimize.brentq(lambda q: self._slope(t_of(q), x), *ends, xtol=1e-13))
        w, denominator = self.weights, 1 - 2 * self.weights * saddle
        second = (4 * w * self.shifts / denominator**3 + 2 * w**2 / denominator**2).sum()
        third = (24 * w**2 * self.shifts / denominator**4 + 8 * w**3 / denominator**3).sum()
        # Use the osculating parabola of the steepest descent of exp(K(t) - t x), without 1 / t: the pole at 0 would
        # bend it too much.
        bend, reach = self._path(x, saddle, third / (6 * second), (second + 1 / saddle**2) ** -0.5)
        y = np.linspace(0.0, reach, _NODES + 1)
        t = saddle + 1j * y + bend * y**2
        height = self._cumulant(saddle) - saddle * x
        integrand = np.exp(self._cumulant(t) - t * x - height) / t * (1j + 2 * bend * y)
        half = (integrand[0] / 2 + integrand[1:].sum()) * y[1]
        return float(height + np.log(abs(half.imag) / np.pi))

    def _path(self, x: float, saddle: float, bend: float, width: float) -> tuple[float, float]:
        """Return the bend of a path with monotonically decreasing integrand, and its end (negligible integrand).

        With variances of very different size the integrand can increase along the osculating parabola; a straighter
        parabola is then used.
        """
        y = width * np.geomspace(0.05, 1e5, 300)
        for straighter in 0.25 ** np.arange(12.0):
            t = saddle + 1j * y + straighter * bend * y**2
            decrease = (self._cumulant(saddle) - saddle * x) - (self._cumulant(t) - t * x).real
            end = int(np.argmax(decrease > _NEGLIGIBLE_EXPONENT))
            if end and (np.diff(decrease[: end + 1]) > 0).all():
                break
        return straighter * bend, float(y[end])


def covariance_root(covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """Return B with B B' = Q for a possibly singular covariance, scaled to be independent of units."""
    covariance = np.asarray(covariance, float)
    sigma = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    scale = np.where(sigma > 0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
