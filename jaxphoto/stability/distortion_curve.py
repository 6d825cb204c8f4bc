"""Distortion curve: distortion as a function of the distance from the principal point, with uncertainty.

With K directions u_k at the measured distance r from the principal point,

    radial(r) = mean over k of u_k . d(r u_k),   d = measured - ideal

is the rotationally symmetric radial distortion for the calibrated c (Brown 1971); a different c adds a linear term. The
asymmetric part (decentring and affinity) is reported as the root mean square of d - radial(r) u_k. The standard
deviation of radial is propagated from the covariance of all parameters by exact derivatives.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.compiling import call_compiled
from jaxphoto.short_repr import pretty_repr
from jaxphoto.stability.bundles import as_arrays, parameter_vector, with_parameters

_DIRECTIONS = 36
_STEPS = 25
NORMAL_95 = 1.959963984540054
"""Two-sided 95 % quantile of the standard normal distribution."""


@pretty_repr
class DistortionCurve(NamedTuple):
    """Distortion by distance from the principal point, in mm."""

    r: Float[np.ndarray, "steps"]
    radial: Float[np.ndarray, "steps"]
    sigma: Float[np.ndarray, "steps"] | None
    """Standard deviation of `radial`; None without a covariance."""
    other: Float[np.ndarray, "steps"]
    """Root mean square of the asymmetric part."""


def distortion_curve(
    interior: InteriorOrientation, sensor: Sensor, covariance: Float[np.ndarray, "p p"] | None
) -> DistortionCurve:
    """Compute the curve from the principal point to the nearest corner of the format.

    `covariance` is a posteriori, in the order of `parameter_names(interior)`.
    """
    half = np.array([sensor.width_mm, sensor.height_mm]) / 2
    radius = float(np.hypot(*(half - np.abs(np.asarray(interior.principal_point)))))
    r = np.linspace(0.0, radius, _STEPS)
    (radial, other), jacobian = call_compiled(_curve, as_arrays(interior), r)
    sigma = None
    if covariance is not None:
        jacobian = np.asarray(jacobian)
        sigma = np.sqrt(np.maximum(np.einsum("rp,pq,rq->r", jacobian, covariance, jacobian), 0.0))
    return DistortionCurve(r, np.asarray(radial), sigma, np.asarray(other))


@eqx.filter_jit
def _curve(
    interior: InteriorOrientation, r: Float[Array, "steps"]
) -> tuple[tuple[Float[Array, "steps"], Float[Array, "steps"]], Float[Array, "steps p"]]:
    azimuth = jnp.arange(_DIRECTIONS) * (2 * jnp.pi / _DIRECTIONS)
    u = jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth)], axis=1)

    def curves(vector):
        camera = with_parameters(interior, vector)
        # Use coordinates from the fixed principal point of the camera: its error is not distortion.
        distortion = lambda xy: xy - camera.ideal_from_measured(xy + camera.principal_point)  # noqa: E731
        d = jax.vmap(jax.vmap(distortion))(r[:, None, None] * u)
        radial = (d * u).sum(axis=2).mean(axis=1)
        rest = d - radial[:, None, None] * u
        return radial, jnp.sqrt((rest**2).sum(axis=2).mean(axis=1))

    vector = parameter_vector(interior)
    return curves(vector), jax.jacfwd(lambda v: curves(v)[0])(vector)
