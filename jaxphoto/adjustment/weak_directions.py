"""Weak directions: combinations of unknowns that the observations hardly determine, from the normal equations.

The scale of an unknown is the change that moves an image point by about its standard deviation or, if larger,
the standard deviation of the observed positions or attitudes. With C the covariance of all scaled unknowns,

    C u = mu u,    |u| = 1

a direction u of large mu is weak: within one standard deviation unknown k moves by u_k sqrt(mu). A scaled standard
deviation is the dilution of precision of GNSS: the factor by which geometry amplifies observation errors. The
directions are computed by subspace iteration with the factored normal matrix. If that may be singular, slight damping
gives an undetermined direction a very large, finite standard deviation.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment.layout.padding import PaddedBlock
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.normal_equations import NormalEquations
from jaxphoto.adjustment.result import Adjustment
from jaxphoto.adjustment.right_hand_sides import at_once, solve_many
from jaxphoto.adjustment.solver.band import factor_band
from jaxphoto.adjustment.solver.elimination import FactoredNormal
from jaxphoto.adjustment.solver.reduced import reduce_normal
from jaxphoto.arrays import ArrayLike, to_numpy
from jaxphoto.block import Block
from jaxphoto.compiling import call_compiled

POOR = 20.0
"""Scaled standard deviation above which an unknown is weakly determined. In GNSS a dilution of precision above 20 is
poor (Langley, Dilution of precision, GPS World 10(5), 1999).
"""
OPEN = 1e4
"""Scaled standard deviation above which a direction is undetermined: only damping or noise remains."""
# Damping relative to the diagonal of N: larger than rounding errors, smaller than the contribution of any observation.
_DAMPING = 1e-12
# Smallest pivot of the reduced unknowns above which damping is omitted: it would change them by a millionth. Points
# with nearly parallel rays are then treated as in the adjustment.
_FELT = 1e-6
_DIRECTIONS, _ITERATIONS = 12, 6
# Fraction of a direction's largest motion above which an unknown participates.
_MOVES = 0.1


class Yardsticks(NamedTuple):
    """Scales of positions and points (m), rotations (rad), and each shared unknown (its own unit)."""

    ground: Float[ArrayLike, ""] | float
    angle: Float[ArrayLike, ""] | float
    shared: Float[ArrayLike, "shared"]


class MovedUnknowns(NamedTuple):
    """Motions of all unknowns, in block order, divided by their scales."""

    exterior: Float[np.ndarray, "images 6"]
    """X, Y, Z and a small rotation in the camera frame."""
    shared: Float[np.ndarray, "shared"]
    points: Float[np.ndarray, "points 3"]

    @property
    def largest(self) -> float:
        """Largest absolute value."""
        return max(float(np.abs(v).max(initial=0.0)) for v in self)


class WeakDirection(NamedTuple):
    """One standard deviation along a direction, in scaled unknowns."""

    moved: MovedUnknowns
    share: Float[np.ndarray, "shared"]
    """Fraction of each shared unknown's variance due to this direction: the square of their correlation. Fixing the
    unknown reduces the direction's variance by that fraction.
    """

    @property
    def sigma(self) -> float:
        """Scaled standard deviation of the unknown that moves most."""
        return self.moved.largest

    def _moves(self, motion: Float[np.ndarray, "n k"]) -> np.ndarray:
        return np.flatnonzero(np.abs(motion).max(axis=1, initial=0.0) > _MOVES * self.sigma)

    @property
    def images(self) -> np.ndarray:
        """Images that participate."""
        return self._moves(self.moved.exterior)

    @property
    def points(self) -> np.ndarray:
        """Points that participate."""
        return self._moves(self.moved.points)

    @property
    def shared(self) -> np.ndarray:
        """Shared unknowns that participate, and shared unknowns whose variance is mostly due to this direction."""
        moves = np.abs(self.moved.shared) > _MOVES * self.sigma
        return np.flatnonzero((self.share > 0.5) | (moves & (self.share > _MOVES)))


def yardsticks(adjusted: Adjustment) -> Yardsticks:
    """Return the scales of the unknowns of `adjusted`."""
    scale = image_yardsticks(adjusted.equations.scale)
    return observed_yardsticks(jax.tree.map(to_numpy, scale), adjusted.block, adjusted.structure.labels)


def image_yardsticks(scale: Increments) -> Yardsticks:
    """Return the changes that move an image point by about its standard deviation; may be traced."""
    # If the optimum does not fit, a camera may be inverted, with negative c and scales.
    eop, shared, points = (jnp.abs(v) for v in scale)
    ground = jnp.maximum(jnp.max(eop[:3], initial=0.0), jnp.max(points, initial=0.0))
    return Yardsticks(ground, jnp.max(eop[3:], initial=0.0), shared)


def observed_yardsticks(scale: Yardsticks, block: Block, labels: Sequence[str]) -> Yardsticks:
    """Enlarge `image_yardsticks` to the standard deviations of observed positions and attitudes if these are larger."""
    ground, angle = float(scale.ground), float(scale.angle)
    observed = [float(np.median(to_numpy(rows.sigma))) for rows in (block.stations, block.control) if len(rows)]
    farther = max([1.0, *(sigma / ground for sigma in observed)])
    turned = max(1.0, float(np.median(to_numpy(block.attitudes.sigma))) / angle) if len(block.attitudes) else 1.0
    by_unit = {"m": farther, "s": farther, "m_per_s": farther, "rad": turned, "rad_per_s": turned}
    factors = [by_unit.get(_unit(label), 1.0) for label in labels]
    return Yardsticks(farther * ground, turned * angle, scale.shared * np.array(factors))


def _unit(label: str) -> str:
    """Return the unit of a declared parameter from the end of its name; "" for an interior orientation."""
    if label.startswith("interior["):
        return ""
    ends = ("m_per_s", "rad_per_s", "m", "rad", "s")
    return next((unit for unit in ends if label.endswith(f"_{unit}")), "")


def weak_directions(adjusted: Adjustment, least: float = POOR) -> list[WeakDirection]:
    """Return directions with scaled standard deviations above `least`, the weakest first, at most twelve.

    Evaluated at the unknowns of `adjusted`: the optimum, or the last iterate. None if any unknown is infinite. The
    standard deviations are a priori.
    """
    equations, padded = _sound(adjusted), adjusted.padded
    yard = yardsticks(adjusted)
    scale = jax.tree.map(to_numpy, equations.scale)
    sizes = np.repeat([yard.ground, yard.angle], 3)[:, None]
    units = _increments(np.where(scale.eop > 0, sizes, 0.0), yard.shared, np.where(scale.points > 0, yard.ground, 0.0))
    # Scales in units of the scaled increments, and their reciprocals; zero for fixed unknowns.
    over = jax.tree.map(lambda s, u: np.where(u > 0, s / np.where(u > 0, u, 1.0), 0.0), scale, units)
    flat = _flat(over)
    rng, free = np.random.default_rng(0), np.flatnonzero(flat > 0)
    k, q = min(_DIRECTIONS, len(free)), len(yard.shared)
    basis = np.zeros((len(flat), k))
    basis[free] = np.linalg.qr(rng.standard_normal((len(free), k)))[0]

    def covariance_times(columns: np.ndarray) -> np.ndarray:
        product = solve_many(equations, _tree(columns * flat[:, None], over), adjusted.seconds)
        return _columns(product) * flat[:, None]

    for _ in range(_ITERATIONS):
        moved = covariance_times(basis)
        if not np.isfinite(moved).all():
            return []
        basis = np.linalg.qr(moved)[0]
    inner = basis.T @ covariance_times(basis)
    mu, vectors = np.linalg.eigh((inner + inner.T) / 2)
    along = (basis @ vectors * np.sqrt(np.maximum(mu, 0.0))).T[::-1]
    own = scale.eop.size + np.arange(q)
    variance, step = np.zeros(q), at_once(equations.scale)
    for some in np.split(np.arange(q), range(step, q, step)) if q else []:
        columns = np.zeros((len(flat), len(some)))
        columns[own[some], np.arange(len(some))] = 1.0
        variance[some] = covariance_times(columns)[own[some], np.arange(len(some))]
    found = [_direction(_tree(v[:, None], over), variance, padded) for v in along]
    return [d for d in found if d.sigma > least]


def _direction(of: Increments, variance: np.ndarray, padded: PaddedBlock) -> WeakDirection:
    eop, shared, points = (np.asarray(v)[0] for v in of)
    places = padded.places
    share = np.clip(shared**2 / np.where(variance > 0, variance, np.inf), 0.0, 1.0)
    return WeakDirection(MovedUnknowns(eop[:, places.image].T, shared, points[:, places.point].T), share)


def _increments(eop: Any, shared: Any, points: Any) -> Increments:
    """Convert NumPy arrays to increments."""
    return Increments(eop, shared, points)


def _flat(tree: Increments) -> np.ndarray:
    return np.concatenate([np.ravel(v) for v in tree])


def _columns(tree: Increments) -> np.ndarray:
    """Convert increments along a leading axis to columns."""
    return np.concatenate([to_numpy(v).reshape(len(v), math.prod(np.shape(v)[1:])) for v in tree], axis=1).T


def _tree(columns: np.ndarray, like: Increments) -> Increments:
    """Invert `_columns`."""
    ends = np.cumsum([v.size for v in like])[:-1]
    parts = zip(np.split(columns.T, ends, axis=1), like, strict=True)
    return _increments(*(part.reshape(len(part), *v.shape) for part, v in parts))


def _sound(adjusted: Adjustment) -> NormalEquations:
    """Return the normal equations of `adjusted`, damped against rounding if they may be singular."""
    equations = adjusted.equations.on_one_device.weighed
    determined = adjusted.converged and equations.least_pivot() > _FELT
    return equations if determined else call_compiled(_damped, equations)


@eqx.filter_jit
def _damped(equations: NormalEquations) -> NormalEquations:
    a, reduced, _ = reduce_normal(equations.at, _DAMPING)
    return dataclasses.replace(equations, factored=FactoredNormal(reduced, factor_band(a), equations.scale))
