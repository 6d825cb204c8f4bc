"""From a block, a start and priors to the batch-last numbers that the adjustment computes with, and back."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.adjustment.residuals import State, Values
from jaxphoto.adjustment.structure import Structure, shared_vector, spread
from jaxphoto.block import Block
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.unknowns import Unknowns, Weighted


def values_of(block: Block, start: Unknowns, priors: Unknowns, structure: Structure) -> Values:
    """Observations and start values as arrays; numbers only, so derivatives with respect to each exist."""
    rows, s = block.image_points, structure
    weights = _weights(priors, s)
    points = _hold(jnp.asarray(start.points).T, block)
    return Values(
        xy=jnp.asarray(rows.xy).T,
        sigma_xy=jnp.asarray(rows.sigma).T,
        stations=jnp.asarray(block.stations.value),
        sigma_stations=jnp.asarray(block.stations.sigma),
        time=jnp.asarray(block.image_time),
        attitudes=jnp.asarray(block.attitudes.roll_pitch_yaw).T,
        sigma_attitudes=jnp.asarray(block.attitudes.sigma).T,
        control=jnp.asarray(block.control.value),
        sigma_control=jnp.asarray(block.control.sigma),
        distances=jnp.asarray(block.distances.value),
        sigma_distances=jnp.asarray(block.distances.sigma),
        priors=jnp.asarray([w.value for w in weights], float),
        sigma_priors=jnp.asarray([w.sigma for w in weights], float),
        position=jnp.asarray(start.exterior.position).T,
        rotation=jnp.moveaxis(jnp.asarray(start.exterior.camera_from_object), 0, -1),
        shared=jnp.asarray(shared_vector(start, s.groups), float),
        points=points,
        datum_eop=jnp.zeros((0, 6, s.n_images)),
        datum_points=jnp.zeros((0, 3, s.n_points)),
    )


def with_datum(values: Values, eop, points) -> Values:
    """The same values with constraint rows of the datum."""
    return eqx.tree_at(lambda v: (v.datum_eop, v.datum_points), values, (jnp.asarray(eop), jnp.asarray(points)))


def at_state(values: Values, state: State) -> Values:
    """The same values with the state as the new start, so that increments are zero there."""
    where = lambda v: (v.position, v.rotation, v.shared, v.points)  # noqa: E731
    return eqx.tree_at(where, values, tuple(state))


def unknowns_of(state: State, like: Unknowns, structure: Structure) -> Unknowns:
    """The state as the tree a user knows."""
    interior = {}
    for group in structure.groups:
        m = group.treedef.num_leaves
        for k, name in enumerate(group.names):
            first = group.offset + k * m
            interior[name] = jax.tree.unflatten(group.treedef, [state.shared[first + j] for j in range(m)])
    vectors = state.shared[structure.mount_offset :].reshape(-1, 3)
    rest = iter(vectors)
    fill = lambda tree: jax.tree.map(lambda _: next(rest), tree)  # noqa: E731
    mounts, strips = fill(list(like.mounts.values())), fill(list(like.strips.values()))
    return Unknowns(
        {name: interior[name] for name in like.interior},
        ExteriorOrientation(state.position.T, jnp.moveaxis(state.rotation, -1, 0)),
        state.points.T,
        dict(zip(like.mounts, mounts, strict=True)),
        dict(zip(like.strips, strips, strict=True)),
    )


def _hold(points: jax.Array, block: Block) -> jax.Array:
    """Fixed coordinates are what the block says, whatever the start."""
    if not len(block.fixed.who):
        return points
    return points.at[np.asarray(block.fixed.axis), np.asarray(block.fixed.who)].set(jnp.asarray(block.fixed.value))


def _weights(priors: Unknowns, structure: Structure) -> list[Weighted]:
    """The weighted priors in the order of the shared unknowns they belong to."""
    is_weighted = lambda x: isinstance(x, Weighted)  # noqa: E731
    flat = [
        leaf
        for g in structure.groups
        for name in g.names
        for leaf in jax.tree.leaves(priors.interior[name], is_leaf=is_weighted)
    ]
    for item in (*priors.mounts.values(), *priors.strips.values()):
        flat += [p for vector in jax.tree.leaves(item, is_leaf=is_weighted) for p in spread(vector)]
    return [flat[k] for k in structure.free if is_weighted(flat[k])]
