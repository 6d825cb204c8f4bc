"""What a certificate draws, by hand: the distortion with its band, and standard deviations over the format."""

import numpy as np
import pytest

from jaxphoto.camera import Brown, InteriorOrientation, Sensor, parameter_names
from jaxphoto.stability import METHODS, bundle_offsets, distortion_curve, frame_sigma, image_grid

CAMERA = InteriorOrientation(35.0, 0.4, -0.3, Brown(k1=-9e-5, k2=1e-7))
SENSOR = Sensor(4500, 3000, 0.008)


def test_the_curve_is_brown_s_polynomial_and_its_band_that_of_its_coefficients():
    names, covariance = parameter_names(CAMERA), np.zeros((len(parameter_names(CAMERA)),) * 2)
    q = np.array([[1e-12, -3e-15], [-3e-15, 1.6e-17]])
    which = [names.index("k1"), names.index("k2")]
    covariance[np.ix_(which, which)] = q
    curve = distortion_curve(CAMERA, SENSOR, covariance)
    powers = np.stack([curve.r**3, curve.r**5], axis=1)
    np.testing.assert_allclose(curve.radial, powers @ [-9e-5, 1e-7], rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(curve.sigma, np.sqrt(np.einsum("ri,ij,rj->r", powers, q, powers)), rtol=1e-9)
    assert curve.r[-1] == pytest.approx(np.hypot(18 - 0.4, 12 - 0.3)) and np.abs(curve.other).max() < 1e-12


def test_sigma_over_the_format_is_that_of_the_principal_point():
    """x_p and y_p alone, 1 and 2 um: sqrt(5) um everywhere where position and attitude are known."""
    plain = InteriorOrientation(35.0)
    covariance = np.diag([0, 1e-6, 4e-6, *np.zeros(len(parameter_names(plain)) - 3)])
    points = image_grid(SENSOR, 5, 3)
    np.testing.assert_allclose(frame_sigma(plain, covariance, points, "zrot"), np.sqrt(5e-6), rtol=1e-9)
    assert frame_sigma(plain, covariance, points, "rot").max() < 0.6 * np.sqrt(5e-6)


@pytest.mark.parametrize("method", METHODS)
def test_sigma_over_the_format_is_what_comparing_the_camera_with_itself_gives(method):
    """Beside the derivatives of the alignment's optimum, which are found by an iteration."""
    points, n = image_grid(SENSOR, 5, 4), len(parameter_names(CAMERA))
    rng = np.random.default_rng(3)
    covariance = np.cov(rng.normal(size=(n, 3 * n)) * np.array([1e-3, 1e-3, 1e-3, *[1e-7] * (n - 3)])[:, None])
    offsets = bundle_offsets(CAMERA, CAMERA, points, method)
    rows = np.asarray(offsets.measured_jacobian)[:, :n].reshape(len(points), 2, n)
    expected = np.sqrt(np.einsum("nip,pq,niq->n", rows, covariance, rows))
    np.testing.assert_allclose(frame_sigma(CAMERA, covariance, points, method), expected, rtol=1e-9)
