"""Covariances of all unknowns, in their own units, from the cofactors of the normal equations.

How far two adjustments err together, because both of them use some of the same observations.

Two halves of a block have no image in common, but control, distances and what is known beforehand are in both. To first
order an estimate errs by -w'e, e being the errors of the observations over their standard deviations and w = J N^-1 e_p
its weights; so two estimates have the covariance w1'w2, taken over the rows that are in both.
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
from jaxphoto.arrays import Numbers, gathered, still
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

    `matrix` is of the exterior orientations (6 an image, in the block's order: X, Y, Z, then three rotations of the
    kind `rotations`) followed by the shared unknowns. Fixed unknowns have zero rows. Multiply by `variance_factor`
    for a posteriori values.
    """

    matrix: Float[Numbers, "reduced reduced"]
    points: Float[Numbers, "points 3 3"]
    variance_factor: Float[Numbers, ""] | float
    cofactors: Cofactors
    """In padded sizes, see `Adjustment.padded`."""
    rows: RowCofactors | None
    """j Q j' of observations, likewise, where they were asked for."""
    labels: tuple[str, ...] = eqx.field(static=True)
    n_images: int = eqx.field(static=True)
    rotations: Rotations = eqx.field(static=True)
    converged: Bool[Numbers, ""]
    """Else it is that of where the adjustment stopped, and says nothing of how near the truth that is."""

    def __repr__(self) -> str:
        # Anything may stand for an array while JAX maps over it.
        if np.ndim(self.converged) or not isinstance(self.converged, bool | np.generic | np.ndarray):
            return "Covariance inside a transformation of JAX: its numbers are arrays"
        of = f"{counted(self.n_images, 'image')}, {counted(len(self.points), 'point')}"
        shared = counted(len(self.labels) - 6 * self.n_images, "shared unknown")
        where = "" if self.converged else ";\n  not converged: of where the adjustment stopped, no standard deviations"
        return f"Covariance of {of} and {shared}, a priori; variance factor {float(self.variance_factor):.4g}{where}"

    _repr_html_ = fields_html

    @property
    def exterior_sigma(self) -> Float[Numbers, "images 6"]:
        """A posteriori standard deviations of X, Y, Z (m) and the rotations (rad), by image."""
        return self._sigma(self.matrix.diagonal())[: 6 * self.n_images].reshape(-1, 6)

    @property
    def positions(self) -> Float[np.ndarray, "images 3 3"]:
        """A priori covariance of each projection centre (m^2)."""
        n = self.n_images
        own = np.asarray(self.matrix)[: 6 * n, : 6 * n].reshape(n, 6, n, 6)
        return own[np.arange(n), :3, np.arange(n), :3]

    @property
    def shared_sigma(self) -> Float[Numbers, "shared"]:
        """A posteriori standard deviations of the shared unknowns, in the order of `labels`' end."""
        return self._sigma(self.matrix.diagonal())[6 * self.n_images :]

    @property
    def point_sigma(self) -> Float[Numbers, "points 3"]:
        """A posteriori standard deviations of the object points (m)."""
        return self._sigma(self.points.diagonal(axis1=1, axis2=2))

    def of_interior(self, camera: str, parameters: Sequence[str]) -> Float[np.ndarray, "parameters parameters"]:
        """A posteriori covariance of a camera's interior orientation in the order of `parameters`; zero where held."""
        first, own = 6 * self.n_images, f"interior[{camera}]."
        place = {
            label.removeprefix(own): first + k for k, label in enumerate(self.labels[first:]) if label.startswith(own)
        }
        which = [k for k, name in enumerate(parameters) if name in place]
        where = [place[parameters[k]] for k in which]
        found = np.zeros((len(parameters), len(parameters)))
        found[np.ix_(which, which)] = np.asarray(self.matrix)[np.ix_(where, where)] * float(self.variance_factor)
        return found

    def _sigma(self, variance: Numbers) -> Any:
        xp = jnp if isinstance(variance * self.variance_factor, jax.Array) else np
        # What is held comes out as zero or, by rounding, on either side of it. What is no number stays none.
        # Double where: the root of zero has no derivative.
        held = variance <= 0
        return xp.where(held, 0.0, xp.sqrt(xp.where(held, 1.0, variance) * self.variance_factor))


def covariance(adjusted: Adjustment, rotations: Rotations = "omega_phi_kappa", *, rows: bool = False) -> Covariance:
    """Covariance of exterior orientations, shared unknowns and points.

    `rotations` says which rotations the exterior rows mean: omega, phi, kappa; small rotations about the axes of the
    object frame; or about those of the camera. With `rows` it holds what `redundancy_numbers` wants, which
    then need not compute it all again.
    """
    if rotations not in EOP_NAMES:
        raise ValueError(f"rotations is one of {', '.join(EOP_NAMES)}, got {rotations!r}")
    cofactors, matrix, points, of_rows = _run(adjusted, rotations, of_rows=rows)
    labels = [f"exterior[{i}].{n}" for i in adjusted.block.images for n in EOP_NAMES[rotations]]
    return Covariance(
        matrix=adjusted.padded.crop_reduced(matrix),
        points=still(points)[adjusted.padded.places.point],
        variance_factor=adjusted.sigma0**2,
        cofactors=cofactors,
        rows=of_rows,
        labels=(*labels, *adjusted.structure.labels),
        n_images=adjusted.structure.n_images,
        rotations=rotations,
        converged=still(adjusted.converged),
    )


def prepare_covariance(equations: NormalEquations, seconds: dict[str, float]) -> None:
    """Have what `covariance` needs compiled in the background."""
    prepare(_covariance, (equations, "omega_phi_kappa", True), seconds)


def row_cofactors(adjusted: Adjustment, rotations: Rotations) -> RowCofactors:
    """j Q j' of rows that are computed with their points, by the program that `covariance` has run with `rotations`."""
    return _run(adjusted, rotations, of_rows=True)[3]


def _run(adjusted: Adjustment, rotations: Rotations, of_rows: bool):
    given = adjusted.equations, rotations, of_rows
    return gathered(run_compiled(_covariance, given, adjusted.seconds, "covariance"))


@eqx.filter_jit
def _covariance(
    equations: NormalEquations, rotations: Rotations, of_rows: bool
) -> tuple[Cofactors, Array, Array, RowCofactors | None]:
    """Cofactors; the same in units of the unknowns; and j Q j' of rows if these are wanted."""
    q, rows = equations.cofactors(of_rows)
    return q, *in_units(q, equations.scale, equations.values.rotation, rotations), rows


def in_units(q: Cofactors, scale: Increments, rotation: Float[Array, "3 3 images"], rotations: Rotations):
    """Covariances of reduced unknowns and of points (3 x 3 each), in metres, radians and the unknowns' own units."""
    n = rotation.shape[2]
    factors = jnp.concatenate([scale.eop.T.reshape(-1), scale.shared])
    matrix = q.reduced * factors[:, None] * factors[None, :]

    turns = turns_of(rotation, rotations)
    blocks = matrix[: 6 * n].reshape(n, 2, 3, -1)
    blocks = jnp.stack([blocks[:, 0], jnp.einsum("nij,njk->nik", turns, blocks[:, 1])], axis=1)
    rows = jnp.concatenate([blocks.reshape(6 * n, -1), matrix[6 * n :]]).T
    blocks = rows[: 6 * n].reshape(n, 2, 3, -1)
    blocks = jnp.stack([blocks[:, 0], jnp.einsum("nij,njk->nik", turns, blocks[:, 1])], axis=1)
    matrix = jnp.concatenate([blocks.reshape(6 * n, -1), rows[6 * n :]])
    points = q.points * scale.points.T[:, :, None] * scale.points.T[:, None, :]
    return matrix, points


def turns_of(rotation: Float[Array, "3 3 images"], rotations: Rotations) -> Float[Array, "images 3 3"]:
    """What takes an image's small rotation in the camera frame (rad) to the change of its three `rotations` (rad)."""

    def turn(camera_from_object):
        if rotations == "camera":
            return jnp.eye(3)
        if rotations == "object":
            return camera_from_object.T
        angles = lambda theta: omega_phi_kappa_from_matrix(small_rotation(theta) @ camera_from_object)  # noqa: E731
        return jax.jacfwd(angles)(jnp.zeros(3))

    return jax.vmap(turn, in_axes=2)(rotation)


Weights = dict[tuple[str, str, int], Float[np.ndarray, "parameters"]]
"""By group, what the row is called, and a number where several are called the same."""


def common_covariance(
    first: Adjustment, second: Adjustment, camera: str, parameters: Sequence[str]
) -> Float[np.ndarray, "parameters parameters"]:
    """A priori covariance of the interior orientation of `camera` in two adjustments that have no image in common.

    Rows are `parameters` of the first, columns those of the second, in their own units; zero where they are held, and
    everywhere where the adjustments share no observation.
    """
    one, other = (_weights(adjusted, camera, parameters) for adjusted in (first, second))
    found = np.zeros((len(parameters), len(parameters)))
    for row in one.keys() & other.keys():
        found += np.outer(one[row], other[row])
    return found


def _weights(adjusted: Adjustment, camera: str, parameters: Sequence[str]) -> Weights:
    """w of the parameters, of every observed number that touches no image."""
    called = _called(adjusted)
    if not called:
        return {}
    place = {label: k for k, label in enumerate(adjusted.structure.labels)}
    own = [place.get(f"interior[{camera}].{name}", -1) for name in parameters]
    free = np.flatnonzero(np.array(own) >= 0)
    which = np.array(own, np.int32)[free]
    seen = run_compiled(_influences, (adjusted.equations.on_one_device, which), adjusted.seconds, "covariance")
    found: Weights = {}
    each = [adjusted.padded.crop_residuals(jax.tree.map(lambda v: v[k], seen)) for k in range(len(free))]  # noqa: B023
    for group, names in called.items():
        w = np.zeros((len(parameters), len(names)))
        w[free] = [np.ravel(one[group]) for one in each]
        taken: dict[str, int] = {}
        for column, name in enumerate(names):
            number = taken[name] = taken.get(name, 0) + 1
            found[group, name, number] = w[:, column]
    return found


def _called(adjusted: Adjustment) -> dict[str, list[str]]:
    """By group that touches no image, what each observed number is called, whichever part of the block it is in."""
    block = adjusted.block
    observed, found = observed_in(block, adjusted.priors), {}
    labels = [entry.label for entry in observed.entries]
    for group, rows in observed.named:
        touched = {what: np.asarray(index) for what, index in rows.indices()}
        if "image" in touched:
            continue
        if "parameter" in touched:
            found[group] = [labels[k] for k in touched["parameter"].ravel()]
        else:
            shape = np.shape(adjusted.residuals[group])
            found[group] = list(np.broadcast_to(rows.words(block.images, block.points), shape).ravel())
    return found


@eqx.filter_jit
def _influences(equations: NormalEquations, which: Int[Array, "parameters"]) -> PaddedResiduals:
    """J N^-1 e of some shared unknowns, in their own units, along a leading axis."""
    at = equations.at
    _, moved = jax.linearize(lambda y: at._replace(increments=y).residuals(), at.increments)
    nothing = jax.tree.map(jnp.zeros_like, at.increments)

    def of_one(k):
        unit = nothing.shared.at[k].set(equations.scale.shared[k])
        return moved(equations.solve(eqx.tree_at(lambda y: y.shared, nothing, unit)))

    return jax.lax.map(of_one, which)
