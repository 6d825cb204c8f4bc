"""What an error that no test finds does to the result: to c and the principal point, and at most to anything.

An error of the detectable size nabla_i in observation i alone moves unknown k by -(J N^-1 e_k)_i nabla_i / sigma_i, and
no function of the unknowns, so no point of the ground, by more than delta0 sqrt((P - P Q_vv P)_ii / (P Q_vv P)_ii) of
its standard deviations: delta0 sqrt((1 - r) / r) where observations are not correlated.

Source: Baarda (1968), A testing procedure for use in geodetic networks; Förstner (1987), Reliability analysis of
parameter estimation in linear models.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.observations import AbstractObservations, Correlated
from jaxphoto.short_repr import shown
from jaxphoto.statistics.blunder_test import DELTA0, detectable_errors
from jaxphoto.statistics.covariance import Covariance
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.patterns import MOST_PARTS
from jaxphoto.statistics.reliability import UNCHECKED, Redundancy, error_precision
from jaxphoto.statistics.responses import Responses

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
