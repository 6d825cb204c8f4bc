"""Redundancy numbers and normalised residuals: how well each observation is checked by the others.

r = 1 - diag(J Q J') in units of the a priori sigma; the redundancy numbers of a block sum to its redundancy. The
normalised residual is w = v / (sigma0 sigma sqrt(r)), to be compared with the critical value of a blunder test.


What an error that no test finds does to the result: to c and the principal point, and at most to anything.

An error of the detectable size nabla_i in observation i alone moves unknown k by -(J N^-1 e_k)_i nabla_i / sigma_i, and
no function of the unknowns, so no point of the ground, by more than delta0 sqrt((P - P Q_vv P)_ii / (P Q_vv P)_ii) of
its standard deviations: delta0 sqrt((1 - r) / r) where observations are not correlated.

Source: Baarda (1968), A testing procedure for use in geodetic networks; Förstner (1987), Reliability analysis of
parameter estimation in linear models.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment, NormalEquations
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS, Residuals
from jaxphoto.arrays import Numbers, still
from jaxphoto.compiling import prepare, run_compiled
from jaxphoto.observations import AbstractObservations, Correlated
from jaxphoto.short_repr import shown
from jaxphoto.statistics.covariance import (
    Cofactors,
    Covariance,
    RowCofactors,
    prepare_covariance,
    row_cofactors,
)
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.hat_matrix import Responses
from jaxphoto.statistics.systematic_effects import MOST_PARTS

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


POINTED = ("c_mm", "xp_mm", "yp_mm")
"""The interior parameters that are told of."""


@shown
class UndetectedEffects(eqx.Module):
    """By group of observations, shaped like its residuals, in standard deviations of what moves; NaN: not checked."""

    interior: dict[str, dict[str, Float[np.ndarray, "..."]]]
    """By parameter of `POINTED`: that of the camera of an image row; of other rows, of the camera that moves most."""
    most: dict[str, Float[np.ndarray, "..."]]
    """What nothing moves by more than."""


@shown
class Felt(NamedTuple):
    """The observation whose undetected error moves an interior parameter most."""

    parameter: str
    """Of the camera of the image; of other rows, of the camera that it moves most."""
    words: str
    moved: float


def undetected_effects(adjusted: Adjustment, covariance: Covariance, redundancy: Redundancy) -> UndetectedEffects:
    """Of every observation."""
    groups, precision = observation_groups(adjusted), error_precision(adjusted, redundancy)
    detectable = detectable_errors(adjusted, redundancy)
    checked = {name: np.asarray(redundancy[name]) > UNCHECKED for name in groups}
    most = {}
    for name, rows in groups.items():
        p = np.where(checked[name], precision[name], 1.0)
        hidden = np.maximum(_weights(rows, p.shape) - p, 0.0)
        most[name] = np.where(checked[name], DELTA0 * np.sqrt(hidden / p), np.nan)
    variance = np.asarray(covariance.matrix).diagonal()[6 * covariance.n_images :]
    a_priori = np.sqrt(np.where(variance > 0, variance, np.nan))
    labels = {label: k for k, label in enumerate(adjusted.structure.labels)}
    cameras = adjusted.unknowns.interior if len(adjusted.unknowns.interior) <= MOST_PARTS else ()
    asked = [(c, p, labels[f"interior[{c}].{p}"]) for c in cameras for p in POINTED if f"interior[{c}].{p}" in labels]
    responses = Responses.of(adjusted)
    interior = {p: {name: np.full(np.shape(v), np.nan) for name, v in most.items()} for p in POINTED}
    camera_of = np.array(adjusted.block.image_camera)[adjusted.structure.image]
    for (camera, parameter, k), influence in zip(asked, responses.of_unknowns([k for *_, k in asked]), strict=True):
        for name, place in responses.places.items():
            # Of what nothing checks the detectable error is infinite.
            least = np.where(checked[name], detectable[name], np.nan)
            moved = np.abs(_of_numbers(groups[name], influence[place]) * least) / a_priori[k]
            if name == adjusted.block.image_points.group:
                moved = np.where(camera_of == camera, moved, np.nan)
            interior[parameter][name] = np.fmax(interior[parameter][name], moved)
    return UndetectedEffects(interior, most)


def most_felt(adjusted: Adjustment, external: UndetectedEffects) -> list[Felt]:
    """For each of `POINTED`, the observation that is worst for it; parameters that no camera has free are left out."""
    found, block = [], adjusted.block
    for parameter, moved in external.interior.items():
        worst: Felt | None = None
        for name, rows in observation_groups(adjusted).items():
            size = np.where(np.isfinite(moved[name]), moved[name], 0.0)
            if rows.unit and size.size and size.max() > (worst.moved if worst else 0.0):
                size = np.atleast_2d(size)
                k = np.unravel_index(np.argmax(size), size.shape)
                number, row = np.reshape(k, (2, 1))
                (words,) = rows.words_of(number, row, block.images, block.points)
                worst = Felt(parameter, words, float(size[k]))
        found += [worst] if worst else []
    return found


def _weights(rows: AbstractObservations, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """diag P, shaped like the residuals."""
    if isinstance(rows, Correlated):
        return np.einsum("nji,nji->in", np.asarray(rows.whitener), np.asarray(rows.whitener)).reshape(shape)
    return 1 / np.broadcast_to(np.asarray(rows.sigmas).T, shape) ** 2


def _of_numbers(rows: AbstractObservations, whitened: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """What an error in one observed number does, in one over its unit, from what errors of whitened numbers do."""
    if isinstance(rows, Correlated):
        w = np.asarray(rows.whitener)
        return np.einsum("nji,jn->in", w, whitened.reshape(w.shape[1], -1)).reshape(whitened.shape)
    return whitened / np.asarray(rows.sigmas).T


DELTA0 = 4.13
"""Shift of a normalised residual that a test of level 0.1 % finds with a power of 80 % (Baarda)."""


def detectable_errors(
    adjusted: Adjustment, redundancy: Redundancy, delta0: float = DELTA0
) -> dict[str, Float[np.ndarray, "..."]]:
    """By group, the least error that the test of one normalised residual finds with its power: delta0 / sqrt(P Q_vv P).

    In the unit of each observation; infinite where nothing checks it.
    """
    found = {}
    for name, p in error_precision(adjusted, redundancy).items():
        checked = still(redundancy[name]) > UNCHECKED
        found[name] = np.where(checked, delta0 / np.sqrt(np.where(checked, p, 1.0)), np.inf)
    return found


@shown
class Hidden(NamedTuple):
    """The observation of a group whose errors are found worst: `detectable` is infinite where none ever is."""

    group: str
    words: str
    detectable: float
    sigma: float
    """A priori; both in `unit`."""
    unit: str


def worst_checked(adjusted: Adjustment, redundancy: Redundancy) -> list[Hidden]:
    """Of each group of observations, that of the largest detectable error beside its standard deviation."""
    found, block = [], adjusted.block
    detectable = detectable_errors(adjusted, redundancy)
    for name, rows in observation_groups(adjusted).items():
        if rows.unit and len(rows):
            size, sigma = np.atleast_2d(detectable[name]), np.atleast_2d(still(rows.sigmas).T)
            k = np.unravel_index(np.argmax(size / sigma), size.shape)
            number, row = np.reshape(k, (2, 1))
            (words,) = rows.words_of(number, row, block.images, block.points)
            found.append(Hidden(name, words, float(size[k]), float(sigma[k]), rows.unit))
    return found
