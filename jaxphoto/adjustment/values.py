"""From a block, a start and priors to the batch-last numbers that the adjustment computes with, and back."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.adjustment.residuals import State, Values
from jaxphoto.adjustment.shared import MOUNT_SIZE, STRIP_SIZE, shared_vector, spread
from jaxphoto.adjustment.structure import Structure
from jaxphoto.arrays import Numbers
from jaxphoto.block import Block, exposures
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing import Mount, Scanner, StripBias
from jaxphoto.unknowns import Unknowns, Weighted


def values_of(block: Block, start: Unknowns, priors: Unknowns, structure: Structure) -> Values:
    """Observations and start values as arrays; numbers only, so derivatives with respect to each exist."""
    rows, s = block.image_points, structure
    weights, known = _weights(priors, s), exposures(block)
    return Values(
        xy=_floats(rows.xy).T,
        sigma_xy=_floats(rows.sigma).T,
        stations=_floats(block.stations.value),
        sigma_stations=_floats(block.stations.sigma),
        time=_floats(known.time),
        velocity=_floats(known.velocity).T,
        rate=_floats(known.rate).T,
        nominal=_floats(known.nominal).transpose(1, 2, 0),
        attitudes=_floats(block.attitudes.roll_pitch_yaw).T,
        sigma_attitudes=_floats(block.attitudes.sigma).T,
        control=_floats(block.control.value),
        sigma_control=_floats(block.control.sigma),
        foot=_floats(block.surfaces.foot).T,
        normal=_floats(block.surfaces.normal).T,
        turn=_floats(block.surfaces.turn).T,
        sigma_surfaces=_floats(block.surfaces.sigma),
        distances=_floats(block.distances.value),
        sigma_distances=_floats(block.distances.sigma),
        priors=_vector([w.value for w in weights]),
        sigma_priors=_vector([w.sigma for w in weights]),
        position=_floats(start.exterior.position).T,
        rotation=_floats(start.exterior.camera_from_object).transpose(1, 2, 0),
        shared=_vector(shared_vector(start, s.groups)),
        points=_hold(_floats(start.points).T, block),
        datum_eop=_floats(np.zeros((0, 6, s.n_images))),
        datum_points=_floats(np.zeros((0, 3, s.n_points))),
    )


def _floats(x: Any) -> Any:
    """A float64 array: numpy's where nothing is traced, because its operations need no compilation."""
    return x if isinstance(x, jax.core.Tracer) else np.asarray(x, float)


def _vector(scalars: list):
    traced = any(isinstance(x, jax.core.Tracer) for x in scalars)
    return jnp.stack([jnp.asarray(x, float) for x in scalars]) if traced else np.array(scalars, float)


def with_datum(values: Values, eop: Numbers, points: Numbers) -> Values:
    """The same values with constraint rows of the datum."""
    return eqx.tree_at(lambda v: (v.datum_eop, v.datum_points), values, (eop, points))


def at_state(values: Values, state: State) -> Values:
    """The same values with the state as the new start, so that increments are zero there."""
    where = lambda v: (v.position, v.rotation, v.shared, v.points)  # noqa: E731
    return eqx.tree_at(where, values, tuple(state))


def unknowns_of(state: State, like: Unknowns, structure: Structure) -> Unknowns:
    """The state as the tree a user knows."""
    state = State(*map(_floats, state))
    interior = {}
    for group in structure.groups:
        m = group.treedef.num_leaves
        for k, name in enumerate(group.names):
            first = group.offset + k * m
            interior[name] = jax.tree.unflatten(group.treedef, [state.shared[first + j] for j in range(m)])
    mount = state.shared[structure.mount_offset : structure.strip_offset].reshape(-1, MOUNT_SIZE)
    strip = state.shared[structure.strip_offset :].reshape(-1, STRIP_SIZE)
    mounts = [Mount(v[:3], v[3:6], v[6], m.image_x) for v, m in zip(mount, like.mounts.values(), strict=True)]
    strips = [StripBias(v[:3], v[3:]) for v in strip]
    scanner = like.scanner
    if scanner is not None:
        boresight, *shifts = state.shared[structure.scanner_offset : structure.mount_offset].reshape(-1, 3)
        scanner = Scanner(boresight, dict(zip(scanner.shifts, shifts, strict=True)))
    return Unknowns(
        {name: interior[name] for name in like.interior},
        ExteriorOrientation(state.position.T, state.rotation.transpose(2, 0, 1)),
        state.points.T,
        dict(zip(like.mounts, mounts, strict=True)),
        dict(zip(like.strips, strips, strict=True)),
        scanner,
    )


def _hold(points, block: Block):
    """Fixed coordinates are what the block says, whatever the start."""
    if not len(block.fixed.who):
        return points
    held = jnp.asarray(points).at[block.fixed.axis, block.fixed.who].set(block.fixed.value)
    return _floats(held)


def _weights(priors: Unknowns, structure: Structure) -> list[Weighted]:
    """The weighted priors in the order of the shared unknowns they belong to."""
    is_weighted = lambda x: isinstance(x, Weighted)  # noqa: E731
    flat = [
        leaf
        for g in structure.groups
        for name in g.names
        for leaf in jax.tree.leaves(priors.interior[name], is_leaf=is_weighted)
    ]
    flat += spread(priors.scanner) if priors.scanner is not None else []
    flat += [p for mount in priors.mounts.values() for p in spread(mount)]
    flat += [p for strip in priors.strips.values() for p in spread(strip)]
    return [flat[k] for k in structure.free if is_weighted(flat[k])]
