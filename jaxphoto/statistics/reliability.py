"""Internal and external reliability: redundancy numbers, normalised residuals, minimal detectable biases.

r = 1 - diag(J Q J') in units of the a priori sigma; the redundancy numbers of a block sum to its redundancy. The
normalised residual is w = v / (sigma0 sigma sqrt(r)), to be compared with the critical value of a blunder test.

The minimal detectable bias (MDB) of an observation is nabla_i = delta0 / sqrt((P Q_vv P)_ii): the smallest error that
the test of its normalised residual detects with the stated power (internal reliability). An error of this size moves
unknown k by -(J N^-1 e_k)_i nabla_i / sigma_i. It moves any function of the unknowns by at most
delta0 sqrt((P - P Q_vv P)_ii / (P Q_vv P)_ii) of its standard deviations (external reliability). Without correlations
between observations this bound is delta0 sqrt((1 - r) / r).

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
from jaxphoto.arrays import ArrayLike, to_numpy
from jaxphoto.compiling import prepare, run_compiled
from jaxphoto.observations import AbstractObservations, Correlated
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.covariance import Cofactors, Covariance, RowCofactors, prepare_covariance, row_cofactors
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.hat_matrix import HatMatrix
from jaxphoto.statistics.systematic_effects import MAX_GROUPS

LEAST_CHECKED = 0.01
"""Redundancy number below which a normalised residual is dominated by rounding and is not tested."""
UNCHECKED = 1e-6
"""Redundancy number below which an observation is uncontrolled: it has no normalised residual."""
DELTA0 = 4.13
"""Noncentrality of a normalised residual for a test of level 0.1 % with a power of 80 % (Baarda)."""
REPORTED_PARAMETERS = ("c_mm", "xp_mm", "yp_mm")
"""Interior parameters for which the effect of each MDB is computed."""


def prepare_statistics(equations: NormalEquations, seconds: dict[str, float]) -> None:
    """Compile the programs of `covariance` and `redundancy_numbers` in the background."""
    if jax.process_count() > 1:
        # Argument types of arrays sharded over several processes cannot be predicted here.
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


@pretty_repr
class Redundancy(eqx.Module):
    """Redundancy numbers, shaped like `Adjustment.residuals`. Their sum is the redundancy."""

    numbers: Residuals
    blocks: dict[str, Float[np.ndarray, "_ _ _"]]
    """I - J Q J' (rows, c, c) of the c whitened components of each row, by group."""

    @property
    def image(self) -> Float[ArrayLike, "2 rows"]:
        """Redundancy numbers of the image rows."""
        return self.numbers.image

    @property
    def named(self) -> dict[str, Float[ArrayLike, "..."]]:
        """Redundancy numbers by group name."""
        return self.numbers.named

    def __getitem__(self, name: str) -> Float[ArrayLike, "..."]:
        return self.numbers[name]


def redundancy_numbers(adjusted: Adjustment, covariance: Covariance) -> Redundancy:
    """Compute the redundancy number of every observation.

    For correlated observations these are the diagonal elements of Q_vv P, whose sum is also the redundancy.
    """
    rows_cofactors = row_cofactors(adjusted, covariance.rotations) if covariance.rows is None else covariance.rows
    arguments = (adjusted.equations, covariance.cofactors, rows_cofactors)
    image, others = run_compiled(_row_variances, arguments, adjusted.seconds, "covariance")
    groups, numbers_by_group = observation_groups(adjusted), []
    blocks: dict[str, np.ndarray] = {}
    for g, v in zip(adjusted.structure.observed, others, strict=True):
        c, rows = g.components, groups[g.name]
        flat = to_numpy(v).reshape(c * c, *np.shape(v)[2:])
        hat = adjusted.padded.crop_rows(dataclasses.replace(g, scalar=False), flat)
        block = np.eye(c) - hat.reshape(c, c, -1).transpose(2, 0, 1)
        numbers = np.diagonal(block, axis1=1, axis2=2).T
        blocks[g.name] = block
        if isinstance(rows, Correlated):
            w = np.asarray(rows.whitener)
            numbers = np.einsum("nij,njk,nki->in", np.linalg.inv(w), block, w)
        numbers_by_group.append(numbers[0] if g.scalar else numbers)
    residuals = dataclasses.replace(
        adjusted.residuals, others=tuple(numbers_by_group), datum=np.zeros(adjusted.n_constraints)
    )
    x, y, xy = adjusted.padded.crop_image(image)
    blocks = {IMAGE_POINTS: np.eye(2) - np.array([[x, xy], [xy, y]]).transpose(2, 0, 1), **blocks}
    return Redundancy(dataclasses.replace(residuals, image=1 - np.stack([x, y])), blocks)


def normalised_residuals(adjusted: Adjustment, redundancy: Redundancy) -> Residuals:
    """Compute w = v / (sigma0 sigma sqrt(r)) of every observation; NaN if the redundancy number is zero.

    For correlated observations w = (P v) / (sigma0 sqrt(diag P Q_vv P)), the test statistic of an error in one of them.
    """
    sigma0, precision = float(adjusted.sigma0), error_precision(adjusted, redundancy)

    def w(name, rows, v):
        v, checked = np.asarray(v), np.asarray(redundancy[name]) > UNCHECKED
        scale = sigma0 * np.sqrt(np.where(checked, precision[name], 1.0))
        return np.where(checked, _per_observation(rows, v) / scale, np.nan)

    groups, residuals = observation_groups(adjusted), adjusted.residuals.named
    image, *others = (w(name, groups[name], v) for name, v in residuals.items())
    return dataclasses.replace(adjusted.residuals, image=image, others=tuple(others))


def error_precision(adjusted: Adjustment, redundancy: Redundancy) -> dict[str, Float[np.ndarray, "..."]]:
    """Compute diag P Q_vv P by group: the a priori weight of the estimated error in one observation.

    Without correlations it equals r / sigma^2. Unit: 1 / (unit of the observation)^2.
    """
    precision = {}
    for name, rows in observation_groups(adjusted).items():
        r = np.asarray(redundancy[name])
        if isinstance(rows, Correlated):
            p = np.asarray(rows.whitener)
            precision[name] = np.einsum("nji,njk,nki->in", p, redundancy.blocks[name], p).reshape(r.shape)
        else:
            precision[name] = r / np.asarray(rows.sigmas).T ** 2
    return precision


@eqx.filter_jit
def _row_variances(equations: NormalEquations, q: Cofactors, of_rows: RowCofactors) -> tuple[Array, tuple[Array, ...]]:
    return equations.row_variances(q, of_rows)


def minimal_detectable_biases(
    adjusted: Adjustment, redundancy: Redundancy, delta0: float = DELTA0
) -> dict[str, Float[np.ndarray, "..."]]:
    """Compute the minimal detectable bias delta0 / sqrt(diag P Q_vv P) of every observation, by group.

    In the unit of the observation; infinite if the redundancy number is zero.
    """
    mdbs = {}
    for name, p in error_precision(adjusted, redundancy).items():
        checked = to_numpy(redundancy[name]) > UNCHECKED
        mdbs[name] = np.where(checked, delta0 / np.sqrt(np.where(checked, p, 1.0)), np.inf)
    return mdbs


@pretty_repr
class LargestMdb(NamedTuple):
    """Observation of a group with the largest ratio MDB / standard deviation."""

    group: str
    words: str
    mdb: float
    """Minimal detectable bias; infinite for undetectable errors."""
    sigma: float
    """A priori standard deviation; both are in `unit`."""
    unit: str


def largest_mdbs(adjusted: Adjustment, redundancy: Redundancy) -> list[LargestMdb]:
    """Find the observation with the largest ratio MDB / standard deviation in each group."""
    largest, block = [], adjusted.block
    mdbs = minimal_detectable_biases(adjusted, redundancy)
    for name, rows in observation_groups(adjusted).items():
        if rows.unit and len(rows):
            mdb, sigma = np.atleast_2d(mdbs[name]), np.atleast_2d(to_numpy(rows.sigmas).T)
            k = np.unravel_index(np.argmax(mdb / sigma), mdb.shape)
            component, row = np.reshape(k, (2, 1))
            (words,) = rows.words_of(component, row, block.images, block.points)
            largest.append(LargestMdb(name, words, float(mdb[k]), float(sigma[k]), rows.unit))
    return largest


@pretty_repr
class MdbEffects(eqx.Module):
    """External reliability: effect of the MDB of every observation, in standard deviations of the affected quantity.

    Arrays are shaped like the residuals of the group; NaN if the redundancy number is zero.
    """

    interior: dict[str, dict[str, Float[np.ndarray, "..."]]]
    """Effect on each of `REPORTED_PARAMETERS`, by group. Image rows affect their own camera; for other rows this is the
    effect on the most affected camera.
    """
    most: dict[str, Float[np.ndarray, "..."]]
    """Upper bound of the effect on any function of the unknowns, by group."""


@pretty_repr
class LargestEffect(NamedTuple):
    """Observation whose MDB has the largest effect on an interior parameter."""

    parameter: str
    """Parameter of the camera of the image; for other rows, of the most affected camera."""
    words: str
    moved: float
    """Effect in standard deviations of the parameter."""


def mdb_effects(adjusted: Adjustment, covariance: Covariance, redundancy: Redundancy) -> MdbEffects:
    """Compute the external reliability of every observation."""
    groups, precision = observation_groups(adjusted), error_precision(adjusted, redundancy)
    mdbs = minimal_detectable_biases(adjusted, redundancy)
    checked = {name: np.asarray(redundancy[name]) > UNCHECKED for name in groups}
    bound = {}
    for name, rows in groups.items():
        p = np.where(checked[name], precision[name], 1.0)
        difference = np.maximum(_weights(rows, p.shape) - p, 0.0)
        bound[name] = np.where(checked[name], DELTA0 * np.sqrt(difference / p), np.nan)
    variance = np.asarray(covariance.matrix).diagonal()[6 * covariance.n_images :]
    a_priori = np.sqrt(np.where(variance > 0, variance, np.nan))
    labels = {label: k for k, label in enumerate(adjusted.structure.labels)}
    cameras = adjusted.unknowns.interior if len(adjusted.unknowns.interior) <= MAX_GROUPS else ()
    requested = [
        (c, p, labels[f"interior[{c}].{p}"])
        for c in cameras
        for p in REPORTED_PARAMETERS
        if f"interior[{c}].{p}" in labels
    ]
    hat_matrix = HatMatrix.of(adjusted)
    interior = {p: {name: np.full(np.shape(v), np.nan) for name, v in bound.items()} for p in REPORTED_PARAMETERS}
    camera_of = np.array(adjusted.block.image_camera)[adjusted.structure.image]
    for (camera, parameter, k), influence in zip(
        requested, hat_matrix.influence_on([k for *_, k in requested]), strict=True
    ):
        for name, index in hat_matrix.places.items():
            # Skip uncontrolled observations: their MDB is infinite.
            mdb = np.where(checked[name], mdbs[name], np.nan)
            moved = np.abs(_per_observation(groups[name], influence[index]) * mdb) / a_priori[k]
            if name == adjusted.block.image_points.group:
                moved = np.where(camera_of == camera, moved, np.nan)
            interior[parameter][name] = np.fmax(interior[parameter][name], moved)
    return MdbEffects(interior, bound)


def largest_interior_effects(adjusted: Adjustment, external: MdbEffects) -> list[LargestEffect]:
    """Find the largest effect on each of `REPORTED_PARAMETERS` that at least one camera estimates."""
    effects, block = [], adjusted.block
    for parameter, moved in external.interior.items():
        largest: LargestEffect | None = None
        for name, rows in observation_groups(adjusted).items():
            size = np.where(np.isfinite(moved[name]), moved[name], 0.0)
            if rows.unit and size.size and size.max() > (largest.moved if largest else 0.0):
                size = np.atleast_2d(size)
                k = np.unravel_index(np.argmax(size), size.shape)
                component, row = np.reshape(k, (2, 1))
                (words,) = rows.words_of(component, row, block.images, block.points)
                largest = LargestEffect(parameter, words, float(size[k]))
        effects += [largest] if largest else []
    return effects


def _weights(rows: AbstractObservations, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Return diag P, shaped like the residuals."""
    if isinstance(rows, Correlated):
        return np.einsum("nji,nji->in", np.asarray(rows.whitener), np.asarray(rows.whitener)).reshape(shape)
    return 1 / np.broadcast_to(np.asarray(rows.sigmas).T, shape) ** 2


def _per_observation(rows: AbstractObservations, whitened: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return L'^-1 u of whitened quantities u (P = L'^-1 L^-1).

    It converts u per whitened unit to u per unit of the observation.
    """
    if isinstance(rows, Correlated):
        w = np.asarray(rows.whitener)
        return np.einsum("nji,jn->in", w, whitened.reshape(w.shape[1], -1)).reshape(whitened.shape)
    return whitened / np.asarray(rows.sigmas).T
