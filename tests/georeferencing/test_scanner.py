"""The laser scanner's boresight and shifts."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxphoto.georeferencing import corrected_point, raised_by_boresight
from tests.derivatives import compiled
from tests.formulas import camera_from_object

corrected, raised = compiled(corrected_point), compiled(raised_by_boresight)
small = st.floats(-2e-3, 2e-3)
angle = st.floats(-3.0, 3.0)


@settings(max_examples=30, deadline=None)
@given(st.tuples(angle, angle, angle), st.tuples(small, small, small))
def test_boresight_turns_the_shot_about_the_body_axes(angles, boresight):
    """A boresight b turns what the scanner saw in direction d to d - b x d, to second order, at the same range."""
    object_from_body, b = camera_from_object(*angles), np.array(boresight)
    position, shot, shift = np.array([10.0, -20.0, 900.0]), np.array([120.0, 40.0, -880.0]), np.array([0.2, -0.1, 0.3])
    point = position + object_from_body @ shot
    found = corrected(point, position, object_from_body, b, shift) + shift - position
    expected = object_from_body @ (shot - np.cross(b, shot))
    np.testing.assert_allclose(found, expected, atol=1e3 * (b @ b) + 1e-9)
    np.testing.assert_allclose(np.linalg.norm(found), np.linalg.norm(shot), rtol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.tuples(angle, angle, angle))
def test_how_a_boresight_has_raised_a_point(angles):
    """Central differences of the corrected point along the normal, and r x n in the body's axes."""
    object_from_body = camera_from_object(*angles)
    position, point, normal = np.array([0.0, 5.0, 1000.0]), np.array([200.0, -50.0, 30.0]), np.array([0.36, 0.48, 0.8])
    found = raised(point, normal, position, object_from_body)
    step, none = 1e-5, np.zeros(3)

    def height(b):
        return normal @ corrected(point, position, object_from_body, b, none)

    differences = [(height(-step * e) - height(step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(found, differences, atol=1e-5)
    in_body = object_from_body.T @ (point - position)
    np.testing.assert_allclose(found, np.cross(in_body, object_from_body.T @ normal), atol=1e-9)
