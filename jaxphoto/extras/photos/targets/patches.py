"""Least-squares fits of models to many small image patches in parallel, and corners of chessboards.

    grey(pixel) = model(parameters, pixel) + noise,   v'v -> min,   C = s0^2 (J'J)^-1,   s0^2 = v'v / (n - u)

s0 is estimated from the residuals, so model errors (sharpening halos, compression, shadows) increase the standard
deviations.

A corner where four squares meet (chessboard) is modelled as two straight edges with a common blur s (in addition to the
pixel aperture) and a brightness that changes linearly, with d = pixel - corner:

    grey = m + g . d + a erf(e1 / s) erf(e2 / s),    ek = d . (cos tk, sin tk)

The nine unknowns (corner, t1, t2, ln s, a, m, g) are estimated in a circular window.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.compiling import call_compiled
from jaxphoto.initial.rays import padded, padded_length
from jaxphoto.least_squares import Fit, least_squares

# Maximum number of iterations; relative tolerance of the grey values with respect to the residuals (about 1e-3 sigma);
# absolute tolerance in grey values.
_STEPS, _RTOL, _ATOL = 40, 1e-4, 1e-3
# Pad patches to a multiple of this number of pixels.
_PIXELS = 64


class PatchFit(NamedTuple):
    """Fitted parameters of each patch; the first two are column and row relative to the patch origin."""

    parameters: Float[np.ndarray, "patches parameters"]
    covariance: Float[np.ndarray, "patches parameters parameters"]
    noise: Float[np.ndarray, "patches"]
    """Estimated standard deviation s0 of the grey values."""
    fitted: Bool[np.ndarray, "patches"]
    """False if the fit did not converge or parameters are undetermined."""


class Patches(NamedTuple):
    """Pixels of image patches."""

    pixels: Float[np.ndarray, "patches pixels 2"]
    """Column and row relative to the patch origin."""
    grey: Float[np.ndarray, "patches pixels"]
    used: Bool[np.ndarray, "patches pixels"]
    """False for padding and pixels outside the image."""


def fit_patches(program: Callable, start: Float[np.ndarray, "patches parameters"], patches: Patches) -> PatchFit:
    """Fit a model to patches from initial parameters. `program`: `eqx.filter_jit` of `fits` with this model."""
    (n, unknowns), used = start.shape, patches.used
    wide = -used.shape[1] % _PIXELS
    arrays = (np.pad(v, ((0, 0), (0, wide), *((0, 0),) * (v.ndim - 2))) for v in patches)
    fit: Fit = call_compiled(program, *(padded(v, padded_length(n)) for v in (start.astype(float), *arrays)))
    parameters, normal, cost, converged = (np.array(v)[:n] for v in fit[:4])
    noise = np.sqrt(cost / np.maximum(used.sum(axis=1) - unknowns, 1))
    # Fix parameters without effect on the grey values (such as a blur far below a pixel) at their current values.
    scale = np.sqrt(np.einsum("pkk->pk", normal))
    unseen = scale <= 1e-5 * scale.max(axis=1, keepdims=True)
    scale = np.where(unseen, np.inf, scale)
    correlation = normal / scale[:, :, None] / scale[:, None, :] + unseen[:, :, None] * np.eye(unknowns)
    regular = np.isfinite(correlation).all(axis=(1, 2))
    correlation[~regular] = np.eye(unknowns)
    regular &= np.linalg.eigvalsh(correlation)[:, 0] > 1e-10
    correlation[~regular] = np.eye(unknowns)
    covariance = np.linalg.inv(correlation) / scale[:, :, None] / scale[:, None, :] * (noise**2)[:, None, None]
    return PatchFit(parameters, covariance, noise, converged & regular & (used.sum(axis=1) > unknowns))


def fits(model: Callable, start, pixels, grey, used) -> Fit:
    """Fit `model(parameters, pixel)` to each patch by least squares (vectorised)."""

    def fit(start, pixels, grey, used):
        grey_of = jax.vmap(model, in_axes=(None, 0))
        residuals = lambda parameters, _: jnp.where(used, grey_of(parameters, pixels) - grey, 0.0)  # noqa: E731
        return least_squares(residuals, start, rtol=_RTOL, atol=_ATOL, max_steps=_STEPS)

    return jax.vmap(fit)(start, pixels, grey, used)


def windows(
    picture: np.ndarray, centre: Float[np.ndarray, "patches 2"], radius: Float[np.ndarray, "patches"]
) -> Patches:
    """Extract circular windows about `centre`: (column, row) relative to the centre of the upper left pixel."""
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


# Initial blur (px); maximum distance (px) of a corner from its initial position.
_BLUR, _FAR = 1.0, 2.0
# Maximum and minimum radius (px) of a window; lens distortion bends longer edges.
_LARGEST_PX, _SMALLEST_PX = 7.0, 2.9


class TargetPlaces(NamedTuple):
    """Image coordinates of targets (px) and their standard deviations.

    The origin is the centre of the upper left pixel, as in OpenCV.
    """

    column_row: Float[np.ndarray, "n 2"]
    sigma_px: Float[np.ndarray, "n 2"]
    found: Bool[np.ndarray, "n"]
    """False if the target was not found."""


def fit_crossings(
    picture: np.ndarray,
    near: Float[np.ndarray, "n 2"],
    edges: Float[np.ndarray, "n 2 2"],
    reach_px: Float[np.ndarray, "n"],
) -> TargetPlaces:
    """Measure corners where four squares meet.

    `edges`: unit directions along the two edges of each corner. `reach_px`: radius around each corner without other
    edges.
    """
    radius = np.clip(reach_px, _SMALLEST_PX, _LARGEST_PX)
    for _ in range(2):  # repeated about the measured corner
        patches = windows(picture, near, radius)
        fit = fit_patches(_crossings, _start(patches, edges), patches)
        moved = fit.parameters[:, :2]
        stayed = fit.fitted & (np.linalg.norm(moved, axis=1) < _FAR)
        near = near + np.where(stayed[:, None], moved, 0.0)
    sigma = np.sqrt(np.einsum("pkk->pk", fit.covariance)[:, :2])
    contrast, blur = np.abs(fit.parameters[:, 5]), np.exp(fit.parameters[:, 4])
    good = stayed & (contrast > 3 * fit.noise) & (blur < radius) & (sigma < 0.5).all(axis=1)
    return TargetPlaces(near, sigma, good)


def _start(patches, edges):
    """Return initial parameters: corner at the centre, given edges, brightness by linear least squares."""
    pixels, grey, used = patches
    across = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
    angle = np.arctan2(across[..., 1], across[..., 0])
    distance = np.einsum("npk,nek->nep", pixels, across)
    contrast = np.prod(np.tanh(distance / _BLUR), axis=1)
    columns = np.stack([contrast, np.ones_like(contrast), pixels[..., 0], pixels[..., 1]], axis=2) * used[:, :, None]
    normal = columns.transpose(0, 2, 1) @ columns + 1e-9 * np.eye(4)
    linear = np.linalg.solve(normal, columns.transpose(0, 2, 1) @ (grey * used)[:, :, None])[:, :, 0]
    n = len(pixels)
    return np.column_stack([np.zeros((n, 2)), angle, np.full(n, np.log(_BLUR)), linear])


def _crossing(parameters, pixel):
    x, y = pixel[0] - parameters[0], pixel[1] - parameters[1]
    # Pixel integration (variance 1/12 per axis) limits the sharpness of an edge.
    width = jnp.sqrt(2 / 12 + jnp.exp(2 * parameters[4]))
    first, second = (
        jax.scipy.special.erf((x * jnp.cos(t) + y * jnp.sin(t)) / width) for t in (parameters[2], parameters[3])
    )
    contrast, mean, in_column, in_row = parameters[5:]
    return mean + in_column * x + in_row * y + contrast * first * second


@eqx.filter_jit
def _crossings(start: Float[Array, "n 9"], pixels: Float[Array, "n m 2"], grey, used):
    return fits(_crossing, start, pixels, grey, used)
