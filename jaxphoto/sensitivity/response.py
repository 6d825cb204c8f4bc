"""The response of an adjustment to a change of its block: what adjusting anew would give, to first order.

Observations, standard deviations, weights of priors and parameters held fixed may all change at once; every unknown
answers, all points included: dy = -H^-1 B dv along one direction dv, see `hessian`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment, NormalEquations, PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.block_values import unknowns_of, values_of, with_datum
from jaxphoto.adjustment.model.numbers import UnknownArrays, state_at
from jaxphoto.arrays import still
from jaxphoto.block import Block
from jaxphoto.compiling import run_compiled
from jaxphoto.errors import InputError
from jaxphoto.rotation import omega_phi_kappa_from_matrix
from jaxphoto.sensitivity.curvature import mixed_second
from jaxphoto.sensitivity.hessian import check_optimum, eliminated, solve_eliminated
from jaxphoto.sensitivity.image_rows import ListedRows, image_rows
from jaxphoto.short_repr import shown
from jaxphoto.unknowns import Unknowns


@shown
class Response(eqx.Module):
    """By how much every unknown moves, in its own unit; images, points and parameters in the block's order."""

    unknowns: Unknowns
    """Changes in the tree of unknowns; of `exterior.camera_from_object`, those of the matrices."""
    omega_phi_kappa: Float[np.ndarray, "images 3"]
    """Changes of the angles (rad)."""


def response(
    adjusted: Adjustment,
    block: Block,
    start: Unknowns | None = None,
    priors: Unknowns | None = None,
    *,
    curvature: bool = True,
) -> Response:
    """To first order, `adjust(block, start, priors)` minus `adjusted`, where only numbers have changed since.

    `block` is the adjusted one with other observations or standard deviations; `start` holds other values of the
    parameters that are fixed (None: as they were; what is free in it does not matter); `priors` other weighted
    priors (None: as they were). With `curvature` it is the exact derivative along that change; without, the classical
    first-order answer -N^-1 J'P dr. The change of the result by a change that is not small differs from it by terms of
    second order.

    Raises InputError where `block` has other rows, where `adjusted` has not converged, and for a block of more than a
    thousand images; `jax.jvp` through `adjust` serves that.
    """
    check_optimum(adjusted)
    s, equations = adjusted.structure, adjusted.equations.on_one_device
    moved = values_of(
        block,
        adjusted.unknowns if start is None else start,
        adjusted.priors if priors is None else priors,
        s,
    )
    moved = with_datum(moved, adjusted.values.datum_eop, adjusted.values.datum_points)
    same = jax.tree.map(lambda a, b: np.shape(a) == np.shape(b), moved, adjusted.values)
    if not all(jax.tree.leaves(same)):
        raise InputError(
            "response compares numbers row by row, but the block has other rows than the adjusted one: "
            "change its values, or adjust it anew"
        )
    direction = jax.tree.map(_difference, adjusted.padded.pad(moved), equations.values)
    moves = _of_fixed(direction, equations.structure)
    arguments = (equations, moves, image_rows(adjusted), np.array(float(curvature)))
    state, angles = run_compiled(_response, arguments, adjusted.seconds, "sensitivity")
    change = unknowns_of(adjusted.padded.crop_state(state), adjusted.unknowns, s)
    return Response(change, still(angles)[adjusted.padded.places.image])


def _difference(moved: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Of what is known of both: slots without a row have infinite standard deviations."""
    both = np.isfinite(moved) & np.isfinite(before)
    return np.where(both, np.where(both, moved, 0.0) - np.where(both, before, 0.0), 0.0)


def _of_fixed(direction: PaddedValues, s: PaddedStructure) -> PaddedValues:
    """The same without what is free: where it starts does not matter."""
    shared = np.array(direction.shared)
    shared[s.free] = 0.0
    return eqx.tree_at(
        lambda v: (v.position, v.rotation, v.shared, v.points),
        direction,
        (
            np.where(s.eop_free[:3] > 0, 0.0, direction.position),
            np.where(s.eop_free[3] > 0, 0.0, direction.rotation),
            shared,
            np.where(s.point_free > 0, 0.0, direction.points),
        ),
    )


@eqx.filter_jit
def _response(
    equations: NormalEquations, direction: PaddedValues, rows: ListedRows, curved: jax.Array
) -> tuple[UnknownArrays, jax.Array]:
    at, s = equations.at, equations.structure
    h, b = eliminated(at, rows, curved), jax.tree.map(jnp.negative, mixed_second(at, direction, curved))
    state = lambda y, v: state_at(y, at.scale, v, s)  # noqa: E731
    there, change = jax.jvp(state, (at.increments, equations.values), (solve_eliminated(h, b, s), direction))
    angles = jax.vmap(omega_phi_kappa_from_matrix, in_axes=2)
    return change, jax.jvp(angles, (there.rotation,), (change.rotation,))[1]
