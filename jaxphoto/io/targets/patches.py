"""Least-squares matching of many small patches of a picture with a model of what they show.

    grey(pixel) = model(parameters, pixel) + noise,   v'v -> min,   C = s0^2 (J'J)^-1,   s0^2 = v'v / (n - u)

All patches of a picture are fitted at once, each by its own damped Gauss-Newton steps. The noise is that which the fit
leaves, so that a model that does not fit (halos of sharpening, compression, shadows) makes larger standard deviations.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.compiling import call_compiled
from jaxphoto.orientation.rays import padded_length

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
    room = (padded_length(n), -(-pixels.shape[1] // _PIXELS) * _PIXELS)
    place = np.zeros((*room, 2))
    place[:n, : pixels.shape[1]] = pixels

    def system(parameters):
        padded = np.ones((room[0], unknowns))
        padded[:n] = parameters
        value, slope = (np.asarray(v)[:n, : pixels.shape[1]] for v in call_compiled(linearised, padded, place))
        residual = np.where(used, grey - value, 0.0)
        slope = np.where(used[:, :, None], slope, 0.0)
        across = slope.transpose(0, 2, 1)
        return np.sum(residual**2, axis=1), across @ slope, (across @ residual[:, :, None])[:, :, 0]

    parameters, damping = start.astype(float), np.full(n, 1e-3)
    state = system(parameters)
    still = np.zeros(n, bool)
    for _ in range(_STEPS):
        square_sum, normal, right = state
        diagonal = np.einsum("pkk->pk", normal)
        damped = normal + (damping[:, None] * diagonal + 1e-12)[:, :, None] * np.eye(unknowns)
        step = np.linalg.solve(damped, right[:, :, None])[:, :, 0]
        trial = system(parameters + step)
        better = trial[0] <= square_sum
        parameters = np.where(better[:, None], parameters + step, parameters)
        state = tuple(
            np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(trial, state, strict=True)
        )
        damping = np.clip(damping * np.where(better, 0.3, 10.0), _LEAST_DAMPING, 1e9)
        still |= np.max(np.abs(step[:, :2]), axis=1) < _STILL
        if still.all():
            break
    square_sum, normal, _ = state
    noise = np.sqrt(square_sum / np.maximum(used.sum(axis=1) - unknowns, 1))
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
