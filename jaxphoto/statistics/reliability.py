"""Redundancy numbers and normalised residuals: how well each observation is checked by the others.

r = 1 - diag(J Q J') in units of the a priori sigma; the redundancy numbers of a block sum to its redundancy. The
normalised residual is w = v / (sigma0 sigma sqrt(r)), to be compared with the critical value of a blunder test.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.elimination import solve_factored
from jaxphoto.adjustment.groups import AtPoints, Group
from jaxphoto.adjustment.normal import At, dot
from jaxphoto.adjustment.optimum import weigh_datum
from jaxphoto.adjustment.other_rows import other_rows
from jaxphoto.adjustment.padded_groups import crop_rows
from jaxphoto.adjustment.padding import crop_image
from jaxphoto.adjustment.residuals import Increments, Residuals, Values
from jaxphoto.adjustment.result import Factored, Padded
from jaxphoto.adjustment.rows import RowJacobian, reduced_places
from jaxphoto.adjustment.shards import on_one_device
from jaxphoto.adjustment.structure import Structure
from jaxphoto.arrays import Numbers, still
from jaxphoto.compiling import prepare, run_compiled
from jaxphoto.observations import Correlated
from jaxphoto.statistics.covariance import (
    Cofactors,
    Covariance,
    RowCofactors,
    prepare_covariance,
    row_cofactors,
    with_shared,
)
from jaxphoto.statistics.discrepancy import observation_groups

LEAST_CHECKED = 0.01
"""Redundancy number below which a normalised residual is mostly rounding and judges nothing."""
# Below this redundancy number an observation is not checked at all: no normalised residual is given.
_UNCHECKED = 1e-6


def prepare_statistics(padded: Padded, seconds: dict[str, float]) -> None:
    """Have what `covariance` and `redundancy_numbers` need compiled in the background; see `solve`."""
    if jax.process_count() > 1:
        # What comes from several processes is of types of its own.
        return
    prepare_covariance(padded, seconds)
    s, n = padded.structure, 6 * padded.structure.n_images + padded.structure.n_shared
    v = padded.values
    at_points = ((g.components, g.components, *np.shape(jax.tree.leaves(g.own)[0])[-2:]) for g in with_shared(s))
    shapes = (n, n), (s.n_points, 3, 3), v.xy.shape, *at_points
    reduced, points, image, *others = (np.broadcast_to(0.0, shape) for shape in shapes)
    cofactors, rows = (reduced, points), RowCofactors(image, tuple(others))  # type: ignore[arg-type]
    prepare(_row_variances, (v, Cofactors._make(cofactors), rows, padded.factored, s), seconds)


class Redundancy(eqx.Module):
    """Redundancy numbers, shaped like `Adjustment.residuals`; they sum to the redundancy."""

    numbers: Residuals
    blocks: dict[str, Float[np.ndarray, "rows c c"]]
    """I - J Q J' of the whitened numbers of each row, for groups whose rows are correlated within themselves."""

    @property
    def image(self) -> Float[Numbers, "2 rows"]:
        """Of the image rows."""
        return self.numbers.image

    @property
    def named(self) -> dict[str, Float[Numbers, "..."]]:
        """By the names of their groups."""
        return self.numbers.named

    def __getitem__(self, name: str) -> Float[Numbers, "..."]:
        return self.numbers[name]


def redundancy_numbers(adjusted: Adjustment, covariance: Covariance) -> Redundancy:
    """Redundancy number of every observation.

    Of correlated observations it is the diagonal of Q_vv P, which sums to the redundancy, too.
    """
    padded = adjusted.computed
    of_rows = row_cofactors(adjusted, covariance.rotations)
    arguments = (padded.values, covariance.cofactors, of_rows, padded.factored, padded.structure)
    image, others = run_compiled(_row_variances, arguments, adjusted.seconds, "covariance")
    groups, found = observation_groups(adjusted), []
    blocks: dict[str, np.ndarray] = {}
    for g, v in zip(adjusted.structure.observed, others, strict=True):
        c, rows = g.components, groups[g.name]
        seen = crop_rows(dataclasses.replace(g, scalar=False), still(v).reshape(c * c, *np.shape(v)[2:]), padded.places)
        block = np.eye(c) - seen.reshape(c, c, -1).transpose(2, 0, 1)
        numbers = np.diagonal(block, axis1=1, axis2=2).T
        if isinstance(rows, Correlated):
            blocks[g.name], w = block, np.asarray(rows.whitener)
            numbers = np.einsum("nij,njk,nki->in", np.linalg.inv(w), block, w)
        found.append(numbers[0] if g.scalar else numbers)
    whole = dataclasses.replace(adjusted.residuals, others=tuple(found), datum=np.zeros(adjusted.n_constraints))
    image = crop_image(1 - still(image), padded.places)
    return Redundancy(dataclasses.replace(whole, image=image), blocks)


def normalised_residuals(adjusted: Adjustment, redundancy: Redundancy) -> Residuals:
    """w = v / (sigma0 sigma sqrt(r)) of every observation; NaN where nothing checks it.

    Of correlated observations w = (P v) / (sigma0 sqrt(diag P Q_vv P)), which says the same of an error in one of them.
    """
    sigma0, precision = float(adjusted.sigma0), error_precision(adjusted, redundancy)

    def w(name, rows, v):
        v, r = np.asarray(v), np.asarray(redundancy[name])
        if isinstance(rows, Correlated):
            # P v = L'^-1 of the whitened residuals L^-1 v.
            weighed = np.einsum("nji,jn->in", np.asarray(rows.whitener), v.reshape(rows.covariance.shape[1], -1))
            weighed = weighed.reshape(v.shape)
        else:
            weighed = v / np.asarray(rows.sigmas).T
        checked = r > _UNCHECKED
        return np.where(checked, weighed / (sigma0 * np.sqrt(np.where(checked, precision[name], 1.0))), np.nan)

    groups, residuals = observation_groups(adjusted), adjusted.residuals.named
    image, *others = (w(name, groups[name], v) for name, v in residuals.items())
    return dataclasses.replace(adjusted.residuals, image=image, others=tuple(others))


def error_precision(adjusted: Adjustment, redundancy: Redundancy) -> dict[str, Float[np.ndarray, "..."]]:
    """diag P Q_vv P by group, in one over the observation's unit squared: how well an error in it alone is determined.

    r / sigma^2 where observations are not correlated.
    """
    found = {}
    for name, rows in observation_groups(adjusted).items():
        r = np.asarray(redundancy[name])
        if isinstance(rows, Correlated):
            p = np.asarray(rows.whitener)
            found[name] = np.einsum("nji,njk,nki->in", p, redundancy.blocks[name], p).reshape(r.shape)
        else:
            found[name] = r / np.asarray(rows.sigmas).T ** 2
    return found


@eqx.filter_jit
def _row_variances(
    values: Values, q: Cofactors, of_rows: RowCofactors, factored: Factored, s: Structure
) -> tuple[Array, tuple[Array, ...]]:
    """J Q J' of image rows, and of the numbers of each other row with one another (c, c, ...)."""
    scale, s = factored.scale, on_one_device(s)
    at = At(jax.tree.map(jnp.zeros_like, scale), scale, weigh_datum(values, s), s)
    rest = other_rows(at)
    at_points, found = iter(of_rows.at_points), []
    for g, j in zip(s.observed, rest.jacobians, strict=True):
        if isinstance(g.rows, AtPoints):
            own = jnp.einsum("carp,pab,dbrp->cdrp", j.points[:, 0], q.points, j.points[:, 0])
            found.append(next(at_points) if g.place else own)
        elif g.layout == "reduced":
            found.append(_of_reduced(g, j, q.reduced, s))
        else:
            found.append(_of_coupled(g, j, at, factored))
    return of_rows.image, tuple(found)


def _of_reduced(g: Group, j: RowJacobian, q: Array, s: Structure) -> Float[Array, "c c rows"]:
    touched = reduced_places(g, s.n_images).T
    own = jnp.concatenate([j.eop.reshape(g.components, -1, g.n_rows), j.shared], axis=1)
    # What means no unknown lies behind the last.
    met = q.at[touched[:, :, None], touched[:, None]].get(mode="fill", fill_value=0.0)
    seen = jnp.einsum("nab,dbn->dan", met, own)
    return jnp.einsum("can,dan->cdn", own, seen)


def _of_coupled(g: Group, j: RowJacobian, at: At, factored: Factored) -> Float[Array, "c c rows"]:
    """By one solve for each number: they join what never met otherwise."""
    s, zero = at.structure, at.increments

    def whole(k, c) -> Increments:
        y = zero
        for n, image in enumerate(g.image):
            y = y._replace(eop=y.eop.at[:, jnp.asarray(image)[k]].add(j.eop[c, n, :, k]))
        for n, column in enumerate(g.column):
            y = y._replace(shared=y.shared.at[jnp.asarray(column)[k]].add(j.shared[c, n, k], mode="drop"))
        for n, point in enumerate(g.point):
            y = y._replace(points=y.points.at[:, jnp.asarray(point)[k]].add(j.points[c, n, :, k]))
        return y

    def one(at_number):
        k, c = at_number
        x = solve_factored(factored.reduced, factored.factor, whole(k, c), at)
        return jnp.stack([dot(whole(k, d), x, s) for d in range(g.components)])

    each = jnp.meshgrid(jnp.arange(g.n_rows), jnp.arange(g.components), indexing="ij")
    found = jax.lax.map(one, tuple(v.reshape(-1) for v in each))
    return found.reshape(g.n_rows, g.components, g.components).transpose(1, 2, 0)
