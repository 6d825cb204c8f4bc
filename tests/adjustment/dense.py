"""The adjustment once more with dense matrices: what the structured one is tested against."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxphoto.adjustment.adjust import concrete
from jaxphoto.adjustment.colouring import Jacobian
from jaxphoto.adjustment.datum import close_datum
from jaxphoto.adjustment.local import blocks_at
from jaxphoto.adjustment.normal import factor_reduced, multiply_normal, reduce_normal, solve_factored, sum_normal
from jaxphoto.adjustment.optimum import typical_scale, weigh_datum, zero_increments
from jaxphoto.adjustment.residuals import Increments, residuals_at
from jaxphoto.adjustment.structure import structure_of
from jaxphoto.adjustment.values import values_of, with_datum
from tests.blocks import adjusted


def prepared(block):
    """Structure and values at the start, with the constraints of the datum."""
    structure = structure_of(block, block.priors)
    values = values_of(block, block.start.unknowns, block.priors, structure)
    constraints = close_datum(block, concrete(values, block), structure)
    return with_datum(values, constraints.eop, constraints.points), structure


DAMPINGS = (0.0, 0.7)


class Dense(NamedTuple):
    """Dense Jacobian and residuals in scaled increments at an adjustment's result, and the structured code's sums."""

    jacobian: np.ndarray
    residuals: np.ndarray
    blocks: Jacobian
    vector: np.ndarray
    products: np.ndarray
    """The normal matrix times `vector`."""
    gradient: np.ndarray
    solutions: np.ndarray
    """x of (N + damping I) x = vector, a row for each of `DAMPINGS`."""
    scale: np.ndarray

    @property
    def free(self):
        return self.scale > 0

    def observed(self, n_datum: int):
        """The Jacobian without the rows of the datum."""
        return self.jacobian[: len(self.jacobian) - n_datum]


@functools.cache
def at_optimum(name: str) -> Dense:
    """Of one of the variants of `tests.blocks`."""
    a = adjusted(name)
    return jax.tree.map(np.asarray, _dense(a.values, a.structure))


@eqx.filter_jit
def _dense(values, structure) -> Dense:
    values = weigh_datum(values, structure)
    scale = typical_scale(values, structure)
    zero = zero_increments(structure)
    flat, back = ravel_pytree(zero)
    fn = jax.jit(lambda y: residuals_at(y, scale, values, structure))
    residuals, product = jax.linearize(fn, zero)
    blocks, _ = blocks_at(zero, scale, values, structure)
    datum = (values.datum_eop * scale.eop, values.datum_points * scale.points)
    normal = sum_normal(blocks, residuals, datum, structure)
    flat_scale = ravel_pytree(scale)[0]
    vector = jnp.sin(1.0 + jnp.arange(len(flat))) * (flat_scale > 0)

    def solution(damping):
        reduced = reduce_normal(normal, damping, structure)
        return ravel_pytree(solve_factored(normal, reduced, factor_reduced(reduced), back(vector), structure))[0]

    return Dense(
        jacobian=jax.vmap(lambda seed: ravel_pytree(product(back(seed)))[0], out_axes=1)(jnp.eye(len(flat))),
        residuals=ravel_pytree(residuals)[0],
        blocks=blocks,
        vector=vector,
        products=ravel_pytree(multiply_normal(normal, back(vector), structure))[0],
        gradient=ravel_pytree(normal.b)[0],
        solutions=jax.vmap(solution)(jnp.array(DAMPINGS)),
        scale=flat_scale,
    )


def assemble(j, s) -> np.ndarray:
    """The dense Jacobian that the blocks of the colouring stand for, without the rows of the datum."""
    e, q, n = 6 * s.n_images, s.n_shared, len(s.image)
    eop = lambda a, image: a * s.n_images + image  # noqa: E731
    point = lambda a, p: e + q + a * s.n_points + p  # noqa: E731
    parts = []

    def part(n_rows, *entries):
        dense = np.zeros((n_rows, e + q + 3 * s.n_points + 1))
        for rows, columns, values in entries:
            dense[rows, columns] += values
        parts.append(dense[:, :-1])

    def shared(colour, image):
        """The column of a colour in an image; the last, cut off, where it means nothing there."""
        column = s.column[image, colour]
        return np.where(column < q, e + column, e + q + 3 * s.n_points)

    each = np.arange(n)
    part(
        2 * n,
        *((c * n + each, eop(a, s.image), j.image_eop[a, c]) for a in range(6) for c in range(2)),
        *((c * n + each, shared(k, s.image), j.image_shared[k, c]) for k in range(s.n_image_colours) for c in range(2)),
        *((c * n + each, point(a, s.point), j.image_point[a, c]) for a in range(3) for c in range(2)),
    )
    each, image = np.arange(len(s.station_image)), s.station_image
    part(
        len(each),
        *((each, eop(a, image), j.station_eop[a]) for a in range(6)),
        *((each, shared(k, image), j.station_shared[k]) for k in range(s.n_colours)),
    )
    n, image = len(s.attitude_image), s.attitude_image
    each = np.arange(n)
    part(
        3 * n,
        *((c * n + each, eop(a, image), j.attitude_eop[a, c]) for a in range(6) for c in range(3)),
        *((c * n + each, shared(k, image), j.attitude_shared[k, c]) for k in range(s.n_colours) for c in range(3)),
    )
    each = np.arange(len(s.control_point))
    part(len(each), *((each, point(a, s.control_point), j.control[a]) for a in range(3)))
    each = np.arange(len(s.distance_points))
    part(
        len(each),
        *((each, point(a, s.distance_points[:, end]), j.distances[end, a]) for end in range(2) for a in range(3)),
    )
    each = np.arange(len(s.weighted))
    part(len(each), (each, e + s.weighted, j.priors))
    return np.concatenate(parts)


def split(vector: np.ndarray, s) -> Increments:
    """A flat vector of increments by kind."""
    e = 6 * s.n_images
    q = e + s.n_shared
    return Increments(vector[:e].reshape(6, -1), vector[e:q], vector[q:].reshape(3, -1))
