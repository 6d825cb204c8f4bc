"""Dense matrices of an adjustment, to test the structured solver against."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxphoto.adjustment import Linearised
from jaxphoto.adjustment.datum import close_datum
from jaxphoto.adjustment.layout.padded import PaddedResiduals
from jaxphoto.adjustment.layout.padding import pad_structure
from jaxphoto.adjustment.model.block_values import values_of, with_datum
from jaxphoto.adjustment.model.numbers import Increments, zero_increments
from jaxphoto.adjustment.model.structure import structure_of
from jaxphoto.adjustment.solver.band import factor_band
from jaxphoto.adjustment.solver.elimination import jt_product, reduce_right, solve_factored
from jaxphoto.adjustment.solver.non_image_rows import NonImageRows, non_image_rows
from jaxphoto.adjustment.solver.optimum import typical_scale, weigh_datum
from jaxphoto.adjustment.solver.ray_rows import RayJacobian
from jaxphoto.adjustment.solver.reduced import ray_columns, reduce_normal
from tests.blocks import adjusted


def with_constraints(block):
    """Values and structure at the start, in the block's own order, with the constraints of the datum."""
    structure = structure_of(block, block.priors)
    values = values_of(block, block.start.unknowns, block.priors, structure)
    constraints = close_datum(block, values, structure)
    return with_datum(values, constraints.eop, constraints.points), structure


def prepared(block, **layout):
    """Values and structure in padded sizes, and the padding."""
    values, structure = with_constraints(block)
    coupled = len(values.datum_eop) > 0 or bool(structure.coupled)
    padded = pad_structure(structure, dense=coupled, **layout)
    return padded.pad(values), padded.structure, padded


DAMPINGS = (0.0, 0.7)


class Dense(NamedTuple):
    """Dense Jacobian and residuals in scaled increments at an adjustment's result, and the structured code's sums.

    Rows and unknowns are in the block's own order.
    """

    jacobian: np.ndarray
    residuals: np.ndarray
    columns: RayJacobian
    """Of image rows: eop (6, 2, rows), and so on."""
    others: NonImageRows
    vector: np.ndarray
    gradient: np.ndarray
    sums: np.ndarray
    """The same, and the square sum, as the sums of the normal equations have them."""
    square_sums: np.ndarray
    taken_down: np.ndarray
    """The right-hand side for the reduced unknowns and for mu, of a gradient and of the sums."""
    couples: np.ndarray
    """Whether a row couples points."""
    solutions: np.ndarray
    """x of (N + damping W) x = vector, a row for each of `DAMPINGS`; W is `weight`."""
    scale: np.ndarray

    @property
    def free(self):
        return self.scale > 0

    @property
    def weight(self):
        """The diagonal of N without distances and datum, which couple points."""
        return (self.jacobian[~self.couples] ** 2).sum(axis=0)

    def observed(self, n_datum: int):
        """The Jacobian without the rows of the datum."""
        return self.jacobian[: len(self.jacobian) - n_datum]


@functools.cache
def at_optimum(name: str) -> Dense:
    """`Dense` of one of the variants of `tests.blocks`."""
    return dense_of(adjusted(name))


def dense_of(a) -> Dense:
    """`Dense` of any adjustment."""
    equations = a.equations
    whole = jax.tree.map(np.asarray, _dense(equations.values, equations.structure))
    unknowns, rows = own_order(equations.values, a.padded)
    image = rows[: 2 * len(a.structure.image)].reshape(2, -1)

    def by_row(v):
        parts = [part.reshape(-1)[image] for part in np.moveaxis(np.asarray(v), 1, 0)]
        return np.stack(parts) if parts else np.zeros((0, *image.shape))

    c = whole.columns
    columns = RayJacobian(c.residual.reshape(-1)[image], *map(by_row, (c.eop, c.shared, c.point)))
    names = ("vector", "gradient", "sums", "solutions", "scale")
    return whole._replace(
        jacobian=whole.jacobian[np.ix_(rows, unknowns)],
        residuals=whole.residuals[rows],
        columns=columns,
        couples=couples(a),
        **{name: getattr(whole, name)[..., unknowns] for name in names},
    )


def couples(a) -> np.ndarray:
    """True for each residual that couples points: distances and datum constraints."""
    named, coupled = a.residuals.named, {g.name for g in a.structure.coupled} | {"datum"}
    sizes = {name: np.size(v) for name, v in named.items()} | {"datum": len(a.residuals.datum)}
    return np.concatenate([np.full(n, name in coupled) for name, n in sizes.items()])


def in_order(residuals) -> np.ndarray:
    """All residuals as one list: image points, the other groups, the datum."""
    return np.concatenate([np.ravel(v) for v in (*residuals.named.values(), residuals.datum)])


def in_one_list(residuals):
    """Residuals in padded sizes as one list: image points, the other groups, the datum."""
    return jnp.concatenate([jnp.ravel(v) for v in (residuals.image, *residuals.others, residuals.datum)])


_ORDERS: dict[int, tuple] = {}


def own_order(values, block):
    """Indices of the block's own unknowns and residuals, in their order, among the padded ones."""
    if id(block) not in _ORDERS:
        _ORDERS[id(block)] = block, *_own_order(values, block)
    return _ORDERS[id(block)][1:]


def _own_order(values, block):
    padded, places = block.structure, block.places
    zero = zero_increments(padded)
    flat, back = ravel_pytree(zero)
    index = back(jnp.arange(len(flat), dtype=float))
    own = (index.eop[:, places.image], index.shared, index.points[:, places.point])
    unknowns = np.concatenate([np.ravel(v) for v in own]).astype(int)
    like = jax.eval_shape(lambda v: Linearised(zero, zero, v, padded).residuals(), values)
    leaves = (like.image, *like.others, like.datum)
    flat, back = ravel_pytree([np.zeros(v.shape) for v in leaves])
    image, *others, datum = back(jnp.arange(len(flat), dtype=float))
    rows = block.crop_residuals(PaddedResiduals(tuple(others), datum, like.names, image))
    return unknowns, in_order(rows).astype(int)


class Rows(NamedTuple):
    """The part of `Dense` that compiles in half the time."""

    jacobian: np.ndarray
    residuals: np.ndarray
    sums: np.ndarray
    free: np.ndarray


def rows_of(a) -> Rows:
    """`Rows` of any adjustment."""
    equations = a.equations
    jacobian, residuals, sums, scale = map(np.asarray, _rows(equations.values, equations.structure))
    unknowns, rows = own_order(equations.values, a.padded)
    return Rows(jacobian[np.ix_(rows, unknowns)], residuals[rows], sums[unknowns], scale[unknowns] > 0)


@eqx.filter_jit
def _rows(values, structure):
    values = weigh_datum(values, structure)
    at = Linearised(zero_increments(structure), typical_scale(values, structure), values, structure)
    b = reduce_normal(at, 0.0)[2].b
    return (*_linearised(at), ravel_pytree(b)[0], ravel_pytree(at.scale)[0])


def _linearised(at):
    """The Jacobian and the residuals, in padded order."""
    flat, back = ravel_pytree(at.increments)
    residuals, product = jax.linearize(jax.jit(lambda y: at._replace(increments=y).residuals()), at.increments)
    by_unknown = jax.vmap(lambda seed: in_one_list(product(back(seed))), out_axes=1)(jnp.eye(len(flat)))
    return by_unknown, in_one_list(residuals)


@eqx.filter_jit
def _dense(values, structure) -> Dense:
    values = weigh_datum(values, structure)
    scale = typical_scale(values, structure)
    zero = zero_increments(structure)
    at = Linearised(zero, scale, values, structure)
    flat, back = ravel_pytree(zero)
    jacobian, residuals = _linearised(at)
    rest = non_image_rows(at)
    numbers = structure.rays.chunk_image, structure.ray_points, values.xy, values.sigma_xy
    columns = jax.tree.map(lambda x, y: jnp.stack([x, y], axis=-3), *jax.vmap(ray_columns(at))(numbers))
    # Those of points in scaled increments.
    columns = columns._replace(
        point=columns.point * jnp.moveaxis(scale.points[:, structure.ray_points], 0, 1)[:, :, None]
    )
    flat_scale = ravel_pytree(scale)[0]
    vector = jnp.sin(1.0 + jnp.arange(len(flat))) * (flat_scale > 0)

    def solved(damping):
        a, reduced, right = reduce_normal(at, damping)
        return ravel_pytree(solve_factored(reduced, factor_band(a), back(vector), at))[0], reduced, right

    # One damping after the other: half of what is compiled here is the normal equations.
    solutions, *undamped = jax.lax.map(solved, jnp.array(DAMPINGS))
    reduced, right = jax.tree.map(lambda v: v[DAMPINGS.index(0.0)], undamped)
    own = at.residuals()
    b = jax.tree.map(lambda v: v[0], jt_product(jax.tree.map(lambda v: v[None], own), at))
    down, d = reduce_right(reduced, b, at)
    return Dense(
        jacobian=jacobian,
        residuals=residuals,
        columns=columns,
        others=rest,
        vector=vector,
        gradient=ravel_pytree(b)[0],
        sums=ravel_pytree(right.b)[0],
        square_sums=jnp.stack([at.sum_of_squares(), sum(jnp.sum(v**2) for v in jax.tree.leaves(own))]),
        taken_down=jnp.stack([jnp.concatenate([down, d]), jnp.concatenate([right.reduced, right.d])]),
        couples=jnp.zeros(0, bool),
        solutions=solutions,
        scale=flat_scale,
    )


def assemble(dense: Dense, s) -> np.ndarray:
    """Assemble the dense Jacobian of image rows from the columns of rays."""
    e, q, n = 6 * s.n_images, s.n_shared, len(s.image)
    result = np.zeros((2 * n, e + q + 3 * s.n_points + 1))
    each = np.arange(n)
    for o in range(2):
        row = o * n + each
        for a in range(6):
            result[row, a * s.n_images + s.image] = dense.columns.eop[a, o]
        for k in range(s.n_image_colours):
            # The last column, cut off, serves colours that mean nothing in an image.
            column = s.column[s.image, k]
            result[row, np.where(column < q, e + column, -1)] = dense.columns.shared[k, o]
        for a in range(3):
            result[row, e + q + a * s.n_points + s.point] = dense.columns.point[a, o]
    return result[:, :-1]


def split(vector: np.ndarray, s) -> Increments:
    """A flat vector of increments by kind."""
    e = 6 * s.n_images
    q = e + s.n_shared
    return Increments(vector[:e].reshape(6, -1), vector[e:q], vector[q:].reshape(3, -1))
