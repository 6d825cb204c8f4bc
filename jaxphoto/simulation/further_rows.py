"""Simulation of further observations: true values from their residual functions, and new noise."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxphoto.block import Block, exposures
from jaxphoto.observations import AbstractObservations, Correlated, ImageState, KnownParameters
from jaxphoto.static_values import with_plain_arrays
from jaxphoto.unknowns import Unknowns

Rows = AbstractObservations | KnownParameters


def observed_anew(rows: Rows, block: Block, truth: Unknowns, key: PRNGKeyArray) -> Rows:
    """Return the rows with their observations under `truth`, plus normal noise of their sigmas.

    Rows with joint covariances, and those that touch parameters `truth` does not have, are not changed.
    """
    if isinstance(rows, Correlated | KnownParameters) or rows.block_parameters or rows.uses_interior or not len(rows):
        return rows
    missing = {what for what, _ in rows.indices()} - {"image", "point", *truth.tables}
    if missing:
        return rows
    touched = [_touched(what, np.asarray(index), block, truth) for what, index in rows.indices()]
    residual = jax.vmap(lambda row, of: row.residual(*of))(with_plain_arrays(rows), touched)
    noise = jnp.asarray(rows.sigmas) * jax.random.normal(key, np.shape(rows.sigmas))
    return rows.with_observation(jnp.asarray(rows.observation) - residual + noise)


def _touched(what: str, index: np.ndarray, block: Block, truth: Unknowns) -> Any:
    if what == "point":
        return jnp.asarray(truth.points)[index]
    if what != "image":
        return jax.tree.map(lambda *v: jnp.stack(v)[index], *map(_numbers, truth.tables[what].values()))
    exterior, taken, own = truth.exterior, jax.tree.map(lambda v: jnp.asarray(v)[index], exposures(block)), {}
    for kind, owners in truth.tables.items():
        if not owners:
            continue
        table = jax.tree.map(lambda *v: jnp.stack([*v, jnp.zeros_like(v[0])]), *map(_numbers, owners.values()))
        place = {name: k for k, name in enumerate(owners)}
        names = block.owners(type(next(iter(owners.values()))).owner)
        at = np.array([place.get(name, len(place)) for name in names])[index]
        own[kind] = jax.tree.map(lambda v: v[at], table)  # noqa: B023
    position, rotation = (jnp.asarray(v)[index] for v in (exterior.position, exterior.camera_from_object))
    states = ImageState
    # One image each: a state is declared as that of one.
    for _ in range(index.ndim):
        states = jax.vmap(states)
    return states(position, rotation, taken, own)


def _numbers(parameters: Any) -> Any:
    return jax.tree.map(lambda v: jnp.asarray(v, float), parameters)
