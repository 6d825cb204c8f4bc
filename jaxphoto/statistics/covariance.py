"""Cofactors and covariances of all unknowns, from the factor of the reduced normal matrix.

With S~ = [S g; g' -K] the reduced matrix bordered by the few rows that couple points (see adjustment/normal.py),
V = L L' and F = [W; Ws; D] L^-T what a point p meets, whitened,

    Q~    = S~^-1                                   exterior and interior orientation, scanner, mounts, strips
    Q_pp  = L^-T (I + F' Q~ F) L^-1                 3 x 3 a point
    j Q j' = z'z + (j_r - F z)' Q~ (j_r - F z)      of an image row with columns j_r and j_p, z = L^-1 j_p'

summed tile by tile, and so of other rows by point that touch shared unknowns, too. The full matrix is never inverted.
In a free network the part along the open motions, which the constraints of the datum hold, is subtracted: what remains
is the covariance under inner (or minimal) constraints.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.band import invert_band
from jaxphoto.adjustment.elimination import over_tiles, solve_factored
from jaxphoto.adjustment.groups import AtPoints, Group
from jaxphoto.adjustment.normal import At, Reduced, unwhiten, whiten
from jaxphoto.adjustment.optimum import weigh_datum
from jaxphoto.adjustment.other_rows import OtherRows, other_rows
from jaxphoto.adjustment.padding import crop_reduced
from jaxphoto.adjustment.reduced import tile_columns
from jaxphoto.adjustment.residuals import Increments, Values
from jaxphoto.adjustment.result import Factored, Padded
from jaxphoto.adjustment.shards import TILES, along_points, gathered, on_one_device, sharded
from jaxphoto.adjustment.similarity import along_motions, open_motions
from jaxphoto.adjustment.structure import Structure
from jaxphoto.adjustment.tiles import by_point, by_tile
from jaxphoto.arrays import Numbers, still
from jaxphoto.compiling import prepare, run_compiled
from jaxphoto.rotation import omega_phi_kappa_from_matrix, small_rotation

Rotations = Literal["omega_phi_kappa", "object", "camera"]
EOP_NAMES: dict[str, tuple[str, ...]] = {
    "omega_phi_kappa": ("X", "Y", "Z", "omega", "phi", "kappa"),
    "object": ("X", "Y", "Z", "rX", "rY", "rZ"),
    "camera": ("X", "Y", "Z", "rx", "ry", "rz"),
}


class Cofactors(NamedTuple):
    """Cofactors of reduced unknowns and points, in scaled increments."""

    reduced: Float[Array, "reduced reduced"]
    points: Float[Array, "points 3 3"]


class RowCofactors(NamedTuple):
    """j Q j' of rows, in padded sizes: of the numbers of a row with one another."""

    image: Float[Array, "chunks tiles 2 m p"]
    """Of x and of y alone."""
    at_points: tuple[Float[Array, "c c rows points"], ...]
    """Of the groups of `with_shared`."""


def with_shared(s: Structure) -> tuple[Group, ...]:
    """The groups of rows by point that touch shared unknowns, too."""
    return tuple(g for g in s.observed if isinstance(g.rows, AtPoints) and g.place)


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
    """In the sizes of `Adjustment.padded`."""
    labels: tuple[str, ...] = eqx.field(static=True)
    n_images: int = eqx.field(static=True)
    rotations: Rotations = eqx.field(static=True)

    @property
    def exterior_sigma(self) -> Float[Numbers, "images 6"]:
        """A posteriori standard deviations of X, Y, Z (m) and the rotations (rad), by image."""
        return self._sigma(self.matrix.diagonal())[: 6 * self.n_images].reshape(-1, 6)

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
        # Double where: the root of what is fixed, zero, has no derivative.
        free = variance > 0
        return xp.where(free, xp.sqrt(xp.where(free, variance, 1.0) * self.variance_factor), 0.0)


def covariance(adjusted: Adjustment, rotations: Rotations = "omega_phi_kappa") -> Covariance:
    """Covariance of exterior orientations, shared unknowns and points.

    `rotations` says which rotations the exterior rows mean: omega, phi, kappa; small rotations about the axes of the
    object frame; or about those of the camera.
    """
    if rotations not in EOP_NAMES:
        raise ValueError(f"rotations is one of {', '.join(EOP_NAMES)}, got {rotations!r}")
    padded = adjusted.computed
    cofactors, matrix, points, _ = _run(adjusted, rotations, of_rows=False)
    labels = [f"exterior[{i}].{n}" for i in adjusted.block.images for n in EOP_NAMES[rotations]]
    return Covariance(
        matrix=crop_reduced(matrix, adjusted.structure, padded.places),
        points=still(points)[padded.places.point],
        variance_factor=adjusted.sigma0**2,
        cofactors=cofactors,
        labels=(*labels, *adjusted.structure.labels),
        n_images=adjusted.structure.n_images,
        rotations=rotations,
    )


def prepare_covariance(padded: Padded, seconds: dict[str, float]) -> None:
    """Have what `covariance` needs compiled in the background."""
    prepare(_covariance, _given(padded, "omega_phi_kappa", of_rows=False), seconds)


def row_cofactors(adjusted: Adjustment, rotations: Rotations) -> RowCofactors:
    """j Q j' of rows that are computed with their tiles, by the program that `covariance` has run with `rotations`."""
    return _run(adjusted, rotations, of_rows=True)[3]


def _run(adjusted: Adjustment, rotations: Rotations, of_rows: bool):
    given = _given(adjusted.computed, rotations, of_rows)
    return gathered(run_compiled(_covariance, given, adjusted.seconds, "covariance"))


def _given(padded: Padded, rotations: Rotations, of_rows: bool) -> tuple:
    return padded.values, padded.factored, padded.structure, rotations, np.array(of_rows)


@eqx.filter_jit
def _covariance(
    values: Values, factored: Factored, s: Structure, rotations: Rotations, of_rows: Bool[Numbers, ""]
) -> tuple[Cofactors, Array, Array, RowCofactors]:
    """Cofactors; the same in units of the unknowns; and j Q j' of rows, zero where they are not wanted."""
    q, rows = cofactors_of(values, factored, s, of_rows)
    return q, *in_units(q, factored.scale, values.rotation, rotations), rows


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


def cofactors_of(values: Values, factored: Factored, s: Structure, of_rows: Bool[Numbers, ""]):
    """All cofactors of one factored block, and j Q j' of its rows; see the module's head."""
    reduced = factored.reduced
    inverse = invert_band(factored.factor)
    full = inverse
    if reduced.g.shape[1]:
        kg = jnp.linalg.solve(reduced.k, reduced.g.T)
        low = inverse @ kg.T
        full = jnp.block([[inverse, low], [low.T, kg @ low - jnp.linalg.inv(reduced.k)]])
    weighed = weigh_datum(values, s)
    out = (TILES, RowCofactors(TILES, (along_points(4),) * len(with_shared(s))))
    points, rows = sharded(_of_points, s, out)(full, reduced, weighed, factored.scale, s, of_rows)
    return _without_open_motions(Cofactors(inverse, points), weighed, factored, s), rows


def _of_points(
    full: Float[Array, "n n"],
    reduced: Reduced,
    values: Values,
    scale: Increments,
    s: Structure,
    of_rows: Bool[Numbers, ""],
):
    """Cofactors of points, and j Q j' of rows."""
    at = At(jax.tree.map(jnp.zeros_like, scale), scale, values, s)
    columns_of, groups = tile_columns(at), with_shared(s)
    by_rows = _by_rows(other_rows(at), s) if groups else ()
    n, q, i, k = 6 * s.n_images, s.n_image_colours, s.n_border, len(reduced.k)
    # One more than there are: zeros serve the last row of F, and colours that mean nothing in an image.
    shared = jnp.concatenate([n + jnp.arange(i), n + s.n_shared + jnp.arange(k + 1)])

    def tile(f, image, l, by_rows, *measured):  # noqa: E741
        size = l.shape[1]
        if not s.in_tiles.free_points:
            f = jnp.zeros((len(f), 3 * size))
        index = jnp.concatenate([(6 * image[:, None] + jnp.arange(6)).reshape(-1), shared])
        own = full.at[index[:, None], index].get(mode="fill", fill_value=0.0)
        a = own @ f
        # A product of matrices would want both turned round first.
        g = jnp.sum(f.reshape(-1, 3, 1, size) * a.reshape(-1, 1, 3, size), axis=0)
        inner = jnp.eye(3)[:, :, None] + g
        half = jnp.stack(unwhiten(inner, l))
        points = jnp.stack(unwhiten(half.transpose(1, 0, 2), l)).transpose(2, 0, 1)
        none = tuple(jnp.zeros((len(j), len(j), *j.shape[2:])) for j in by_rows)
        nothing = lambda *_: (jnp.zeros((2, len(image), size)), none)  # noqa: E731
        return points, *jax.lax.cond(of_rows, rows, nothing, (image, *measured), by_rows, l, own, a, inner)

    def rows(measured, by_rows, l, own, a, inner):  # noqa: E741
        image, both = measured[0], columns_of(measured)
        m, size = both[0].residual.shape
        column = jnp.asarray(s.column)[image, :q]
        column = jnp.where(column < i, 6 * m + column, 6 * m + i + k)
        touched = jnp.concatenate([6 * jnp.arange(m)[:, None] + jnp.arange(6), column], axis=1)
        j = jnp.stack([jnp.concatenate([c.eop, c.shared]) for c in both], axis=1).transpose(2, 0, 1, 3)
        z = jnp.stack([jnp.stack(whiten(c.point, l)) for c in both]).transpose(0, 2, 1, 3)
        seen = jnp.einsum("mab,mbn->man", own[touched[:, :, None], touched[:, None, :]], j.reshape(m, 6 + q, -1))
        of_images = jnp.sum(j * seen.reshape(j.shape), axis=1).transpose(1, 0, 2)
        across = jnp.einsum("mcop,mckp->omkp", j, a[touched].reshape(m, 6 + q, 3, size))
        found = of_images - 2 * jnp.sum(z * across, axis=2) + jnp.einsum("omkp,klp,omlp->omp", z, inner, z)
        first = 6 * m
        return found, tuple(of_group(g, j, l, own, a, inner, first) for g, j in zip(groups, by_rows, strict=True))

    def of_group(g, j, l, own, a, inner, first):  # noqa: E741
        z, j = jnp.stack(whiten(j[:, :3].swapaxes(0, 1), l)), j[:, 3:]
        met = first + jnp.asarray(g.column)[:, 0]
        across = jnp.einsum("clrp,lkp->ckrp", j, a[met].reshape(len(met), 3, -1))
        shared = jnp.einsum("clrp,lm,dmrp->cdrp", j, own[met[:, None], met], j)
        both = jnp.einsum("kcrp,dkrp->cdrp", z, across)
        return shared - both - both.swapaxes(0, 1) + jnp.einsum("kcrp,klp,ldrp->cdrp", z, inner, z)

    of_points = (reduced.l, by_rows, values.points, scale.points)
    l, by_rows, *places = jax.tree.map(lambda v: by_tile(v, s.in_tiles), of_points)  # noqa: E741
    points, *found = over_tiles(tile, at, reduced, (l, by_rows, values.xy, values.sigma_xy, *places))
    return points.reshape(-1, 3, 3), RowCofactors(found[0], tuple(by_point(v) for v in found[1]))


def _by_rows(rest: OtherRows, s: Structure) -> tuple[Float[Array, "c touched rows points"], ...]:
    """Derivatives of the groups of `with_shared` by their points and by shared unknowns."""
    pairs = zip(s.observed, rest.jacobians, strict=True)
    chosen = ((g, j) for g, j in pairs if isinstance(g.rows, AtPoints) and g.place)
    shared = lambda g, j: jnp.broadcast_to(j.shared, (g.components, len(g.place), *j.shared.shape[2:]))  # noqa: E731
    return tuple(jnp.concatenate([j.points[:, 0], shared(g, j)], axis=1) for g, j in chosen)


def _without_open_motions(q: Cofactors, values: Values, factored: Factored, s: Structure) -> Cofactors:
    """Subtract E E': what the constraints D of the datum, taken as observations, leave along the motions they hold.

    E = (N + D'D)^-1 D' spans those motions exactly, because N does not see them; where all are open, they are known.
    """
    defect = factored.n_constraints
    if not defect:
        return q
    reduced, scale = factored.reduced, factored.scale
    rows = Increments(values.datum_eop * scale.eop, jnp.zeros((defect, s.n_shared)), values.datum_points * scale.points)
    if open_motions(values, s):
        # The motions are known: E = M (D M)^-1.
        m = along_motions(values, scale, on_one_device(s))
        met = jnp.einsum("kci,jci->kj", rows.eop, m.eop) + jnp.einsum("kcp,jcp->kj", rows.points, m.points)
        e = jax.tree.map(lambda v: jnp.tensordot(jnp.linalg.inv(met), v, (0, 0)), m)
    else:
        at = At(jax.tree.map(jnp.zeros_like, scale), scale, values, s)
        e = jax.vmap(lambda row: solve_factored(reduced, factored.factor, row, at))(rows)
    e_eop, e_shared, e_points = e.eop.transpose(2, 1, 0), e.shared.T, e.points.transpose(2, 1, 0)
    e_reduced = jnp.concatenate([e_eop.reshape(-1, defect), e_shared])
    return q._replace(
        reduced=q.reduced - e_reduced @ e_reduced.T, points=q.points - jnp.einsum("pck,pdk->pcd", e_points, e_points)
    )
