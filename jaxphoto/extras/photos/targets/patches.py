"""Least-squares matching of many small patches of a picture with a model of what they show.

    grey(pixel) = model(parameters, pixel) + noise,   v'v -> min,   C = s0^2 (J'J)^-1,   s0^2 = v'v / (n - u)

All patches of a picture are fitted at once, each by its own damped Gauss-Newton steps. The noise is that which the fit
leaves, so that a model that does not fit (halos of sharpening, compression, shadows) makes larger standard deviations.

Corners of squares to a part of a pixel: where four squares meet as on a chessboard, or the corner of one.

Both are two straight edges, blurred with one width s (and by the pixels), over a brightness that changes linearly,
with d = pixel - corner:

    four squares   grey = m + g . d + a erf(e1 / s) erf(e2 / s)
    one square     grey = m + g . d + a (1 + erf(e1 / s)) (1 + erf(e2 / s)) / 4,    ek = d . (cos tk, sin tk)

The nine unknowns (corner, t1, t2, ln s, a, m, g) are fitted to a round window by least squares (`patches`).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

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


# Of pixels: the blur to start from, and how far a corner may be from where it was looked for.
_BLUR, _FAR = 1.0, 2.0
# A window reaches no farther than this, or edges that a lens bends count as straight.
_LARGEST_PX, _SMALLEST_PX = 7.0, 2.9


class TargetPlaces(NamedTuple):
    """Targets in a picture as OpenCV counts (the centre of the upper-left pixel is (0, 0)), standard deviations."""

    column_row: Float[np.ndarray, "n 2"]
    sigma_px: Float[np.ndarray, "n 2"]
    found: Bool[np.ndarray, "n"]
    """False where nothing like the target is in the picture there."""


def fit_crossings(
    picture: np.ndarray,
    near: Float[np.ndarray, "n 2"],
    edges: Float[np.ndarray, "n 2 2"],
    reach_px: Float[np.ndarray, "n"],
) -> TargetPlaces:
    """Corners where four squares meet. `edges` are unit directions along the two edges at each; `reach_px` says how far
    from the corner nothing else is in the picture.
    """
    return _fit(_crossings, np.multiply, picture, near, edges, reach_px)


def fit_square_corners(
    picture: np.ndarray,
    near: Float[np.ndarray, "n 2"],
    edges: Float[np.ndarray, "n 2 2"],
    reach_px: Float[np.ndarray, "n"],
) -> TargetPlaces:
    """Corners of single squares; `edges` as in `fit_crossings`, from the corner along the square's own sides."""
    return _fit(_single, lambda one, other: (1 + one) * (1 + other) / 4, picture, near, edges, reach_px)


def _fit(linearised, shape, picture, near, edges, reach_px) -> TargetPlaces:
    radius = np.clip(reach_px, _SMALLEST_PX, _LARGEST_PX)
    for _ in range(2):  # once more about the corner that was found
        patches = windows(picture, near, radius)
        fit = fit_patches(linearised, _start(shape, patches, edges), patches)
        moved = fit.parameters[:, :2]
        stayed = fit.fitted & (np.linalg.norm(moved, axis=1) < _FAR)
        near = near + np.where(stayed[:, None], moved, 0.0)
    sigma = np.sqrt(np.einsum("pkk->pk", fit.covariance)[:, :2])
    contrast, blur = np.abs(fit.parameters[:, 5]), np.exp(fit.parameters[:, 4])
    good = stayed & (contrast > 3 * fit.noise) & (blur < radius) & (sigma < 0.5).all(axis=1)
    return TargetPlaces(near, sigma, good)


def _start(shape, patches, edges):
    """Corner in the middle, edges as given; contrast, brightness and its change by linear least squares."""
    pixels, grey, used = patches
    across = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
    # The normal of each edge points to the other edge, so that a single square lies on the positive side of both.
    side = np.sign(np.sum(across * edges[:, ::-1], axis=2))
    across = across * np.where(side == 0, 1.0, side)[:, :, None]
    angle = np.arctan2(across[..., 1], across[..., 0])
    distance = np.einsum("npk,nek->nep", pixels, across)
    contrast = shape(*np.tanh(distance.transpose(1, 0, 2) / _BLUR))
    columns = np.stack([contrast, np.ones_like(contrast), pixels[..., 0], pixels[..., 1]], axis=2) * used[:, :, None]
    normal = columns.transpose(0, 2, 1) @ columns + 1e-9 * np.eye(4)
    linear = np.linalg.solve(normal, columns.transpose(0, 2, 1) @ (grey * used)[:, :, None])[:, :, 0]
    n = len(pixels)
    return np.column_stack([np.zeros((n, 2)), angle, np.full(n, np.log(_BLUR)), linear])


def _edges(parameters, pixel):
    x, y = pixel[0] - parameters[0], pixel[1] - parameters[1]
    # A pixel sums over its own square, whose variance is a twelfth: no edge is sharper, and none can be missed.
    width = jnp.sqrt(2 / 12 + jnp.exp(2 * parameters[4]))
    first, second = (
        jax.scipy.special.erf((x * jnp.cos(t) + y * jnp.sin(t)) / width) for t in (parameters[2], parameters[3])
    )
    contrast, mean, in_column, in_row = parameters[5:]
    return first, second, contrast, mean + in_column * x + in_row * y


def _crossing(parameters, pixel):
    first, second, contrast, mean = _edges(parameters, pixel)
    return mean + contrast * first * second


def _square_corner(parameters, pixel):
    first, second, contrast, mean = _edges(parameters, pixel)
    return mean + contrast * (1 + first) * (1 + second) / 4


def linearised(model):
    """Values and derivatives of `model` for the pixels of many patches, as `fit_patches` wants it."""

    def one(parameters, pixel):
        value = model(parameters, pixel)
        return value, value

    def both(parameters, pixel):
        slope, value = jax.jacfwd(one, has_aux=True)(parameters, pixel)
        return value, slope

    return jax.vmap(jax.vmap(both, in_axes=(None, 0)))


@eqx.filter_jit
def _crossings(parameters: Float[Array, "n 9"], pixels: Float[Array, "n m 2"]):
    return linearised(_crossing)(parameters, pixels)


@eqx.filter_jit
def _single(parameters: Float[Array, "n 9"], pixels: Float[Array, "n m 2"]):
    return linearised(_square_corner)(parameters, pixels)
