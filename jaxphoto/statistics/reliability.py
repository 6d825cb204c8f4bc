"""Redundancy numbers and normalised residuals: how well each observation is checked by the others.

r = 1 - diag(J Q J') in units of the a priori sigma; the redundancy numbers of a block sum to its redundancy. The
normalised residual is w = v / (sigma0 sigma sqrt(r)), to be compared with the critical value of a blunder test.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment, NormalEquations
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS, Residuals
from jaxphoto.arrays import Numbers, still
from jaxphoto.compiling import prepare, run_compiled
from jaxphoto.observations import Correlated
from jaxphoto.short_repr import shown
from jaxphoto.statistics.covariance import (
    Cofactors,
    Covariance,
    RowCofactors,
    prepare_covariance,
    row_cofactors,
)
from jaxphoto.statistics.discrepancy import observation_groups

LEAST_CHECKED = 0.01
"""Redundancy number below which a normalised residual is mostly rounding and judges nothing."""
UNCHECKED = 1e-6
"""Redundancy number below which an observation is not checked at all: it has no normalised residual."""


def prepare_statistics(equations: NormalEquations, seconds: dict[str, float]) -> None:
    """Have what `covariance` and `redundancy_numbers` need compiled in the background; see `solve`."""
    if jax.process_count() > 1:
        # What comes from several processes is of types of its own.
        return
    prepare_covariance(equations, seconds)
    s, v = equations.structure, equations.values
    n = 6 * s.n_images + s.n_shared
    at_points = ((g.components, g.components, *np.shape(jax.tree.leaves(g.own)[0])[-2:]) for g in s.with_shared)
    batches, _, *slots = v.xy.shape
    shapes = (n, n), (s.n_points, 3, 3), (batches, 3, *slots), *at_points
    reduced, points, image, *others = (np.broadcast_to(0.0, shape) for shape in shapes)
    cofactors, rows = (reduced, points), RowCofactors(image, tuple(others))  # type: ignore[arg-type]
    prepare(_row_variances, (equations, Cofactors._make(cofactors), rows), seconds)


@shown
class Redundancy(eqx.Module):
    """Redundancy numbers, shaped like `Adjustment.residuals`; they sum to the redundancy."""

    numbers: Residuals
    blocks: dict[str, Float[np.ndarray, "_ _ _"]]
    """I - J Q J' (rows, c, c) of the whitened numbers of each row, by group."""

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
    of_rows = row_cofactors(adjusted, covariance.rotations) if covariance.rows is None else covariance.rows
    arguments = (adjusted.equations, covariance.cofactors, of_rows)
    image, others = run_compiled(_row_variances, arguments, adjusted.seconds, "covariance")
    groups, found = observation_groups(adjusted), []
    blocks: dict[str, np.ndarray] = {}
    for g, v in zip(adjusted.structure.observed, others, strict=True):
        c, rows = g.components, groups[g.name]
        flat = still(v).reshape(c * c, *np.shape(v)[2:])
        seen = adjusted.padded.crop_rows(dataclasses.replace(g, scalar=False), flat)
        block = np.eye(c) - seen.reshape(c, c, -1).transpose(2, 0, 1)
        numbers = np.diagonal(block, axis1=1, axis2=2).T
        blocks[g.name] = block
        if isinstance(rows, Correlated):
            w = np.asarray(rows.whitener)
            numbers = np.einsum("nij,njk,nki->in", np.linalg.inv(w), block, w)
        found.append(numbers[0] if g.scalar else numbers)
    whole = dataclasses.replace(adjusted.residuals, others=tuple(found), datum=np.zeros(adjusted.n_constraints))
    x, y, both = adjusted.padded.crop_image(image)
    blocks = {IMAGE_POINTS: np.eye(2) - np.array([[x, both], [both, y]]).transpose(2, 0, 1), **blocks}
    return Redundancy(dataclasses.replace(whole, image=1 - np.stack([x, y])), blocks)


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
        checked = r > UNCHECKED
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
def _row_variances(equations: NormalEquations, q: Cofactors, of_rows: RowCofactors) -> tuple[Array, tuple[Array, ...]]:
    return equations.row_variances(q, of_rows)
