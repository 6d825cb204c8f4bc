"""A camera that is another one in every strip: recovered, tested, held together by steps, and said in words."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto import ExteriorOrientation, Outcome, Weighted, adjust, covariance, project
from jaxphoto.camera import StripCamera
from jaxphoto.observations import StripCameraSteps
from jaxphoto.report.verdict import differences_finding
from jaxphoto.statistics import strip_differences
from tests.blocks import BROWN, simulated

MORE = StripCamera(0.04, -0.06, 0.05)
"""What the camera of strip b has more than that of strip a."""


@functools.cache
def two_strips():
    block, truth = simulated("cross")
    rows, of = block.image_points, np.repeat([0.0, 1.0], 5)
    exterior, points = jax.tree.map(jnp.asarray, (truth.exterior, truth.points))
    camera = jax.tree.map(jnp.asarray, truth.interior["one"])

    @jax.jit
    @jax.vmap
    def moved(part, image, point):
        own = ExteriorOrientation(exterior.position[image], exterior.camera_from_object[image])
        changed = jax.tree.map(lambda v: v * part, MORE).interior(camera, None)
        return project(changed, own, points[point]) - project(camera, own, points[point])

    xy = np.asarray(rows.xy) + np.asarray(moved(of[rows.image], rows.image, rows.point))
    return dataclasses.replace(
        block, image_strip=("a",) * 5 + ("b",) * 5, image_points=dataclasses.replace(rows, xy=xy)
    )


@functools.cache
def found(sigma, step=None):
    """The adjustment with cameras of strips that are zero to `sigma` (mm), and their test."""
    block = two_strips()
    of_each = lambda value: {StripCamera.kind: {name: StripCamera(value, value, value) for name in "ab"}}  # noqa: E731
    start = dataclasses.replace(block.start.unknowns, more=of_each(0.0))
    block = dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=start),
        priors=dataclasses.replace(block.priors, more=of_each(Weighted(0.0, sigma))),
    )
    one = np.array([0])
    steps = () if step is None else (StripCameraSteps(one, one + 1, np.zeros((1, 3)), np.full((1, 3), step)),)
    adjusted = adjust(block, more=steps)
    assert adjusted.outcome is Outcome.CONVERGED
    return adjusted, strip_differences(adjusted, covariance(adjusted))


def test_each_strip_has_its_own_camera():
    bent = MORE.interior(BROWN, None)
    for field, more in (("c", 0.04), ("xp", -0.06), ("yp", 0.05)):
        assert float(getattr(bent, field)) == pytest.approx(float(getattr(BROWN, field)) + more, abs=1e-12)
    assert bent.distortion == BROWN.distortion


def test_what_strips_differ_by_is_recovered():
    adjusted, strips = found(0.1)
    assert (strips.at, strips.parameters) == (("a",) * 3 + ("b",) * 3, ("c", "xp", "yp") * 2)
    assert 0.9 < adjusted.sigma0 < 1.1
    q = covariance(adjusted)
    places = [k for k, label in enumerate(q.labels) if label.startswith("strip_cameras[")]
    signs = np.hstack([-np.eye(3), np.eye(3)])
    sigma = np.sqrt(np.diagonal(signs @ np.asarray(q.matrix)[np.ix_(places, places)] @ signs.T))
    assert (np.abs(signs @ strips.more.value - [0.04, -0.06, 0.05]) < 3 * sigma).all()
    assert strips.more.rejected


def test_the_test_is_the_same_whatever_was_known():
    """Of the cameras of two strips three differences show; what all have in common is the camera's own."""
    (_, loose), (_, tight) = found(0.1), found(0.06)
    np.testing.assert_allclose(tight.more.detectable, loose.more.detectable, rtol=0.03)
    assert np.log10(tight.more.p_value) == pytest.approx(np.log10(loose.more.p_value), rel=0.03)


def test_steps_hold_the_strips_together():
    _, strips = found(0.1, 1e-6)
    np.testing.assert_allclose(strips.more.value[3:], strips.more.value[:3], atol=2e-5)


def test_words():
    _, strips = found(0.1)
    finding = differences_finding(strips)
    assert (finding.code, finding.value) == ("drift", strips.more.p_value)
    assert " um in strip a to " in finding.text and " um in strip b to " in finding.text
    alike = strips._replace(more=strips.more._replace(p_value=0.4, detectable=np.array([4, 3, 2, 5, 1, 1]) * 1e-3))
    finding = differences_finding(alike)
    assert finding.code == "no_drift" and finding.numbers["changes"] == "c 5.0 um, x_p 3.0 um, y_p 2.0 um"
