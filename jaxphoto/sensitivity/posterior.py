"""Posterior of parameters by the No-U-Turn sampler, compared with its Gaussian approximation.

Least squares reports the optimum and the inverse of the normal matrix: the Laplace approximation of the density

    p(x) ~ exp(-1/2 sum of (residual / a priori sigma)^2)

It equals the posterior if residuals are linear in the unknowns. It may differ if c, flying height and heights of points
are strongly correlated. This module samples the whole posterior, in coordinates z in which the Laplace approximation is
a standard normal distribution. With V = L L' of the points, A = M M' of the reduced unknowns and F as in
adjustment/solver/normal.py,

    x_r = M'^-1 z_r,   x_p = L'^-1 (z_p - F' x_r)

so one step length suits all unknowns, from k2 to positions, and the metric is not adapted. Distances and datum
constraints couple points and are not in L: with them the coordinates are only approximately standard normal.

Sources: Hoffman and Gelman 2014 (NUTS, algorithm 6); Vehtari et al. 2021 (R-hat, effective sample size).
"""

import difflib
import itertools
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Scalar

from jaxphoto.adjustment import Adjustment, Linearised, NormalEquations
from jaxphoto.adjustment.model.numbers import Increments, state_at
from jaxphoto.arrays import to_numpy
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError
from jaxphoto.linear_algebra import solve
from jaxphoto.observations import AXES
from jaxphoto.rotation import omega_phi_kappa_from_matrix
from jaxphoto.small_matrices import whiten
from jaxphoto.statistics import EOP_NAMES
from jaxphoto.tracing import outside_transformations

try:
    import blackjax
except ImportError as error:
    raise ImportError(
        "the posterior is sampled by blackjax: install it with pip install 'jaxphoto[posterior]'"
    ) from error

# Minimum number of draws per chain: R-hat compares the halves of every chain, and each half needs a variance.
MIN_DRAWS = 4
_ACCEPTANCE = 0.9
# Squared radius of the 95 % ellipse of a bivariate standard normal distribution.
_SQUARE_RADIUS = -2 * np.log(0.05)


class Posterior(eqx.Module):
    """Sample of the posterior of some parameters, and its Laplace approximation.

    Both are a priori (sigma naught 1). Values are in metres, radians, mm and the coefficients' own units; rotations are
    omega, phi, kappa.
    """

    parameters: tuple[str, ...] = eqx.field(static=True)
    samples: Float[np.ndarray, "chains draws parameters"]
    optimum: Float[np.ndarray, " parameters"]
    """Adjusted values, the mean of the Laplace approximation."""
    laplace: Float[np.ndarray, "parameters parameters"]
    """Covariance of the Laplace approximation."""
    rhat: Float[np.ndarray, " parameters"]
    """Rank-normalised split R-hat. Above 1.01 the chains have not converged, and the sample must not be used."""
    ess: Float[np.ndarray, " parameters"]
    """Effective sample size. The standard error of a mean is its sigma divided by the square root of this."""
    divergences: Int[np.ndarray, " chains"]
    """Number of divergent transitions. With many of them the sample misses parts of the posterior."""
    gradients: int
    """Number of gradient evaluations of the density after warm-up."""

    @property
    def draws(self) -> Float[np.ndarray, "draws parameters"]:
        """Samples of all chains, concatenated."""
        return self.samples.reshape(-1, len(self.parameters))

    @property
    def mean(self) -> Float[np.ndarray, " parameters"]:
        """Mean of the posterior."""
        return self.draws.mean(axis=0)

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of the posterior."""
        centred = self.draws - self.mean
        return centred.T @ centred / (len(centred) - 1)

    @property
    def skewness(self) -> Float[np.ndarray, " parameters"]:
        """Skewness E (x - mean)^3 / sigma^3 of the posterior; 0 for a symmetric one."""
        centred = self.draws - self.mean
        return (centred**3).mean(axis=0) / (centred**2).mean(axis=0) ** 1.5

    @property
    def outside(self) -> Float[np.ndarray, "parameters parameters"]:
        """Fraction of the sample outside the 95 % ellipse of the Laplace approximation, by pair of parameters.

        It is 0.05 for a Gaussian posterior. The diagonal is zero.
        """
        error = self.draws - self.optimum
        result = np.zeros(self.laplace.shape)
        for pair in itertools.combinations(range(len(self.parameters)), 2):
            d = error[:, pair]
            square = (d * np.linalg.solve(self.laplace[np.ix_(pair, pair)], d.T).T).sum(axis=1)
            result[pair] = result[pair[::-1]] = (square > _SQUARE_RADIUS).mean()
        return result


@outside_transformations
def posterior(
    adjusted: Adjustment,
    parameters: Sequence[str],
    *,
    draws: int = 1000,
    warmup: int = 500,
    chains: int = 2,
    seed: int = 0,
) -> Posterior:
    """Sample the posterior of `parameters` by NUTS, and compute its Laplace approximation.

    All unknowns are sampled, so the other ones are marginalised. The density is exp(-1/2 v'Pv) with the a priori
    sigmas. It is uniform in every unknown without a `Weighted` prior: positions, points, parameters of interior
    orientation, mounts and strips, and the small rotation of each image from its optimum. For a free network it is
    restricted to the plane of the datum constraints.

    `parameters` are labels as in `Covariance.labels`, such as `interior[kodak].c_mm` or `exterior[8936].omega`, or
    coordinates of points, such as `points[12].Z`. Each of `chains` starts at a random draw of the Laplace
    approximation, adapts its step length in `warmup` draws, and then stores `draws` samples. The same `seed` gives the
    same sample.

    Raises InputError for an unknown or fixed parameter, for fewer draws than R-hat needs, and for an adjustment that
    has not converged.
    """
    for name, number, least in (("draws", draws, MIN_DRAWS), ("warmup", warmup, 1), ("chains", chains, 1)):
        if number < least:
            raise InputError(f"{name} must be at least {least}, got {number}")
    if not bool(adjusted.converged):
        raise InputError(f"a posterior needs a converged adjustment, but the block is {adjusted.outcome.value}")
    equations = adjusted.equations.on_one_device
    index = _indices(adjusted, parameters)
    free = np.flatnonzero(_flat(jax.tree.map(np.asarray, equations.scale), np))
    optimum, laplace = map(to_numpy, call_compiled(_laplace, equations, index))
    samples, divergences, gradients = map(
        to_numpy, call_compiled(_sample, equations, index, free, np.array(seed), chains, draws, warmup)
    )
    rhat, ess = map(to_numpy, call_compiled(_diagnostics, samples))
    return Posterior(
        parameters=tuple(parameters),
        samples=samples,
        optimum=optimum,
        laplace=laplace,
        rhat=rhat.reshape(-1),
        ess=ess.reshape(-1),
        divergences=divergences,
        gradients=int(gradients.sum()),
    )


def _indices(adjusted: Adjustment, parameters: Sequence[str]) -> Int[np.ndarray, " parameters"]:
    """Return the indices of `parameters` in the vector of `_physical`."""
    block, s, padded = adjusted.block, adjusted.structure, adjusted.padded
    n, q, image, point = padded.structure.n_images, s.n_shared, padded.places.image, padded.places.point
    names = EOP_NAMES["omega_phi_kappa"]
    exterior = {
        f"exterior[{block.images[i]}].{names[k]}": 6 * image[i] + k
        for k, i in zip(*np.nonzero(s.eop_free), strict=True)
    }
    shared = {label: 6 * n + j for j, label in enumerate(s.labels)}
    points = {
        f"points[{block.points[p]}].{AXES[k]}": 6 * n + q + k * padded.structure.n_points + point[p]
        for k, p in zip(*np.nonzero(s.point_free), strict=True)
    }
    index = exterior | shared | points
    if missing := [name for name in parameters if name not in index]:
        raise InputError(_unknown_parameter(missing[0], list(index), adjusted))
    if not len(parameters) or len(set(parameters)) < len(parameters):
        raise InputError(f"name at least one parameter, each once; got {', '.join(parameters) or 'none'}")
    return np.array([index[name] for name in parameters])


def _unknown_parameter(name: str, unknowns: list[str], adjusted: Adjustment) -> str:
    """Return the error for a parameter that is not an unknown."""
    block = adjusted.block
    parameters = [
        *(f"exterior[{i}].{angle}" for i in block.images for angle in EOP_NAMES["omega_phi_kappa"]),
        *adjusted.parameters,
        *(f"points[{p}].{axis}" for p in block.points for axis in AXES),
    ]
    if name in parameters:
        return f"{name} is fixed, so it has no posterior: free it, or omit it"
    matches = difflib.get_close_matches(name, unknowns, n=3, cutoff=0.0)
    return f"unknown parameter {name}; similar names are {', '.join(matches)}"


class _White(NamedTuple):
    """Whitened coordinates z of the free unknowns; see the module's docstring."""

    equations: NormalEquations
    triangle: Float[Array, "reduced reduced"]
    """Factor M of A = M M'."""
    free: Int[Array, "free"]
    """Indices of the free unknowns in the padded vector."""
    datum: Float[Array, "constraints free"]
    """Orthonormal rows that span the datum constraints in z."""

    @classmethod
    def at_optimum(cls, equations: NormalEquations, free: Int[Array, "free"]) -> "_White":
        """Build the coordinates at an optimum."""
        white = cls(equations.weighed, equations.cholesky_factor(), free, jnp.zeros((0, len(free))))
        rows = jax.vmap(white.whitened)(equations.constraints())
        return white._replace(datum=jnp.linalg.qr(rows.T)[0].T)

    def increments(self, z: Float[Array, "free"]) -> Increments:
        """Return the increments x at z."""
        reduced = self.equations.factored.reduced
        r, (l11, l21, l22, l31, l32, l33) = len(self.triangle), reduced.l
        full = jnp.zeros(r + 3 * len(l11)).at[self.free].set(self.project(z))
        p1, p2, p3 = full[r:].reshape(3, -1)
        points = jnp.stack([l11 * p1, l21 * p1 + l22 * p2, l31 * p1 + l32 * p2 + l33 * p3])
        return self.equations.expand(self.triangle @ full[:r], jnp.zeros(len(reduced.k)), points)

    def project(self, z: Float[Array, "free"]) -> Float[Array, "free"]:
        """Project z onto the plane of the datum constraints."""
        return z - self.datum.T @ (self.datum @ z)

    def whitened(self, row: Increments) -> Float[Array, "free"]:
        """Convert a derivative `row` by x to the derivative by z."""
        right, d = self.equations.reduce(row)
        reduced = self.equations.factored.reduced
        if len(d):
            right = right - reduced.g @ solve(reduced.k, d)
        half = self.triangle.T @ self.equations.solve_reduced_matrix(right)
        points = jnp.stack(whiten(row.points, reduced.l))
        return self.project(jnp.concatenate([half, points.reshape(-1)])[self.free])

    def slope(self, z: Float[Array, "free"]) -> tuple[Scalar, Float[Array, "free"]]:
        """Return half the sum of squares and its derivative by z.

        The density is standard normal in the directions of the datum constraints.
        """
        constrained = self.datum @ z
        b, square = self.equations.gradient(self.increments(z))
        return 0.5 * (square + constrained @ constrained), self.whitened(b) + self.datum.T @ constrained

    def log_density(self, z: Float[Array, "free"]) -> Scalar:
        """Return minus half the sum of squares."""
        at = jax.lax.stop_gradient(z)
        half, slope = self.slope(at)
        # Linear in z around `at`: differentiation returns the analytic derivative.
        return -half - slope @ (z - at)


def _flat(x: Increments, xp) -> Array:
    """Concatenate the reduced unknowns and the points."""
    return xp.concatenate([x.eop.T.reshape(-1), x.shared, x.points.reshape(-1)])


def _physical(x: Increments, at: Linearised) -> Float[Array, "numbers"]:
    """Return all unknowns in their own units: X, Y, Z, omega, phi, kappa of the images, shared unknowns, points."""
    _, scale, values, s = at
    angles_of = jax.vmap(omega_phi_kappa_from_matrix, in_axes=2)
    state, optimum = state_at(x, scale, values, s), angles_of(values.rotation)
    change = angles_of(state.rotation) - optimum
    # Angles are continuous with the angles of the optimum.
    angles = optimum + change - 2 * jnp.pi * jnp.round(change / (2 * jnp.pi))
    eop = jnp.concatenate([state.position.T, angles], axis=1)
    return jnp.concatenate([eop.reshape(-1), state.shared[s.free], state.points.reshape(-1)])


@eqx.filter_jit
def _laplace(
    equations: NormalEquations, index: Int[Array, " parameters"]
) -> tuple[Float[Array, " parameters"], Float[Array, "parameters parameters"]]:
    """Return the parameters at the optimum, and their covariance."""
    at = equations.at
    parameters = lambda x: _physical(x, at)[index]  # noqa: E731
    rows = jax.jacrev(parameters)(at.increments)
    solved = jax.vmap(equations.solve)(rows)
    flat = jax.vmap(partial(_flat, xp=jnp))
    # Subtract the free motions, which the datum constraints determine (see adjustment/solver/inverse.py).
    along = flat(solved) @ flat(equations.constraints()).T
    return parameters(at.increments), flat(rows) @ flat(solved).T - along @ along.T


@eqx.filter_jit
def _sample(
    equations: NormalEquations, index: Int[Array, " parameters"], free: Int[Array, " free"], seed: Int[Array, ""],
    chains: int, draws: int, warmup: int,
) -> tuple[Float[Array, "chains draws parameters"], Int[Array, " chains"], Int[Array, " chains"]]:  # fmt: skip
    """Return samples of the parameters, and the number of divergent transitions and gradients of each chain."""
    white, at = _White.at_optimum(equations, free), equations.at
    metric, transition = jnp.ones(len(free)), blackjax.nuts.build_kernel()
    begin, update, final = blackjax.adaptation.step_size.dual_averaging_adaptation(_ACCEPTANCE)

    def adapt(carry, key):
        state, adaptation = carry
        state, info = transition(key, state, white.log_density, jnp.exp(adaptation.log_step_size), metric)
        return (state, update(adaptation, info.acceptance_rate)), None

    def chain(key):
        start_key, warmup_key, draws_key = jax.random.split(key, 3)
        state = blackjax.nuts.init(jax.random.normal(start_key, (len(free),)), white.log_density)
        adaptation = begin(len(free) ** -0.25)
        (state, adaptation), _ = jax.lax.scan(adapt, (state, adaptation), jax.random.split(warmup_key, warmup))
        step = final(adaptation)

        def draw(state, key):
            state, info = transition(key, state, white.log_density, step, metric)
            x = white.increments(state.position)
            return state, (_physical(x, at)[index], info.is_divergent, info.num_integration_steps)

        _, (samples, divergent, steps) = jax.lax.scan(draw, state, jax.random.split(draws_key, draws))
        return samples, jnp.sum(divergent), jnp.sum(steps)

    # Run sequentially: vmapped, every chain would wait for the longest trajectory.
    return jax.lax.map(chain, jax.random.split(jax.random.key(seed), chains))


@eqx.filter_jit
def _diagnostics(samples: Float[Array, "chains draws parameters"]) -> tuple[Array, Array]:
    """Compute R-hat and effective sample size of every parameter."""
    return blackjax.diagnostics.rhat(samples), blackjax.diagnostics.ess_bulk(samples)
