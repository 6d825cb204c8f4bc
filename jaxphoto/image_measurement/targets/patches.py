"""Least-squares matching of many small patches of a picture with a model of what they show.

    grey(pixel) = model(parameters, pixel) + noise,   v'v -> min,   C = s0^2 (J'J)^-1,   s0^2 = v'v / (n - u)

All patches of a picture are fitted at once, each by its own damped Gauss-Newton steps. The noise is that which the fit
leaves, so that a model that does not fit (halos of sharpening, compression, shadows) makes larger standard deviations.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.compiling import call_compiled
from jaxphoto.initial.rays import padded_length

_STEPS = 40
# Of the diagonal: with less, a blur that residuals hide would swing to and fro.
_LEAST_DAMPING = 1e-3
# In pixels: by what a last step may still move a target.
_STILL = 1e-3
_PIXELS = 64


class PatchFit(NamedTuple):
    """Fitted parameters of each patch; the first two are column and row from where the patch was looked for."""

    parameters: Float[np.ndarray, "patches parameters"]
    covariance: Float[np.ndarray, "patches parameters parameters"]
    noise: Float[np.ndarray, "patches"]
    """Standard deviation of a grey value, s0."""
    fitted: Bool[np.ndarray, "patches"]
    """False where the steps did not come to rest or the parameters cannot be told apart."""


class Patches(NamedTuple):
    """Pixels of patches of a picture."""

    pixels: Float[np.ndarray, "patches pixels 2"]
    """Column and row from the patch's own origin."""
    grey: Float[np.ndarray, "patches pixels"]
    used: Bool[np.ndarray, "patches pixels"]
    """False for what is there to fill the array, such as pixels beyond the border of the picture."""


def fit_patches(
    linearised: Any,
    start: Float[np.ndarray, "patches parameters"],
    patches: Patches,
) -> PatchFit:
    """Fit a model to patches, from starting parameters.

    `linearised` (made by `eqx.filter_jit`) gives values (patches, pixels) and derivatives (patches, pixels, parameters)
    of the model for parameters (patches, parameters) and pixels (patches, pixels, 2).
    """
    (n, unknowns), (pixels, grey, used) = start.shape, patches
    width = -(-pixels.shape[1] // _PIXELS) * _PIXELS

    def system(parameters, which):
        padded, place = np.ones((padded_length(len(which)), unknowns)), np.zeros((padded_length(len(which)), width, 2))
        padded[: len(which)], place[: len(which), : pixels.shape[1]] = parameters, pixels[which]
        values = call_compiled(linearised, padded, place)
        value, slope = (np.asarray(v)[: len(which), : pixels.shape[1]] for v in values)
        residual = np.where(used[which], grey[which] - value, 0.0)
        slope = np.where(used[which, :, None], slope, 0.0)
        across = slope.transpose(0, 2, 1)
        return np.sum(residual**2, axis=1), across @ slope, (across @ residual[:, :, None])[:, :, 0]

    parameters, damping = start.astype(float), np.full(n, 1e-3)
    state = system(parameters, np.arange(n))
    still = np.zeros(n, bool)
    for _ in range(_STEPS):
        which = np.flatnonzero(~still)
        if not len(which):
            break
        sum_of_squares, normal, right = (part[which] for part in state)
        diagonal = np.einsum("pkk->pk", normal)
        damped = normal + (damping[which, None] * diagonal + 1e-12)[:, :, None] * np.eye(unknowns)
        step = np.linalg.solve(damped, right[:, :, None])[:, :, 0]
        trial = system(parameters[which] + step, which)
        better = trial[0] <= sum_of_squares
        parameters[which[better]] += step[better]
        for part, new in zip(state, trial, strict=True):
            part[which[better]] = new[better]
        damping[which] = np.clip(damping[which] * np.where(better, 0.3, 10.0), _LEAST_DAMPING, 1e9)
        still[which] = np.max(np.abs(step[:, :2]), axis=1) < _STILL
    sum_of_squares, normal, _ = state
    noise = np.sqrt(sum_of_squares / np.maximum(used.sum(axis=1) - unknowns, 1))
    # What the picture no longer sees at all, such as a blur far below a pixel's own, stays where it is.
    scale = np.sqrt(np.einsum("pkk->pk", normal))
    unseen = scale <= 1e-5 * scale.max(axis=1, keepdims=True)
    scale = np.where(unseen, np.inf, scale)
    correlation = normal / scale[:, :, None] / scale[:, None, :] + unseen[:, :, None] * np.eye(unknowns)
    known = np.isfinite(correlation).all(axis=(1, 2))
    correlation[~known] = np.eye(unknowns)
    known &= np.linalg.eigvalsh(correlation)[:, 0] > 1e-10
    correlation[~known] = np.eye(unknowns)
    covariance = np.linalg.inv(correlation) / scale[:, :, None] / scale[:, None, :] * (noise**2)[:, None, None]
    return PatchFit(parameters, covariance, noise, still & known & (used.sum(axis=1) > unknowns))


def windows(
    picture: np.ndarray, centre: Float[np.ndarray, "patches 2"], radius: Float[np.ndarray, "patches"]
) -> Patches:
    """Round windows about `centre`, (column, row) from the centre of the upper-left pixel."""
    reach = int(np.ceil(radius.max())) + 1
    along = np.arange(-reach, reach + 1)
    offset = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    whole = np.rint(centre).astype(int)[:, None, :] + offset
    pixels = whole - centre[:, None, :]
    height, width = picture.shape
    inside = (whole >= 0).all(axis=2) & (whole[..., 0] < width) & (whole[..., 1] < height)
    used = inside & (np.sum(pixels**2, axis=2) <= radius[:, None] ** 2)
    column, row = np.clip(whole[..., 0], 0, width - 1), np.clip(whole[..., 1], 0, height - 1)
    return Patches(pixels, picture[row, column].astype(float), used)
