"""Cofactors and covariances of all unknowns, from the factor of the reduced normal matrix.

With S~ = [S g; g' -K] the reduced matrix bordered by the few rows that couple points (see adjustment/normal.py) and
W~ = [W; Ws; D] what a point p meets,

    Q~    = S~^-1                            exterior and interior orientation, mounts, strips
    Q_pr  = -V^-1 W~' Q~                     points with the former, only where they met
    Q_pp  = V^-1 - Q_pr W~ V^-1              3 x 3 a point

The full matrix is never inverted. In a free network the part along the open motions, which the constraints of the
datum hold, is subtracted: what remains is the covariance under inner (or minimal) constraints.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.normal import solve_3x3, solve_factored
from jaxphoto.adjustment.padding import crop_reduced
from jaxphoto.adjustment.residuals import Increments
from jaxphoto.adjustment.result import Factored
from jaxphoto.adjustment.structure import Structure
from jaxphoto.arrays import Numbers
from jaxphoto.compiling import run_compiled
from jaxphoto.rotation import omega_phi_kappa_from_matrix, small_rotation

Rotations = Literal["omega_phi_kappa", "object", "camera"]
EOP_NAMES: dict[str, tuple[str, ...]] = {
    "omega_phi_kappa": ("X", "Y", "Z", "omega", "phi", "kappa"),
    "object": ("X", "Y", "Z", "rX", "rY", "rZ"),
    "camera": ("X", "Y", "Z", "rx", "ry", "rz"),
}


class Cofactors(NamedTuple):
    """Cofactors in scaled increments: reduced unknowns, points, and points with what they met."""

    reduced: Float[Array, "reduced reduced"]
    points: Float[Array, "points 3 3"]
    point_eop: Float[Array, "rows 3 6"]
    """Of each image row's point with its image."""
    point_shared: Float[Array, "points 3 shared"]


class Covariance(eqx.Module):
    """A priori covariances (sigma naught 1), in metres, radians, mm and the coefficients' own units.

    `matrix` is of the exterior orientations (6 an image, in the block's order: X, Y, Z, then three rotations of the
    kind `rotations`) followed by the shared unknowns. Fixed unknowns have zero rows. Multiply by `variance_factor`
    for a posteriori values.
    """

    matrix: Float[np.ndarray, "reduced reduced"]
    points: Float[np.ndarray, "points 3 3"]
    variance_factor: Float[Numbers, ""]
    cofactors: Cofactors
    """In the sizes of `Adjustment.padded`."""
    labels: tuple[str, ...] = eqx.field(static=True)
    n_images: int = eqx.field(static=True)
    rotations: Rotations = eqx.field(static=True)

    @property
    def exterior_sigma(self) -> Float[Array, "images 6"]:
        """A posteriori standard deviations of X, Y, Z (m) and the rotations (rad), by image."""
        return self._sigma(jnp.diagonal(self.matrix))[: 6 * self.n_images].reshape(-1, 6)

    @property
    def shared_sigma(self) -> Float[Array, "shared"]:
        """A posteriori standard deviations of the shared unknowns, in the order of `labels`' end."""
        return self._sigma(jnp.diagonal(self.matrix))[6 * self.n_images :]

    @property
    def point_sigma(self) -> Float[Array, "points 3"]:
        """A posteriori standard deviations of the object points (m)."""
        return self._sigma(jnp.diagonal(self.points, axis1=1, axis2=2))

    def _sigma(self, variance):
        return jnp.sqrt(jnp.maximum(variance, 0.0) * self.variance_factor)


def covariance(adjusted: Adjustment, rotations: Rotations = "omega_phi_kappa") -> Covariance:
    """Covariance of exterior orientations, shared unknowns and points.

    `rotations` says which rotations the exterior rows mean: omega, phi, kappa; small rotations about the axes of the
    object frame; or about those of the camera.
    """
    if rotations not in EOP_NAMES:
        raise ValueError(f"rotations is one of {', '.join(EOP_NAMES)}, got {rotations!r}")
    padded = adjusted.computed
    cofactors = run_compiled(_cofactors, (padded.factored, padded.structure), adjusted.seconds, "covariance")
    arguments = (cofactors, padded.factored.scale, padded.values.rotation, rotations)
    matrix, points = run_compiled(_physical, arguments, adjusted.seconds, "covariance")
    labels = [f"exterior[{i}].{n}" for i in adjusted.block.images for n in EOP_NAMES[rotations]]
    return Covariance(
        matrix=crop_reduced(matrix, adjusted.structure),
        points=np.asarray(points)[: adjusted.structure.n_points],
        variance_factor=adjusted.sigma0**2,
        cofactors=cofactors,
        labels=(*labels, *adjusted.structure.labels),
        n_images=adjusted.structure.n_images,
        rotations=rotations,
    )


@eqx.filter_jit
def _physical(q: Cofactors, scale: Increments, rotation: Float[Array, "3 3 images"], rotations: Rotations):
    n = rotation.shape[2]
    factors = jnp.concatenate([scale.eop.T.reshape(-1), scale.shared])
    matrix = q.reduced * factors[:, None] * factors[None, :]

    def turn(camera_from_object):
        if rotations == "camera":
            return jnp.eye(3)
        if rotations == "object":
            return camera_from_object.T
        angles = lambda theta: omega_phi_kappa_from_matrix(small_rotation(theta) @ camera_from_object)  # noqa: E731
        return jax.jacfwd(angles)(jnp.zeros(3))

    turns = jax.vmap(turn, in_axes=2)(rotation)
    blocks = matrix[: 6 * n].reshape(n, 2, 3, -1)
    blocks = jnp.stack([blocks[:, 0], jnp.einsum("nij,njk->nik", turns, blocks[:, 1])], axis=1)
    rows = jnp.concatenate([blocks.reshape(6 * n, -1), matrix[6 * n :]]).T
    blocks = rows[: 6 * n].reshape(n, 2, 3, -1)
    blocks = jnp.stack([blocks[:, 0], jnp.einsum("nij,njk->nik", turns, blocks[:, 1])], axis=1)
    matrix = jnp.concatenate([blocks.reshape(6 * n, -1), rows[6 * n :]])
    points = q.points * scale.points.T[:, :, None] * scale.points.T[:, None, :]
    return matrix, points


@eqx.filter_jit
def _cofactors(factored: Factored, structure: Structure) -> Cofactors:
    """All cofactors of one factored block; see the module's head."""
    s, normal, reduced = structure, factored.normal, factored.reduced
    n, q, k = 6 * s.n_images, s.n_shared, reduced.g.shape[1]
    inverse = jax.scipy.linalg.cho_solve((factored.lower, True), jnp.eye(n + q))
    full = inverse
    if k:
        kg = jnp.linalg.solve(reduced.k, reduced.g.T)
        low = inverse @ kg.T
        full = jnp.block([[inverse, low], [low.T, kg @ low - jnp.linalg.inv(reduced.k)]])

    # What every point meets besides its images: shared unknowns and constraints.
    border = jnp.concatenate([normal.ws, normal.rows_p]).transpose(2, 1, 0)
    w = normal.w.transpose(2, 1, 0)
    in_images = full[:n, :n].reshape(s.n_images, 6, s.n_images, 6)
    # Blocks outside the matrix are padding: what is read in their stead meets rows of zeros.
    blocks = in_images.at[s.block_row, :, s.block_column, :].get(mode="clip")[s.pair_block]
    own = jnp.where((s.pair_a == s.pair_b)[:, None, None], 0.0, 1.0)
    met = jax.ops.segment_sum(jnp.einsum("nkc,ncd->nkd", w[s.pair_a], blocks), s.pair_b, len(s.point))
    met += jax.ops.segment_sum(own * jnp.einsum("nkc,ndc->nkd", w[s.pair_b], blocks), s.pair_a, len(s.point))
    to_border = full[:n, n:].reshape(s.n_images, 6, -1)
    met += jnp.einsum("nkb,ndb->nkd", border[s.point], to_border[s.image])
    met_border = jax.ops.segment_sum(
        jnp.einsum("nkc,ncb->nkb", w, to_border[s.image]), s.point, s.n_points, indices_are_sorted=True
    )
    met_border += jnp.einsum("pkb,bc->pkc", border, full[n:, n:])
    l = reduced.l  # noqa: E741
    point_eop = -_solve(l[:, s.point], met)
    point_border = -_solve(l, met_border)
    across = jax.ops.segment_sum(jnp.einsum("nkc,njc->nkj", point_eop, w), s.point, s.n_points, indices_are_sorted=True)
    across += jnp.einsum("pkb,pjb->pkj", point_border, border)
    eye = jnp.broadcast_to(jnp.eye(3), (s.n_points, 3, 3))
    points = _solve(l, (eye - across).transpose(0, 2, 1)).transpose(0, 2, 1)

    result = Cofactors(inverse, points, point_eop, point_border[:, :, :q])
    return _without_open_motions(result, factored, structure)


def _without_open_motions(q: Cofactors, factored: Factored, s: Structure) -> Cofactors:
    """Subtract E E': what the constraints D of the datum, taken as observations, leave along the motions they hold.

    E = (N + D'D)^-1 D' spans those motions exactly, because N does not see them; no motion need be known.
    """
    defect = factored.n_constraints
    if not defect:
        return q
    normal = factored.normal
    rows = Increments(
        normal.rows_e[-defect:].transpose(0, 2, 1), jnp.zeros((defect, s.n_shared)), normal.rows_p[-defect:]
    )
    e = jax.vmap(lambda row: solve_factored(normal, factored.reduced, factored.lower, row, s))(rows)
    e_eop, e_shared, e_points = e.eop.transpose(2, 1, 0), e.shared.T, e.points.transpose(2, 1, 0)
    e_reduced = jnp.concatenate([e_eop.reshape(-1, defect), e_shared])
    return Cofactors(
        q.reduced - e_reduced @ e_reduced.T,
        q.points - jnp.einsum("pck,pdk->pcd", e_points, e_points),
        q.point_eop - jnp.einsum("nck,ndk->ncd", e_points[s.point], e_eop[s.image]),
        q.point_shared - jnp.einsum("pck,qk->pcq", e_points, e_shared),
    )


def _solve(l: Float[Array, "6 n"], b: Float[Array, "n 3 m"]) -> Float[Array, "n 3 m"]:  # noqa: E741
    """V^-1 b, column by column."""
    return jax.vmap(solve_3x3, in_axes=(None, 0), out_axes=0)(l, b.transpose(2, 1, 0)).transpose(2, 1, 0)
