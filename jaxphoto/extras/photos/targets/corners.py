"""Corners of squares to a part of a pixel: where four squares meet as on a chessboard, or the corner of one.

Both are two straight edges, blurred with one width s (and by the pixels), over a brightness that changes linearly,
with d = pixel - corner:

    four squares   grey = m + g . d + a erf(e1 / s) erf(e2 / s)
    one square     grey = m + g . d + a (1 + erf(e1 / s)) (1 + erf(e2 / s)) / 4,    ek = d . (cos tk, sin tk)

The nine unknowns (corner, t1, t2, ln s, a, m, g) are fitted to a round window by least squares (`patches`).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxphoto.extras.photos.targets.patches import fit_patches, windows

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
