"""Exact sensitivity of cameras whose distortion is not written for many places at once."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxphoto
from jaxphoto.camera import Agisoft, OpenCv, set_parameter
from jaxphoto.camera.conversion import converted
from jaxphoto.sensitivity.exact import sensitivity
from jaxphoto.unknowns import FIXED, FREE
from tests.test_examples import ROOT


def leaves_of(model):
    block = jaxphoto.read_block(ROOT / "examples/cross_block")
    ((name, given),) = block.start.unknowns.interior.items()
    interior = jax.tree.map(np.asarray, converted(given, model, block.sensors[name]).interior)
    priors = jax.tree.map(lambda _: FIXED, interior)
    for parameter in ("c_mm", "xp_mm", "yp_mm", "k1", "k2"):
        priors = set_parameter(priors, parameter, FREE)
    unknowns = dataclasses.replace(block.start.unknowns, interior={name: interior})
    block = dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=unknowns),
        priors=dataclasses.replace(block.priors, interior={name: priors}),
    )
    derivatives = sensitivity(jaxphoto.adjust(block))
    return [np.asarray(v) for v in jax.tree.leaves(derivatives) if hasattr(v, "dtype")]


@pytest.fixture(scope="module")
def both():
    return leaves_of(OpenCv), leaves_of(Agisoft)


def test_two_names_of_one_camera_have_one_sensitivity(both):
    # Both died with "mul got incompatible shapes"; of these coefficients they are the same polynomial.
    of_opencv, of_agisoft = both
    # Image points, stations and control.
    assert len(of_opencv) == len(of_agisoft) == 3
    for one, other in zip(of_opencv, of_agisoft, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9 * max(np.abs(one).max(initial=0), 1e-300))
    assert max(np.abs(v).max(initial=0) for v in of_opencv) > 1
