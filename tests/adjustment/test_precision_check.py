"""Numbers of too few digits are warned of, with what is lost."""

import warnings

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxphoto import adjust
from jaxphoto.adjustment.precision_check import warn_of_precision_loss
from tests.blocks import adjusted, simulated


def test_float32_input_is_named_with_the_digits_it_has():
    block, start = simulated("cross").block, adjusted("cross").unknowns
    xy = np.asarray(block.image_points.xy, np.float32)
    narrow = eqx.tree_at(lambda b: b.image_points.xy, block, xy)
    with pytest.warns(UserWarning, match=r"image_points\.xy is float32 and resolves .* to 2e-06 only: give float64"):
        result = adjust(narrow, start)
    # It is adjusted all the same, in 64 bits.
    assert bool(result.converged)
    assert np.asarray(result.unknowns.points).dtype == np.float64


def test_large_coordinates_lose_decimetres():
    block, start = simulated("cross").block, adjusted("cross").unknowns
    far = eqx.tree_at(lambda u: u.points, start, np.asarray(start.points + 5_400_000, np.float32))
    with pytest.warns(UserWarning, match=r"start\.points is float32 and resolves 54\d+ to 0\.5 only"):
        warn_of_precision_loss(block, far, block.priors)


def test_32_bit_computation_is_warned_of():
    block, start = simulated("cross").block, adjusted("cross").unknowns
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.warns(UserWarning, match="computes with 32 bits"):
            warn_of_precision_loss(block, start, block.priors)
    finally:
        jax.config.update("jax_enable_x64", True)


def test_float64_is_silent():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_precision_loss(simulated("cross").block, adjusted("cross").unknowns, simulated("cross").block.priors)
