"""Conversion of a block, start values and priors to batch-last arrays, and back."""

import dataclasses
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.adjustment.model.numbers import AbstractValues, UnknownArrays, Values
from jaxphoto.adjustment.model.observed_groups import RowsInList, numbers_in
from jaxphoto.adjustment.model.parameter_tables import shared_vector, unknowns_from
from jaxphoto.adjustment.model.structure import AbstractStructure, ObservedRows, observed_in
from jaxphoto.arrays import ArrayLike, vector_of
from jaxphoto.block import Block, exposures
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.unknowns import Unknowns

SomeValues = TypeVar("SomeValues", bound=AbstractValues)


def values_of(
    block: Block, start: Unknowns, priors: Unknowns, structure: AbstractStructure, observed: ObservedRows | None = None
) -> Values:
    """Return observations and start values as arrays. All leaves are real, so all are differentiable.

    `observed` is the result of `observed_in(block, priors)`, if already computed.
    """
    rows, s, known = block.image_points, structure, exposures(block)
    given = observed_in(block, priors) if observed is None else observed
    return Values(
        xy=_floats(rows.xy).T,
        sigma_xy=_floats(rows.sigma).T,
        groups=tuple(RowsInList(numbers_in(rows)) for _, rows in given.named),
        time=_floats(known.time),
        velocity=_floats(known.velocity).T,
        rate=_floats(known.rate).T,
        nominal=_floats(known.nominal).transpose(1, 2, 0),
        flight_time=_floats(known.flight_time),
        height=_floats(known.height),
        temperature=_floats(known.temperature),
        position=_floats(start.exterior.position).T,
        rotation=_floats(start.exterior.camera_from_object).transpose(1, 2, 0),
        shared=vector_of(shared_vector(start, given.camera_names, given.tables)),
        points=_hold(_floats(start.points).T, block),
        datum_eop=_floats(np.zeros((0, 6, s.n_images))),
        datum_points=_floats(np.zeros((0, 3, s.n_points))),
    )


def _floats(x: Any) -> Any:
    """Return a float64 array; a NumPy array unless traced, because NumPy operations need no compilation."""
    return jnp.asarray(x, float) if isinstance(x, jax.core.Tracer) else np.asarray(x, float)


def with_datum(values: SomeValues, eop: ArrayLike, points: ArrayLike) -> SomeValues:
    """Replace the constraint rows of the datum."""
    return eqx.tree_at(lambda v: (v.datum_eop, v.datum_points), values, (eop, points))


def with_start(values: SomeValues, state: UnknownArrays) -> SomeValues:
    """Replace the start values by `state`, with zero increments."""
    where = lambda v: (v.position, v.rotation, v.shared, v.points)  # noqa: E731
    return eqx.tree_at(where, values, tuple(state))


def unknowns_of(state: UnknownArrays, like: Unknowns, structure: AbstractStructure) -> Unknowns:
    """Return the state as the `Unknowns` of the public interface."""
    state = UnknownArrays(*map(_floats, state))
    interior = {}
    for group in structure.groups:
        m = group.treedef.num_leaves
        for k, name in enumerate(group.names):
            first = group.offset + k * m
            interior[name] = jax.tree.unflatten(group.treedef, [state.shared[first + j] for j in range(m)])
    return dataclasses.replace(
        unknowns_from(state.shared, like, structure.tables),
        interior={name: interior[name] for name in like.interior},
        exterior=ExteriorOrientation(state.position.T, state.rotation.transpose(2, 0, 1)),
        points=state.points.T,
    )


def _hold(points, block: Block):
    """Set fixed coordinates to their values in the block, for any start values."""
    if not len(block.fixed.who):
        return points
    held = jnp.asarray(points).at[block.fixed.axis, block.fixed.who].set(block.fixed.value)
    return _floats(held)
