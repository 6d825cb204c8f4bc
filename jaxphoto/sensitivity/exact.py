"""Exact sensitivity of an adjustment, by adjoint vectors for its estimates or along one direction of change.

At the optimum the gradient of half the weighted sum of squares is zero for any observations v. By the implicit function
theorem an estimate e, a function of the unknowns x, has the derivative

    de/dv = -lambda' B,   H lambda = de/dx

with H and B of `hessian`. With the curvature of the residuals this is exact; without, it is the classical first-order
matrix -N^-1 J'P. One adjoint vector lambda per estimate serves all observations (`sensitivity`), and B is sparse: an
image row involves only its image, camera and point. With M, C and F of `hessian`, the gain
K = -V^-1 [W; Ws; D]' = -L^-T F, and the derivatives b and b_p of an estimate by the unknowns of M and by the points,
the points are eliminated by

    lambda = M^-1 [b + K_x' b_p; C K_mu' b_p]       for images and shared unknowns, and for mu
    lambda_p = V^-1 b_p + K lambda

This takes a few products of NumPy arrays with the sparse matrix K.

`response` computes the change of all unknowns, dy = -H^-1 B dv, for one direction dv of change of all values of a block
(observations, standard deviations, weights of priors, fixed parameters).
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment, NormalEquations, PaddedBlock, PaddedStructure, PaddedValues
from jaxphoto.adjustment.model.block_values import unknowns_of, values_of, with_datum
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS, UnknownArrays, state_at
from jaxphoto.adjustment.model.row_functions import reduced_places
from jaxphoto.adjustment.model.structure import Structure
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.camera import table_name
from jaxphoto.compiling import run_compiled
from jaxphoto.errors import InputError, few
from jaxphoto.observations import AXES
from jaxphoto.rotation import omega_phi_kappa_from_matrix
from jaxphoto.sensitivity.hessian import (
    ReducedHessian,
    check_optimum,
    mixed_second,
    reduce_hessian,
    rows_second,
    solve_hessian,
)
from jaxphoto.sensitivity.image_rows import ListedRows, image_rows
from jaxphoto.short_repr import pretty_repr
from jaxphoto.small_matrices import unwhiten
from jaxphoto.statistics import EOP_NAMES
from jaxphoto.statistics.covariance import rotation_jacobians
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import Unknowns


class Estimates(NamedTuple):
    """Estimates whose adjoint vectors are requested. `step`, `point_step`: units of the scaled increments."""

    unknowns: Int[np.ndarray, "n"]
    """Indices in M of exterior orientations and shared unknowns, in the block's order."""
    step: Float[np.ndarray, "n"]
    rotations: Float[np.ndarray, "images 3 3"]
    """Derivatives of the reported angles of each image by its small rotation (rad)."""
    points: Int[np.ndarray, "requested"]
    """Indices of the requested points, in padded order."""
    point_step: Float[np.ndarray, "requested 3"]


def adjoint_vectors(h: Any, estimates: Estimates) -> Float[np.ndarray, "unknowns estimates"]:
    """Compute the adjoint vector lambda of each estimate.

    Rows: exterior orientations and shared unknowns in the block's order, mu, all points. `h` is a `ReducedHessian` of
    concrete arrays.
    """
    n, k, points = len(estimates.unknowns), len(h.c), estimates.points
    n_points = h.l.shape[1]
    index = np.append(estimates.unknowns, len(h.m) - k + np.arange(k))
    # Padding has F = 0, so its index is arbitrary.
    place = np.zeros(int(max(h.ray_index.max(initial=0), h.border_index.max(initial=0), len(h.m))) + 1, int)
    place[index] = np.arange(n + k)
    inverse = _inverse(h.m.take(index, axis=0).take(index, axis=1), positive=not k)
    adjoint = np.empty((n + k + 3 * n_points, n + 3 * len(points)))
    reduced = adjoint[: n + k]

    np.multiply(inverse[:, :n], estimates.step, out=reduced[:, :n])
    # Multiply by component: a batch of 3 x 3 matrix products is several times slower.
    images = 6 * len(estimates.rotations)
    angles = [reduced[:, j:images:6] for j in (3, 4, 5)]
    rotated = [sum(a * factor for a, factor in zip(angles, estimates.rotations[:, i].T, strict=True)) for i in range(3)]
    for i in range(3):
        angles[i][:] = rotated[i]
    gain = _gain(h, place, n + k)
    point_gain = gain[(3 * points[:, None] + np.arange(3)).ravel()].toarray()
    right = point_gain.T * estimates.point_step.reshape(-1)
    reduced[:, n:] = inverse @ np.concatenate([right[:n], h.c @ right[n:]])

    adjoint[n + k :] = gain @ reduced
    at_points = adjoint[n + k :].reshape(n_points, 3, -1)
    for j, v_inverse in enumerate(_inverses(h.l[:, points].T) * estimates.point_step[:, None]):
        at_points[points[j], :, n + 3 * j : n + 3 * j + 3] += v_inverse
    return adjoint


def _gain(h: Any, place: Int[np.ndarray, "unknowns"], size: int) -> "scipy.sparse.csr_array":
    """Return K = -L^-T F, three rows per point."""
    rows, values, columns = [], [], []
    for point, f, index in ((h.point, h.rays, h.ray_index), (np.arange(h.l.shape[1]), h.border, h.border_index)):
        gain = -np.stack(unwhiten(np.moveaxis(f, 0, -1), h.l[:, point]))
        rows.append(np.broadcast_to((3 * point + np.arange(3)[:, None])[:, None], gain.shape).ravel())
        columns.append(np.broadcast_to(place[index].T, gain.shape).ravel())
        values.append(gain.ravel())
    data, at = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return scipy.sparse.coo_array((data, at), shape=(3 * h.l.shape[1], size)).tocsr()


def _inverse(m: Float[np.ndarray, "n n"], positive: bool) -> Float[np.ndarray, "n n"]:
    """Return the inverse of a symmetric matrix, by Cholesky if it is positive definite."""
    lower, failed = scipy.linalg.lapack.dpotrf(m.T, lower=True) if positive else (m, True)
    if failed:
        return np.linalg.inv(m)
    # dpotri fills only the lower triangle; the upper one is zero.
    half = scipy.linalg.lapack.dpotri(lower, lower=True, overwrite_c=True)[0]
    inverse = half + half.T
    np.fill_diagonal(inverse, half.diagonal())
    return inverse


def _inverses(l: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n 3 3"]:  # noqa: E741
    """Return V^-1 from the Cholesky factor L of V."""
    lower = np.zeros((len(l), 3, 3))
    lower[:, [0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]] = l
    inverse = np.linalg.inv(lower)
    return inverse.swapaxes(1, 2) @ inverse


# Maximum number of derivatives by image points (1.6 GB).
_MAX_ELEMENTS = 2e8


@pretty_repr
class Sensitivity(eqx.Module):
    """Derivatives of the estimates `labels`, one row per estimate, by observations in the block's order.

    `named` contains them by group, in the shape of the residuals: (estimates, rows) or (estimates, rows, axes). Units
    are the unit of the estimate (m, rad, mm, the coefficient's own) over the unit of the observation (mm on the image,
    m, rad). Surfaces are observed along their normals (m). Fixed parameters have zero rows, and derivatives by the
    observations of fixed parameters are zero.
    """

    named: dict[str, Float[np.ndarray, "estimates ..."]]
    labels: tuple[str, ...] = eqx.field(static=True)
    """Labels as in `Covariance`, then `points[name].X` etc. of the requested points."""
    curvature: bool = eqx.field(static=True)
    """True if the curvature of the residuals is included; otherwise this is the classical first-order matrix."""
    by_fixed: Callable[[], tuple[np.ndarray, tuple[str, ...]]] = eqx.field(static=True, repr=False)
    """Computes `fixed` and `fixed_labels` on request, which takes as long as the rest."""

    def __getitem__(self, name: str) -> Float[np.ndarray, "estimates ..."]:
        return self.named[name]

    @property
    def groups(self) -> dict[str, Float[np.ndarray, "estimates _"]]:
        """Derivatives by group of observations, one matrix per group; the components of a row are consecutive."""
        return {name: v.reshape(len(self.labels), -1) for name, v in self.named.items()}

    @property
    def fixed(self) -> Float[np.ndarray, "estimates fixed"]:
        """Derivatives with respect to the fixed parameters and coordinates, in the order of `fixed_labels`."""
        return self.by_fixed()[0]

    @property
    def fixed_labels(self) -> tuple[str, ...]:
        """Paths of all fixed parameters, then `points[name].X` etc. of the fixed coordinates."""
        return self.by_fixed()[1]

    def row(self, label: str) -> int:
        """Return the index of the estimate `label`: a path, or its last part if unique, such as c or lever_arm_up_m.

        Raises InputError for an unknown or ambiguous label.
        """
        name = table_name(label)
        rows = [k for k, own in enumerate(self.labels) if name in (own, own.rpartition("].")[2])]
        if len(rows) == 1:
            return rows[0]
        if rows:
            paths = few([self.labels[k] for k in rows], " or ")
            raise InputError(f"{label} of several owners: give a path, such as {paths}")
        raise InputError(f"unknown estimate {label}: choose among {', '.join(self.labels[-8:])} and others")


@outside_transformations
def sensitivity(adjusted: Adjustment, *, curvature: bool = True, points: Sequence[str] = ()) -> Sensitivity:
    """Compute d(estimate) / d(observation, prior, fixed parameter) at the optimum of `adjusted`.

    Estimates are all exterior orientations (X, Y, Z in m; omega, phi, kappa in rad), all shared unknowns (interior
    orientation, mounts, strips) and the coordinates (m) of the named `points`. With `curvature` the derivative is
    exact; without, it is the classical first-order matrix -N^-1 J'P dr/dv.

    Raises InputError for an unknown point, for an adjustment that has not converged, and for a block whose matrix is
    too large; use `response` for such a block.
    """
    _check_points(adjusted, points)
    check_optimum(adjusted)
    equations = adjusted.equations.on_one_device
    padded, places, scale, s = adjusted.padded, adjusted.padded.places, equations.scale, equations.structure
    structure, estimates = adjusted.structure, 6 * len(places.image) + s.n_shared + 3 * len(points)
    _check_size(structure, estimates)
    arguments = equations, image_rows(adjusted), np.array(float(curvature))
    parts = jax.tree.map(to_numpy, run_compiled(_derivatives, arguments, adjusted.seconds, "sensitivity"))
    requested = places.point[[adjusted.block.points.index(name) for name in points]] if points else np.zeros(0, int)
    unknowns = np.append(6 * places.image[:, None] + np.arange(6), 6 * s.n_images + np.arange(s.n_shared))
    step = np.append(scale.eop.T, scale.shared)[unknowns]
    estimated = Estimates(unknowns, step, parts.rotations[places.image], requested, to_numpy(scale.points).T[requested])
    adjoint = adjoint_vectors(parts.h, estimated)

    rows = _observations(parts, padded, len(unknowns) + len(parts.h.c))
    derivatives = _sparse(list(rows.values()), len(adjoint)) @ adjoint
    shapes = {name: b.shape[:-1] for name, (b, _) in rows.items()}
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])[:-1]
    matrices = zip(shapes.items(), np.split(derivatives, ends), strict=True)
    # Put the estimates on the last axis: the derivatives by one observation are contiguous in memory.
    groups = {name: np.moveaxis(matrix.reshape(*shape, estimates), -1, 0) for (name, shape), matrix in matrices}
    names = [f"exterior[{i}].{e}" for i in adjusted.block.images for e in EOP_NAMES["omega_phi_kappa"]]
    labels = (*names, *structure.labels, *(f"points[{name}].{axis}" for name in points for axis in AXES))
    by_fixed = partial(_by_fixed, adjusted, curvature, labels, adjoint, unknowns)
    return Sensitivity(groups, labels=labels, curvature=curvature, by_fixed=by_fixed)


def _check_points(adjusted: Adjustment, points: Sequence[str]) -> None:
    block_points = set(adjusted.block.points)
    if missing := [name for name in points if name not in block_points]:
        raise InputError(f"unknown point {missing[0]}: request the sensitivity of points of the block")


def _check_size(structure: Structure, estimates: int) -> None:
    elements = 2 * len(structure.image) * estimates
    if elements > _MAX_ELEMENTS:
        raise InputError(
            f"all derivatives of a block of {structure.n_images} images are {elements:.0e} numbers, more than "
            f"{_MAX_ELEMENTS:.0e}: use response for one change at a time, or a smaller block"
        )


class _Derivatives(NamedTuple):
    """Reduced Hessian of a padded block, and B (z, observed, ...) of all rows except image rows."""

    h: ReducedHessian
    rotations: Float[Array, "images 3 3"]
    others: tuple[Float[Array, "z o ..."], ...]


@eqx.filter_jit
def _derivatives(equations: NormalEquations, rows: ListedRows, curved: Array) -> _Derivatives:
    at = equations.at
    others = tuple(second.b for second in rows_second(at, curved))
    h = reduce_hessian(at, rows, curved)
    return _Derivatives(h, rotation_jacobians(at.values.rotation, "omega_phi_kappa"), others)


Rows = tuple[np.ndarray, np.ndarray]
"""-B of some observations (last axis: their variables), and the indices of these variables among the unknowns."""


def _observations(parts: _Derivatives, padded: PaddedBlock, first: int) -> dict[str, Rows]:
    """Return -B of all observations by group name; points start at index `first`."""
    structure, places = padded.own, padded.places
    n, q, axes = 6 * structure.n_images, structure.n_image_colours, np.arange(3)
    first_of_point = first + 3 * places.point
    eop = 6 * np.arange(structure.n_images)[:, None] + np.arange(6)
    by_image = np.concatenate([eop, n + structure.column[:, :q]], axis=1)[structure.image]
    by_point = first_of_point[structure.point][:, None] + axes
    unknowns = np.concatenate([by_image[:, :6], by_point, by_image[:, 6:]], axis=1)
    rows: dict[str, tuple[Any, np.ndarray]] = {IMAGE_POINTS: (parts.h.measured[: len(unknowns)], unknowns[:, None])}
    for g, b in zip(structure.observed, parts.others, strict=True):
        z, o = b.shape[:2]
        # Reshape (z o, rows) to rows first and z last.
        flat = padded.crop_rows(dataclasses.replace(g, scalar=False), np.reshape(b, (z * o, *b.shape[2:])))
        flat = -np.moveaxis(flat.reshape(z, o, -1), 0, -1).swapaxes(0, 1)
        by_point = (first_of_point[g.point][:, None] + axes[:, None]).reshape(-1, g.n_rows)
        unknowns = np.concatenate([np.asarray(reduced_places(g, structure.n_images)), by_point]).T
        rows[g.name] = (flat[:, 0], unknowns) if g.scalar else (flat, unknowns[:, None])
    return {name: (b, np.broadcast_to(unknowns.astype(np.int32), b.shape)) for name, (b, unknowns) in rows.items()}


def _sparse(rows: Sequence[Rows], unknowns: int) -> "scipy.sparse.csr_array":
    """Return -B as a sparse matrix, one row per observation."""
    lengths = np.repeat([b.shape[-1] for b, _ in rows], [math.prod(b.shape[:-1]) for b, _ in rows])
    data, columns = (np.concatenate([part[k].ravel() for part in rows]) for k in range(2))
    starts = np.append(0, np.cumsum(lengths)).astype(np.int32)
    return scipy.sparse.csr_array((data, columns, starts), shape=(len(lengths), unknowns))


class _Fixed(NamedTuple):
    """Fixed unknowns: indices of shared parameters, then point index and axis of coordinates."""

    shared: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "m"]
    axis: Int[np.ndarray, "m"]


def _by_fixed(
    adjusted: Adjustment, curvature: bool, labels: Sequence[str], adjoint: np.ndarray, unknowns: np.ndarray
) -> tuple[Float[np.ndarray, "estimates fixed"], tuple[str, ...]]:
    """Compute -lambda' B of the fixed unknowns. Return it with the labels: parameter paths, then coordinates."""
    block, fixed = adjusted.block, adjusted.block.fixed
    equations = adjusted.equations.on_one_device
    s, places, values = equations.structure, adjusted.padded.places, equations.values
    parameters = adjusted.parameters
    shared = np.setdiff1d(np.arange(len(values.shared)), s.free)
    indices = _Fixed(*(np.asarray(v, np.int32) for v in (shared, places.point[fixed.who], fixed.axis)))
    arguments = equations, np.array(float(curvature)), indices
    b = to_numpy(run_compiled(_fixed_rows, arguments, adjusted.seconds, "sensitivity"))
    n = 6 * s.n_images + s.n_shared
    products = b[:, unknowns] @ adjoint[: len(unknowns)] + b[:, n:] @ adjoint[len(adjoint) - 3 * s.n_points :]

    coordinates = (f"points[{block.points[p]}].{AXES[a]}" for p, a in zip(fixed.who, fixed.axis, strict=True))
    fixed_labels = (*(parameters[k] for k in shared), *coordinates)
    # The derivative of a fixed estimate by itself is 1.
    same = np.array(labels)[:, None] == np.array(fixed_labels, dtype=str)
    return same - products.T, fixed_labels


@eqx.filter_jit
def _fixed_rows(equations: NormalEquations, curved: Array, fixed: _Fixed) -> Float[Array, "fixed n"]:
    """Compute B of each fixed unknown as a dense row: by images, shared unknowns and points."""
    at, values = equations.at, equations.values
    shared, coordinates = jnp.zeros_like(values.shared), jnp.zeros_like(values.points)
    unchanged: Any = jax.tree.map(lambda _: None, values)

    def column(shared, coordinates):
        leaves = lambda v: (v.shared, v.points)  # noqa: E731
        change = eqx.tree_at(leaves, unchanged, (shared, coordinates), is_leaf=lambda v: v is None)
        b = mixed_second(at, change, curved)
        return jnp.concatenate([b.eop.T.reshape(-1), b.shared, b.points.T.reshape(-1)])

    by_shared = jax.lax.map(lambda k: column(shared.at[k].set(1.0), coordinates), fixed.shared)
    unit = lambda axis, point: coordinates.at[axis, point].set(1.0)  # noqa: E731
    by_coordinate = jax.lax.map(lambda k: column(shared, unit(*k)), (fixed.axis, fixed.point))
    return jnp.concatenate([by_shared, by_coordinate])


@pretty_repr
class Response(eqx.Module):
    """Change of every unknown in its own unit. Images, points and parameters are in the block's order."""

    unknowns: Unknowns
    """Changes as a tree of unknowns; `exterior.camera_from_object` contains the changes of the rotation matrices."""
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
    """Predict `adjust(block, start, priors)` minus `adjusted` to first order, if only values have changed.

    `block`: the adjusted block with other observations or standard deviations. `start`: other values of the fixed
    parameters (None: unchanged; free parameters are ignored). `priors`: other weighted priors (None: unchanged). With
    `curvature` this is the exact derivative along the change; without, it is the classical first-order change -N^-1 J'P
    dr. The error for a finite change is of second order.

    Raises InputError for a block with other rows, for an adjustment that has not converged, and for more than a
    thousand images; use `jax.jvp` through `adjust` for such a block.
    """
    check_optimum(adjusted)
    s, equations = adjusted.structure, adjusted.equations.on_one_device
    changed = values_of(
        block,
        adjusted.unknowns if start is None else start,
        adjusted.priors if priors is None else priors,
        s,
    )
    changed = with_datum(changed, adjusted.values.datum_eop, adjusted.values.datum_points)
    same = jax.tree.map(lambda a, b: np.shape(a) == np.shape(b), changed, adjusted.values)
    if not all(jax.tree.leaves(same)):
        raise InputError(
            "response compares values row by row, but the block has other rows than the adjusted one: change its "
            "values, or adjust it again"
        )
    direction = jax.tree.map(_difference, adjusted.padded.pad(changed), equations.values)
    arguments = (
        equations,
        _without_free(direction, equations.structure),
        image_rows(adjusted),
        np.array(float(curvature)),
    )
    state, angles = run_compiled(_response, arguments, adjusted.seconds, "sensitivity")
    change = unknowns_of(adjusted.padded.crop_state(state), adjusted.unknowns, s)
    return Response(change, to_numpy(angles)[adjusted.padded.places.image])


def _difference(changed: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Subtract where both are finite: padding has infinite standard deviations."""
    finite = np.isfinite(changed) & np.isfinite(values)
    return np.where(finite, np.where(finite, changed, 0.0) - np.where(finite, values, 0.0), 0.0)


def _without_free(direction: PaddedValues, s: PaddedStructure) -> PaddedValues:
    """Set the free parameters of a direction to zero: their initial values have no effect."""
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
    h, b = reduce_hessian(at, rows, curved), jax.tree.map(jnp.negative, mixed_second(at, direction, curved))
    state_of = lambda y, v: state_at(y, at.scale, v, s)  # noqa: E731
    state, change = jax.jvp(state_of, (at.increments, equations.values), (solve_hessian(h, b, s), direction))
    angles = jax.vmap(omega_phi_kappa_from_matrix, in_axes=2)
    return change, jax.jvp(angles, (state.rotation,), (change.rotation,))[1]
