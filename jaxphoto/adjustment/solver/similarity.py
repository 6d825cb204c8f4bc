"""Similarity transformations: common motions of images and points that change no image coordinate."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment.layout.padded import PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.numbers import AbstractValues, Increments, datum_residuals
from jaxphoto.adjustment.model.structure import AbstractStructure, total
from jaxphoto.adjustment.solver.normal import Linearised, dot
from jaxphoto.arrays import ArrayLike, joined
from jaxphoto.linear_algebra import one_at_a_time, solve
from jaxphoto.rotation import CROSS, small_angles, small_rotation

# Number of Newton iterations; with such close start values each iteration doubles the number of correct digits.
_NEWTON_STEPS = 5
# Regularisation of the seven dependent motions of a single image, relative to the mean weight of the motions.
_RIDGE = 1e-9

_svd = one_at_a_time(lambda a: tuple(jnp.linalg.svd(a)))


class DatumRows(NamedTuple):
    """Derivatives of increments with respect to the seven motions (about the centroid, shifts in units of the block's
    size).
    """

    eop: Float[np.ndarray, "7 6 images"]
    points: Float[np.ndarray, "7 3 points"]


def similarity(
    parameters: Float[Array, "7"], position: Float[Array, "3"], rotation: Float[Array, "3 3"], centre, size
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Move an image by a similarity about `centre`: shifts in units of `size`, rotations (rad), logarithm of scale."""
    turn = small_rotation(parameters[3:6])
    moved = centre + size * parameters[:3] + jnp.exp(parameters[6]) * turn @ (position - centre)
    return moved, rotation @ turn.T


def motions(
    position: Float[ArrayLike, "3 images"],
    rotation: Float[ArrayLike, "3 3 images"],
    points: Float[ArrayLike, "3 points"],
    centre,
    size,
) -> DatumRows:
    """Differentiate images (position, small rotation) and points by the parameters of `similarity`, at identity.

    In NumPy unless the arguments are traced.

    For x at the distance r from the centre, a rotation theta moves it by -theta x r. In the camera frame, where
    increments are defined, the same rotation is R turn' R', a small rotation by -R theta.
    """

    def of_places(x) -> Any:
        away = x - centre[:, None]
        shifts = size * np.broadcast_to(np.eye(3)[:, :, None], (3, *x.shape))
        return joined([shifts, -(CROSS.transpose(2, 0, 1) @ away), away[None]])

    still = np.zeros((3, *position.shape))
    turned = joined([still, -rotation.swapaxes(0, 1), still[:1]])
    by_component: Any = joined([v.swapaxes(0, 1) for v in (of_places(position), turned)])
    return DatumRows(by_component.swapaxes(0, 1), of_places(points))


def n_open_motions(values: AbstractValues, s: AbstractStructure) -> int:
    """Return the number of undetermined motions: seven, six if distances determine the scale, 0 in all other cases.

    Such motions change only the residuals of the datum constraints, at any position of images and points. Other motions
    (a rotation about the only control point, a shift compensated by the shift of a strip) depend on the position, or on
    more than images and points.
    """
    k = len(values.datum_eop)
    invariant = all(g.rigid_invariant for g in s.observed)
    lengths = any(g.rigid_invariant and g.elimination != "reduced" for g in s.observed)
    return k if invariant and (k == 7 or (k == 6 and lengths)) else 0


def onto_datum(at: Linearised) -> Increments:
    """Apply to the increments the similarity that satisfies the datum constraints.

    Newton's method starts from the similarity that brings the points closest to their start values (Umeyama 1991); if
    it fails, the increments are returned unchanged.
    """
    y, scale, values, s = at
    k = n_open_motions(values, s)
    centre, size = _extent(values.points, s)
    moved = lambda y, parameters: _moved(Linearised(y, *at[1:]), parameters, centre, size)  # noqa: E731

    def newton(_, y: Increments) -> Increments:
        violation = lambda parameters: datum_residuals(moved(y, parameters), scale, values, s)  # noqa: E731
        zero = jnp.zeros(k)
        return moved(y, -solve(jax.jacfwd(violation)(zero), violation(zero)))

    begin = moved(y, _nearest(at.state.points, values.points, scale.points[0] > 0, centre, size, s)[:k])
    found = jax.lax.fori_loop(0, _NEWTON_STEPS, newton, begin)
    finite = jnp.all(jnp.isfinite(found.eop)) & (total(jnp.sum(~jnp.isfinite(found.points)), s) == 0)
    return jax.tree.map(lambda new, old: jnp.where(finite, new, old), found, y)


def along_motions(values: PaddedValues, scale: Increments, s: PaddedStructure) -> Increments:
    """Return scaled increments along each of the `n_open_motions` (leading axis), which only the datum constraints
    determine.
    """
    k, shared = n_open_motions(values, s), scale.shared
    eop, points = motions(values.position, values.rotation, values.points, *_extent(values.points, s))
    return Increments(_scaled(eop[:k], scale.eop), jnp.zeros((k, *shared.shape)), _scaled(points[:k], scale.points))


def after(at: Linearised, step: Increments, weight: Increments) -> Increments:
    """Return the increments after `step`: its common motion is applied as a similarity, the rest is added.

    A rotation of the whole block that is added to the increments would distort the block. If few observations determine
    its position, that distortion alone would determine whether the step is accepted. The similarity is separated in the
    metric of `weight`. Steps of a free network are added: its constraints are linear.
    """
    (y, scale, values, s), state = at, at.state
    if n_open_motions(values, s):
        return jax.tree.map(jnp.add, y, step)
    centre, size = _extent(state.points, s)
    eop, points = motions(state.position, state.rotation, state.points, centre, size)
    along = Increments(_scaled(eop, scale.eop), jnp.zeros((7, s.n_shared)), _scaled(points, scale.points))
    weighted = jax.tree.map(jnp.multiply, along, weight)
    product = jax.vmap(dot, in_axes=(None, 0, None))
    normal = jax.vmap(lambda a: product(a, weighted, s))(along)
    ridge = _RIDGE * jnp.trace(normal) + jnp.finfo(float).tiny
    parameters = solve(normal + ridge * np.eye(7), product(step, weighted, s))
    moved = lambda y, parameters: _moved(Linearised(y, *at[1:]), parameters, centre, size)  # noqa: E731
    linear = jax.jvp(lambda p: moved(y, p), (jnp.zeros(7),), (parameters,))[1]
    return moved(jax.tree.map(lambda y, x, a: y + (x - a), y, step, linear), parameters)


def _moved(at: Linearised, parameters: Float[Array, "k"], centre, size) -> Increments:
    """Return the increments moved by a similarity."""
    (y, scale, values, _), state = at, at.state
    parameters = jnp.concatenate([parameters, jnp.zeros(7 - len(parameters))])
    image = lambda x, r: similarity(parameters, x, r, centre, size)  # noqa: E731
    position, rotation = jax.vmap(image, in_axes=(1, 2), out_axes=(1, 2))(state.position, state.rotation)
    points = jax.vmap(lambda x: image(x, jnp.eye(3))[0], 1, 1)(state.points)
    turned = jax.vmap(lambda r, start: small_angles(r @ start.T), 2, 1)(rotation, values.rotation)
    eop = _scaled(jnp.concatenate([position - values.position, turned]), scale.eop)
    return Increments(eop, y.shared, _scaled(points - values.points, scale.points))


def _extent(points: Float[Array, "3 points"], s: PaddedStructure) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Return centre and size (m) of the points."""
    mean = lambda v: total(jnp.sum(v, axis=-1), s) / s.n_points  # noqa: E731
    centre = mean(points)
    return centre, jnp.sqrt(mean(jnp.sum((points - centre[:, None]) ** 2, axis=0)))


def _scaled(v, scale):
    """Return increments of free unknowns, zero for fixed ones."""
    return jnp.where(scale > 0, v / jnp.where(scale > 0, scale, 1.0), 0.0)


def _nearest(points, start, own, centre, size, s: PaddedStructure) -> Float[Array, "7"]:
    """Return the similarity that brings `points` closest to `start`; points outside `own` are ignored."""
    weight = own / total(jnp.sum(own), s)
    mean, target = total((points @ weight, start @ weight), s)
    a, b = points - mean[:, None], start - target[:, None]
    u, d, vt = _svd(total((b * weight) @ a.T, s))
    sign = jnp.array([1.0, 1.0, 0.0]) + jnp.array([0.0, 0.0, 1.0]) * jnp.linalg.det(u @ vt)
    turn = (u * sign) @ vt
    scale = jnp.sum(d * sign) / total(jnp.sum(weight * a * a), s)
    shift = (target - centre - scale * turn @ (mean - centre)) / size
    return jnp.concatenate([shift, small_angles(turn), jnp.log(scale)[None]])
