"""Covariances of all unknowns, in their own units, from the cofactors of the normal equations.

Covariance of two adjustments with common observations: two halves of a block have no common images, but both use
control, distances and prior information. To first order an estimate has the error -w'e, with e the observation errors
over their standard deviations and w = J N^-1 e_p the weights of the estimate. The covariance of two estimates is
therefore w1'w2, summed over the common rows.
"""

from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxphoto.adjustment import Adjustment, Cofactors, NormalEquations, PaddedResiduals, RowCofactors
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.adjustment.model.structure import observed_in
from jaxphoto.arrays import ArrayLike, gathered, to_numpy
from jaxphoto.camera import table_name
from jaxphoto.compiling import prepare, run_compiled
from jaxphoto.errors import counted
from jaxphoto.rotation import omega_phi_kappa_from_matrix, small_rotation
from jaxphoto.short_repr import fields_html

Rotations = Literal["omega_phi_kappa", "object", "camera"]
EOP_NAMES: dict[str, tuple[str, ...]] = {
    "omega_phi_kappa": ("X", "Y", "Z", "omega", "phi", "kappa"),
    "object": ("X", "Y", "Z", "rX", "rY", "rZ"),
    "camera": ("X", "Y", "Z", "rx", "ry", "rz"),
}


class Covariance(eqx.Module):
    """A priori covariances (sigma naught 1), in metres, radians, mm and the coefficients' own units.

    `matrix` is the covariance of the exterior orientations, followed by the shared unknowns. Each image, in the
    block's order, has six rows: X, Y, Z and three rotations of the kind `rotations`. Fixed unknowns have zero rows.
    Multiply by `variance_factor` for a posteriori values.
    """

    matrix: Float[ArrayLike, "reduced reduced"]
    points: Float[ArrayLike, "points 3 3"]
    variance_factor: Float[ArrayLike, ""] | float
    cofactors: Cofactors
    """Cofactors in padded sizes; see `Adjustment.padded`."""
    rows: RowCofactors | None
    """J Q J' of the observations in padded sizes, if requested."""
    labels: tuple[str, ...] = eqx.field(static=True)
    n_images: int = eqx.field(static=True)
    rotations: Rotations = eqx.field(static=True)
    converged: Bool[ArrayLike, ""]
    """False: the adjustment stopped before convergence, and the covariance is not a measure of accuracy."""

    def __repr__(self) -> str:
        # Inside a JAX transformation the fields are tracers.
        if np.ndim(self.converged) or not isinstance(self.converged, bool | np.generic | np.ndarray):
            return "Covariance: traced by JAX or batched, values are arrays"
        of = f"{counted(self.n_images, 'image')}, {counted(len(self.points), 'point')}"
        shared = counted(len(self.labels) - 6 * self.n_images, "shared unknown")
        where = "" if self.converged else ";\n  not converged: evaluated where the adjustment stopped, do not use"
        return f"Covariance of {of} and {shared}, a priori; variance factor {float(self.variance_factor):.4g}{where}"

    _repr_html_ = fields_html

    @property
    def exterior_sigma(self) -> Float[ArrayLike, "images 6"]:
        """A posteriori standard deviations of X, Y, Z (m) and the rotations (rad), by image."""
        return self._sigma(self.matrix.diagonal())[: 6 * self.n_images].reshape(-1, 6)

    @property
    def positions(self) -> Float[np.ndarray, "images 3 3"]:
        """A priori covariance of each projection centre (m^2)."""
        n = self.n_images
        matrix = np.asarray(self.matrix)[: 6 * n, : 6 * n].reshape(n, 6, n, 6)
        return matrix[np.arange(n), :3, np.arange(n), :3]

    @property
    def shared_sigma(self) -> Float[ArrayLike, "shared"]:
        """A posteriori standard deviations of the shared unknowns, in the order of the last `labels`."""
        return self._sigma(self.matrix.diagonal())[6 * self.n_images :]

    @property
    def point_sigma(self) -> Float[ArrayLike, "points 3"]:
        """A posteriori standard deviations of the object points (m)."""
        return self._sigma(self.points.diagonal(axis1=1, axis2=2))

    def of_interior(self, camera: str, parameters: Sequence[str]) -> Float[np.ndarray, "parameters parameters"]:
        """Return the a posteriori covariance of a camera's interior orientation by `parameters`; zero if fixed."""
        first, prefix = 6 * self.n_images, f"interior[{camera}]."
        index = {
            label.removeprefix(prefix): first + k
            for k, label in enumerate(self.labels[first:])
            if label.startswith(prefix)
        }
        parameters = [table_name(name) for name in parameters]
        free = [k for k, name in enumerate(parameters) if name in index]
        columns = [index[parameters[k]] for k in free]
        covariance = np.zeros((len(parameters), len(parameters)))
        covariance[np.ix_(free, free)] = np.asarray(self.matrix)[np.ix_(columns, columns)] * float(self.variance_factor)
        return covariance

    def _sigma(self, variance: ArrayLike) -> Any:
        xp = jnp if isinstance(variance * self.variance_factor, jax.Array) else np
        # Clip the variance of fixed unknowns, which is zero or slightly negative by rounding. NaN stays NaN.
        # Apply `where` twice: the square root has no derivative at zero.
        fixed = variance <= 0
        return xp.where(fixed, 0.0, xp.sqrt(xp.where(fixed, 1.0, variance) * self.variance_factor))


def covariance(adjusted: Adjustment, rotations: Rotations = "omega_phi_kappa", *, rows: bool = False) -> Covariance:
    """Compute the covariance of exterior orientations, shared unknowns and points.

    `rotations` selects the rotations of the exterior rows: omega, phi, kappa; small rotations about the axes of the
    object frame; or small rotations about the camera axes. `rows` stores the row cofactors for `redundancy_numbers`,
    which otherwise recomputes them.
    """
    if rotations not in EOP_NAMES:
        raise ValueError(f"rotations must be one of {', '.join(EOP_NAMES)}, got {rotations!r}")
    cofactors, matrix, points, rows_cofactors = _run(adjusted, rotations, with_rows=rows)
    labels = [f"exterior[{i}].{n}" for i in adjusted.block.images for n in EOP_NAMES[rotations]]
    return Covariance(
        matrix=adjusted.padded.crop_reduced(matrix),
        points=to_numpy(points)[adjusted.padded.places.point],
        variance_factor=adjusted.sigma0**2,
        cofactors=cofactors,
        rows=rows_cofactors,
        labels=(*labels, *adjusted.structure.labels),
        n_images=adjusted.structure.n_images,
        rotations=rotations,
        converged=to_numpy(adjusted.converged),
    )


def prepare_covariance(equations: NormalEquations, seconds: dict[str, float]) -> None:
    """Compile the program of `covariance` in the background."""
    prepare(_covariance, (equations, "omega_phi_kappa", True), seconds)


def row_cofactors(adjusted: Adjustment, rotations: Rotations) -> RowCofactors:
    """Compute J Q J' of the rows that are eliminated with their points, by the compiled program of `covariance`."""
    return _run(adjusted, rotations, with_rows=True)[3]


def _run(adjusted: Adjustment, rotations: Rotations, with_rows: bool):
    arguments = adjusted.equations, rotations, with_rows
    return gathered(run_compiled(_covariance, arguments, adjusted.seconds, "covariance"))


@eqx.filter_jit
def _covariance(
    equations: NormalEquations, rotations: Rotations, with_rows: bool
) -> tuple[Cofactors, Array, Array, RowCofactors | None]:
    """Compute cofactors, covariances in the units of the unknowns and, if requested, J Q J' of the rows."""
    q, rows = equations.cofactors(with_rows)
    return q, *physical_covariance(q, equations.scale, equations.values.rotation, rotations), rows


def physical_covariance(q: Cofactors, scale: Increments, rotation: Float[Array, "3 3 images"], rotations: Rotations):
    """Return the covariances of the reduced unknowns and of the points (3 x 3 each), in m, rad, mm and own units."""
    n = rotation.shape[2]
    factors = jnp.concatenate([scale.eop.T.reshape(-1), scale.shared])
    matrix = q.reduced * factors[:, None] * factors[None, :]

    jacobians = rotation_jacobians(rotation, rotations)
    blocks = matrix[: 6 * n].reshape(n, 2, 3, -1)
    blocks = jnp.stack([blocks[:, 0], jnp.einsum("nij,njk->nik", jacobians, blocks[:, 1])], axis=1)
    rows = jnp.concatenate([blocks.reshape(6 * n, -1), matrix[6 * n :]]).T
    blocks = rows[: 6 * n].reshape(n, 2, 3, -1)
    blocks = jnp.stack([blocks[:, 0], jnp.einsum("nij,njk->nik", jacobians, blocks[:, 1])], axis=1)
    matrix = jnp.concatenate([blocks.reshape(6 * n, -1), rows[6 * n :]])
    points = q.points * scale.points.T[:, :, None] * scale.points.T[:, None, :]
    return matrix, points


def rotation_jacobians(rotation: Float[Array, "3 3 images"], rotations: Rotations) -> Float[Array, "images 3 3"]:
    """Return the derivatives of the `rotations` (rad) of each image by its small rotation in the camera frame (rad)."""

    def jacobian(camera_from_object):
        if rotations == "camera":
            return jnp.eye(3)
        if rotations == "object":
            return camera_from_object.T
        angles = lambda theta: omega_phi_kappa_from_matrix(small_rotation(theta) @ camera_from_object)  # noqa: E731
        return jax.jacfwd(angles)(jnp.zeros(3))

    return jax.vmap(jacobian, in_axes=2)(rotation)


Weights = dict[tuple[str, str, int], Float[np.ndarray, "parameters"]]
"""Weights w of the parameters by group, row label and count of repeated labels."""


def common_covariance(
    first: Adjustment, second: Adjustment, camera: str, parameters: Sequence[str]
) -> Float[np.ndarray, "parameters parameters"]:
    """Compute the a priori covariance of the interior orientations of `camera` in adjustments without common images.

    Rows are `parameters` of the first adjustment, columns `parameters` of the second, in their own units. Elements are
    zero for fixed parameters and for adjustments without common observations.
    """
    first_weights, second_weights = (_weights(adjusted, camera, parameters) for adjusted in (first, second))
    covariance = np.zeros((len(parameters), len(parameters)))
    for row in first_weights.keys() & second_weights.keys():
        covariance += np.outer(first_weights[row], second_weights[row])
    return covariance


def _weights(adjusted: Adjustment, camera: str, parameters: Sequence[str]) -> Weights:
    """Return the weights w of the parameters for every observation that involves no image."""
    labels = _labels(adjusted)
    if not labels:
        return {}
    index = {label: k for k, label in enumerate(adjusted.structure.labels)}
    columns = np.array([index.get(f"interior[{camera}].{name}", -1) for name in parameters])
    free = np.flatnonzero(columns >= 0)
    arguments = adjusted.equations.on_one_device, columns.astype(np.int32)[free]
    padded = run_compiled(_influences, arguments, adjusted.seconds, "covariance")
    influences = [adjusted.padded.crop_residuals(jax.tree.map(lambda v: v[k], padded)) for k in range(len(free))]  # noqa: B023
    weights: Weights = {}
    for group, names in labels.items():
        w = np.zeros((len(parameters), len(names)))
        w[free] = [np.ravel(influence[group]) for influence in influences]
        counts: dict[str, int] = {}
        for column, name in enumerate(names):
            counts[name] = counts.get(name, 0) + 1
            weights[group, name, counts[name]] = w[:, column]
    return weights


def _labels(adjusted: Adjustment) -> dict[str, list[str]]:
    """Return the labels of all observations that involve no image; they are equal in all parts of a block."""
    block = adjusted.block
    observed, labels = observed_in(block, adjusted.priors), {}
    parameters = [entry.label for entry in observed.entries]
    for group, rows in observed.named:
        indices = {kind: np.asarray(index) for kind, index in rows.indices()}
        if "image" in indices:
            continue
        if "parameter" in indices:
            labels[group] = [parameters[k] for k in indices["parameter"].ravel()]
        else:
            shape = np.shape(adjusted.residuals[group])
            labels[group] = list(np.broadcast_to(rows.words(block.images, block.points), shape).ravel())
    return labels


@eqx.filter_jit
def _influences(equations: NormalEquations, shared: Int[Array, "parameters"]) -> PaddedResiduals:
    """Compute J N^-1 e of some shared unknowns, in their own units, along a leading axis."""
    at = equations.at
    _, j_product = jax.linearize(lambda y: at._replace(increments=y).residuals(), at.increments)
    zero = jax.tree.map(jnp.zeros_like, at.increments)

    def influence(k):
        unit = zero.shared.at[k].set(equations.scale.shared[k])
        return j_product(equations.solve(eqx.tree_at(lambda y: y.shared, zero, unit)))

    return jax.lax.map(influence, shared)
