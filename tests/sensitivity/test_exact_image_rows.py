"""Second derivatives of listed image rows against dense ones of all residuals, by automatic differentiation."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import adjust
from jaxphoto.adjustment import Linearised
from jaxphoto.adjustment.model.numbers import Increments
from jaxphoto.georeferencing import Corrections
from jaxphoto.sensitivity import image_rows as listed
from jaxphoto.sensitivity.hessian import image_columns
from tests.blocks import adjusted, simulated

# The row that is looked at.
ROW = 57


@functools.cache
def corrected():
    """Two cameras of different models, refraction and curvature of the earth: all that a row may depend on."""
    block = simulated("everything").block
    block = dataclasses.replace(block, corrections=Corrections(refraction=True, curvature=True, sea_level_m=-50.0))
    return adjust(block, adjusted("everything").unknowns, max_steps=2)


@functools.cache
def dense_products():
    """Second derivatives of all residuals by the unknowns of `ROW` and by what it measures, as functions of `curved`.

    Compiled once, beside them: which of the columns of shared unknowns there are.
    """
    a = corrected()
    own, places, equations = a.structure, a.padded.places, a.equations
    s, scale = equations.structure, jax.tree.map(jnp.asarray, equations.scale)
    values, zero = jax.tree.map(jnp.asarray, equations.weighed.values), jax.tree.map(jnp.zeros_like, scale)
    batch, m, p = np.unravel_index(places.row[ROW], s.rays.ray_point.shape)
    image, point = places.image[own.image[ROW]], places.point[own.point[ROW]]
    columns = np.asarray(image_columns(s))[image, 6:] - 6 * s.n_images

    def half_square(y, xy, curved):
        """Half the square of the row's residuals, with the second derivative J'J + curved r d2r."""
        shared = zero.shared.at[columns].add(y[9:], mode="drop")
        moved = Increments(zero.eop.at[:, image].set(y[:6]), shared, zero.points.at[:, point].set(y[6:9]))
        v = eqx.tree_at(lambda v: v.xy, values, jnp.asarray(values.xy).at[batch, :, m, p].set(xy))
        r = Linearised(moved, scale, v, s).residuals().image[batch, :, m, p]
        return jnp.sum(0.5 * r * r - (1 - curved) * jax.lax.stop_gradient(r) * r)

    at = jnp.zeros(9 + len(columns)), jnp.asarray(values.xy)[batch, :, m, p]
    return functools.partial(jax.jit(jax.hessian(half_square, (0, 1))), *at), columns < s.n_shared


@pytest.mark.parametrize("curved", [0.0, 1.0])
@pytest.mark.parametrize("at_once", [8192, 64])
def test_products_of_rows_are_the_dense_ones(curved: float, at_once: int, monkeypatch) -> None:
    monkeypatch.setattr(listed, "_BATCH", at_once)
    a = corrected()
    s, scale = a.equations.structure, jax.tree.map(jnp.asarray, a.equations.scale)
    values, rows = jax.tree.map(jnp.asarray, a.equations.weighed.values), listed.image_rows(a)
    found = eqx.filter_jit(listed.row_products)(values, scale, rows, jnp.asarray(curved), s)

    products, there = dense_products()
    (h, b), _ = products(jnp.asarray(curved))
    kept = np.append(np.full(9, True), there)
    by_point = np.where(kept[:, None], found.by_point[:, :, ROW], 0.0)
    np.testing.assert_allclose(by_point, h[:, 6:9], rtol=0, atol=1e-12 * np.abs(h).max())
    np.testing.assert_allclose(-found.measured[ROW].T, b, rtol=0, atol=1e-12 * np.abs(b).max())
