"""The posterior itself beside its Gaussian: is what sigma and correlation say right?

Least squares reports the optimum and the inverse of the normal matrix: the Laplace approximation of the density

    p(x) ~ exp(-1/2 sum of squared residuals over their a priori sigmas)

It is the posterior itself where residuals are linear in the unknowns; where c, flying height and heights of points go
along a curved valley, it is not. Here the whole posterior is sampled by the No-U-Turn sampler, in coordinates z in
which the Laplace approximation is a standard normal distribution. With V = L L' of the points, A = M M' of the
reduced unknowns and F as in adjustment/solver/normal.py,

    x_r = M'^-1 z_r,   x_p = L'^-1 (z_p - F' x_r)

so steps of one length suit all unknowns, from k2 to positions, and no metric need be learnt. (Distances and
constraints of the datum, which couple points, are left out of L: there the coordinates are nearly so.)

Source: Hoffman and Gelman 2014 (NUTS, algorithm 6); Vehtari et al. 2021 (R-hat, effective sample size).
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
from jaxphoto.arrays import still
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

# R-hat compares the halves of every chain, and each needs a variance.
LEAST_DRAWS = 4
_ACCEPTANCE = 0.9
# Of the ellipse that holds 95 % of a normal distribution of two.
_SQUARE_RADIUS = -2 * np.log(0.05)


class Posterior(eqx.Module):
    """A sample of the posterior of some parameters, and the Laplace approximation of the same.

    Both are a priori: sigma naught is 1. Values are in metres, radians, mm and the coefficients' own units; rotations
    are omega, phi, kappa.
    """

    parameters: tuple[str, ...] = eqx.field(static=True)
    samples: Float[np.ndarray, "chains draws parameters"]
    optimum: Float[np.ndarray, " parameters"]
    """Where the adjustment ended: the mean of the Laplace approximation."""
    laplace: Float[np.ndarray, "parameters parameters"]
    """Covariance of the Laplace approximation."""
    rhat: Float[np.ndarray, " parameters"]
    """Rank-normalised split R-hat: above 1.01 the chains do not agree yet, and the sample is no answer."""
    ess: Float[np.ndarray, " parameters"]
    """Effective sample size: the standard error of a mean is its sigma over the root of this."""
    divergences: Int[np.ndarray, " chains"]
    """Draws whose trajectory could not be followed: where there are many, parts of the posterior are missing."""
    gradients: int
    """Gradients of the density that all draws after warm-up took."""

    @property
    def draws(self) -> Float[np.ndarray, "draws parameters"]:
        """All chains as one sample."""
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
        """E (x - mean)^3 / sigma^3 of the posterior: 0 where it is symmetric."""
        centred = self.draws - self.mean
        return (centred**3).mean(axis=0) / (centred**2).mean(axis=0) ** 1.5

    @property
    def outside(self) -> Float[np.ndarray, "parameters parameters"]:
        """Share of the sample outside the 95 % ellipse of the Laplace approximation, by pair of parameters.

        0.05 where the Gaussian is right. The diagonal, of single parameters, is zero.
        """
        away = self.draws - self.optimum
        result = np.zeros(self.laplace.shape)
        for pair in itertools.combinations(range(len(self.parameters)), 2):
            two = away[:, pair]
            square = (two * np.linalg.solve(self.laplace[np.ix_(pair, pair)], two.T).T).sum(axis=1)
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
    """Sample the posterior of `parameters` by NUTS, beside the Laplace approximation of the same.

    All unknowns are sampled: what is not asked for is integrated over. The density is exp(-1/2 v'Pv) with the a priori
    sigmas, and flat in every unknown that has no `Weighted` prior: in positions, points, parameters of interior
    orientation, mounts and strips, and in the small rotation of each image away from its optimum. In a free network
    it is the density on the plane that the constraints of the datum hold.

    `parameters` are labels as in `Covariance.labels`, `interior[kodak].c_mm` or `exterior[8936].omega`, or coordinates
    of points, `points[12].Z`. Each of `chains` begins at its own draw of the Laplace approximation, finds the length
    of its steps in `warmup` draws, and then keeps `draws`. The same `seed` gives the same sample.

    Raises InputError for a parameter that the block does not have or that is held fixed, for fewer draws than R-hat
    needs, and for an adjustment that did not converge.
    """
    for name, number, least in (("draws", draws, LEAST_DRAWS), ("warmup", warmup, 1), ("chains", chains, 1)):
        if number < least:
            raise InputError(f"{name} is {least} at least, got {number}: ask for more")
    if not bool(adjusted.converged):
        raise InputError(f"there is no optimum to sample about; {adjusted.outcome.value}")
    equations = adjusted.equations.on_one_device
    chosen = _places(adjusted, parameters)
    free = np.flatnonzero(_flat(jax.tree.map(np.asarray, equations.scale), np))
    given = equations, chosen
    optimum, laplace = map(still, call_compiled(_laplace, *given))
    samples, divergences, gradients = map(
        still, call_compiled(_sample, *given, free, np.array(seed), chains, draws, warmup)
    )
    rhat, ess = map(still, call_compiled(_diagnostics, samples))
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


def _places(adjusted: Adjustment, parameters: Sequence[str]) -> Int[np.ndarray, " parameters"]:
    """Where `parameters` lie among all numbers of the padded state (`_numbers`)."""
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
    places = exterior | shared | points
    wrong = next((name for name in parameters if name not in places), None)
    if wrong is not None:
        raise InputError(_sentence(wrong, list(places), adjusted))
    if not len(parameters) or len(set(parameters)) < len(parameters):
        raise InputError(f"name each parameter once and one at least, got {', '.join(parameters) or 'none'}")
    return np.array([places[name] for name in parameters])


def _sentence(wrong: str, known: list[str], adjusted: Adjustment) -> str:
    """What is the matter with a parameter that is not among the unknowns."""
    block = adjusted.block
    every = [
        *(f"exterior[{i}].{name}" for i in block.images for name in EOP_NAMES["omega_phi_kappa"]),
        *adjusted.parameters,
        *(f"points[{p}].{axis}" for p in block.points for axis in AXES),
    ]
    if wrong in every:
        return f"{wrong} is held fixed, so it has no posterior: free it, or leave it out"
    near = difflib.get_close_matches(wrong, known, n=3, cutoff=0.0)
    return f"the block has no parameter {wrong}; near are {', '.join(near)}"


class _White(NamedTuple):
    """Coordinates z of the unknowns that are free; see the module's head."""

    equations: NormalEquations
    triangle: Float[Array, "reduced reduced"]
    """M of A = M M'."""
    free: Int[Array, "free"]
    """Which of the padded unknowns are free."""
    held: Float[Array, "constraints free"]
    """Orthonormal rows that span the constraints of the datum in z."""

    @classmethod
    def at_optimum(cls, equations: NormalEquations, free: Int[Array, "free"]) -> "_White":
        """The coordinates."""
        white = cls(equations.weighed, equations.cholesky_factor(), free, jnp.zeros((0, len(free))))
        rows = jax.vmap(white.whitened)(equations.constraints())
        return white._replace(held=jnp.linalg.qr(rows.T)[0].T)

    def increments(self, z: Float[Array, "free"]) -> Increments:
        """x of z."""
        reduced = self.equations.factored.reduced
        r, (l11, l21, l22, l31, l32, l33) = len(self.triangle), reduced.l
        full = jnp.zeros(r + 3 * len(l11)).at[self.free].set(self.without_open(z))
        p1, p2, p3 = full[r:].reshape(3, -1)
        points = jnp.stack([l11 * p1, l21 * p1 + l22 * p2, l31 * p1 + l32 * p2 + l33 * p3])
        return self.equations.expand(self.triangle @ full[:r], jnp.zeros(len(reduced.k)), points)

    def without_open(self, z: Float[Array, "free"]) -> Float[Array, "free"]:
        """z on the plane that the constraints of the datum hold."""
        return z - self.held.T @ (self.held @ z)

    def whitened(self, row: Increments) -> Float[Array, "free"]:
        """The derivative by z of what has the derivative `row` by x."""
        right, d = self.equations.reduce(row)
        reduced = self.equations.factored.reduced
        if len(d):
            right = right - reduced.g @ solve(reduced.k, d)
        half = self.triangle.T @ self.equations.solve_reduced_matrix(right)
        points = jnp.stack(whiten(row.points, reduced.l))
        return self.without_open(jnp.concatenate([half, points.reshape(-1)])[self.free])

    def slope(self, z: Float[Array, "free"]) -> tuple[Scalar, Float[Array, "free"]]:
        """Half the sum of squares and its derivative; of what the constraints hold, that of a standard normal."""
        held = self.held @ z
        b, square = self.equations.gradient(self.increments(z))
        return 0.5 * (square + held @ held), self.whitened(b) + self.held.T @ held

    def log_density(self, z: Float[Array, "free"]) -> Scalar:
        """Minus half the sum of squares."""
        at = jax.lax.stop_gradient(z)
        half, slope = self.slope(at)
        # Its derivative comes with it: what differentiates this sees a plane.
        return -half - slope @ (z - at)


def _flat(x: Increments, xp) -> Array:
    """Reduced unknowns, then points."""
    return xp.concatenate([x.eop.T.reshape(-1), x.shared, x.points.reshape(-1)])


def _numbers(x: Increments, there: Linearised) -> Float[Array, "numbers"]:
    """All unknowns in their own units: X, Y, Z, omega, phi, kappa of the images, the shared ones, the points."""
    _, scale, values, s = there
    angles = jax.vmap(omega_phi_kappa_from_matrix, in_axes=2)
    state, about = state_at(x, scale, values, s), angles(values.rotation)
    turned = angles(state.rotation) - about
    # Beside those of the optimum, whichever way round that is.
    turned = about + turned - 2 * jnp.pi * jnp.round(turned / (2 * jnp.pi))
    eop = jnp.concatenate([state.position.T, turned], axis=1)
    return jnp.concatenate([eop.reshape(-1), state.shared[s.free], state.points.reshape(-1)])


@eqx.filter_jit
def _laplace(
    equations: NormalEquations, chosen: Int[Array, " parameters"]
) -> tuple[Float[Array, " parameters"], Float[Array, "parameters parameters"]]:
    """The chosen parameters at the optimum, and their covariance."""
    there = equations.at
    parameters = lambda x: _numbers(x, there)[chosen]  # noqa: E731
    rows = jax.jacrev(parameters)(there.increments)
    solved = jax.vmap(equations.solve)(rows)
    flat = jax.vmap(partial(_flat, xp=jnp))
    # Of the open motions the constraints leave nothing (see adjustment/solver/inverse.py).
    along = flat(solved) @ flat(equations.constraints()).T
    return parameters(there.increments), flat(rows) @ flat(solved).T - along @ along.T


@eqx.filter_jit
def _sample(
    equations: NormalEquations, chosen: Int[Array, " parameters"], free: Int[Array, " free"], seed: Int[Array, ""],
    chains: int, draws: int, warmup: int,
) -> tuple[Float[Array, "chains draws parameters"], Int[Array, " chains"], Int[Array, " chains"]]:  # fmt: skip
    """Samples of the chosen parameters; divergent draws and gradients of each chain."""
    white, there = _White.at_optimum(equations, free), equations.at
    metric, transition = jnp.ones(len(free)), blackjax.nuts.build_kernel()
    begin, update, final = blackjax.adaptation.step_size.dual_averaging_adaptation(_ACCEPTANCE)

    def adapt(carried, key):
        state, adaptation = carried
        state, info = transition(key, state, white.log_density, jnp.exp(adaptation.log_step_size), metric)
        return (state, update(adaptation, info.acceptance_rate)), None

    def chain(key):
        of_start, of_warmup, of_draws = jax.random.split(key, 3)
        state = blackjax.nuts.init(jax.random.normal(of_start, (len(free),)), white.log_density)
        adaptation = begin(len(free) ** -0.25)
        (state, adaptation), _ = jax.lax.scan(adapt, (state, adaptation), jax.random.split(of_warmup, warmup))
        step = final(adaptation)

        def draw(state, key):
            state, info = transition(key, state, white.log_density, step, metric)
            x = white.increments(state.position)
            return state, (_numbers(x, there)[chosen], info.is_divergent, info.num_integration_steps)

        _, (samples, divergent, steps) = jax.lax.scan(draw, state, jax.random.split(of_draws, draws))
        return samples, jnp.sum(divergent), jnp.sum(steps)

    # One after the other: side by side, every chain would wait for the longest trajectory.
    return jax.lax.map(chain, jax.random.split(jax.random.key(seed), chains))


@eqx.filter_jit
def _diagnostics(samples: Float[Array, "chains draws parameters"]) -> tuple[Array, Array]:
    """R-hat and effective sample size of every parameter."""
    return blackjax.diagnostics.rhat(samples), blackjax.diagnostics.ess_bulk(samples)
