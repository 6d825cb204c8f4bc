"""The distortion of a camera against the distance from its principal point, and how sure it is.

With the directions u_k, as many as there are here, at the measured distance r from the principal point,

    radial(r) = mean over k of u_k . d(r u_k),   d = measured - ideal

is the radial distortion of the part that is alike all around, in the image of the calibrated c (Brown 1971): another c
would add a straight line to it. What is not alike, decentring and affinity, is the root mean square of d without
radial(r) u_k. The band of radial is that of the covariance of all parameters, by exact derivatives.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.compiling import call_compiled
from jaxphoto.short_repr import shown
from jaxphoto.stability.bundles import parameter_vector, with_parameters

_DIRECTIONS = 36
_STEPS = 25
NORMAL_95 = 1.959963984540054
"""Of a normal variable, 95 % are within so many standard deviations."""


@shown
class DistortionCurve(NamedTuple):
    """Distortion by distance from the principal point; mm."""

    r: Float[np.ndarray, "steps"]
    radial: Float[np.ndarray, "steps"]
    sigma: Float[np.ndarray, "steps"] | None
    """Of `radial`; None where no covariance is known."""
    other: Float[np.ndarray, "steps"]
    """Root mean square of what is not radial and alike all around."""


def distortion_curve(
    interior: InteriorOrientation, sensor: Sensor, covariance: Float[np.ndarray, "p p"] | None
) -> DistortionCurve:
    """The curve from the principal point to the corner of the format that is nearest to it.

    `covariance` is that of `parameter_names(interior)`, a posteriori.
    """
    half = np.array([sensor.width_mm, sensor.height_mm]) / 2
    farthest = float(np.hypot(*(half - np.abs(np.asarray(interior.principal_point)))))
    r = np.linspace(0.0, farthest, _STEPS)
    # Numbers as arrays, so that another value is not another program.
    arrays = jax.tree.map(lambda v: jnp.asarray(v, float), interior)
    (radial, other), jacobian = call_compiled(_curve, arrays, jnp.asarray(r))
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
        # From the principal point as it is: where it lies is no distortion.
        at = lambda xy: xy - camera.ideal_from_measured(xy + camera.principal_point)  # noqa: E731
        d = jax.vmap(jax.vmap(at))(r[:, None, None] * u)
        along = (d * u).sum(axis=2).mean(axis=1)
        rest = d - along[:, None, None] * u
        return along, jnp.sqrt((rest**2).sum(axis=2).mean(axis=1))

    vector = parameter_vector(interior)
    return curves(vector), jax.jacfwd(lambda v: curves(v)[0])(vector)
