"""Drift of a camera during a flight: principal distance and principal point as cubic B-splines of time.

n knots with spacing h are centred on the middle of the flight. At time t from the middle of the flight, the principal
distance is

    c + sum over k of c_k B(t / h - (k - (n + 1) / 2)),    k = 1 ... n

and analogously for x_p and y_p, where B is the cubic B-spline of unit knot spacing:

    B(d) = (4 - 6 d^2 + 3 |d|^3) / 6  for |d| < 1,    (2 - |d|)^3 / 6  for 1 <= |d| < 2,    0 beyond

The spline has n - 3 complete intervals; outside them, the camera is constant. The prior of the coefficients is a random
walk of q (mm^2/h) in both directions from zero in the middle of the flight: coefficients at times s and t on the same
side have the covariance q min(|s|, |t|), coefficients on opposite sides are uncorrelated. The constant interior
orientation therefore refers to the middle of the flight, up to a standard deviation of sqrt(q h) / 2.
Sources: de Boor (1978), A practical guide to splines; Gelb (1974), Applied optimal estimation.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.camera.camera_rates import HOUR_S
from jaxphoto.parameters import AbstractParameters, dynamic_fields

MOST = 100
"""Maximum number of knots of a camera; each is a parameter of all its images."""
# Maximum time (s), about thirty years: knot times remain finite.
_LONGEST_S = 1e9


class CameraSpline(AbstractParameters):
    """Spline coefficients of one camera, added to c, x_p and y_p (mm).

    `knots`: number of knots, even and at least 4. `interval_s`: knot spacing.
    """

    kind = "camera_splines"
    owner = "camera"
    names = {"c_spline": ("c_mm",), "xp_spline": ("xp_mm",), "yp_spline": ("yp_mm",)}  # noqa: RUF012
    modifies_interior = ("c", "xp", "yp")
    sized = "knots"

    c_spline: Float[Array, "knots *images"]
    xp_spline: Float[Array, "knots *images"]
    yp_spline: Float[Array, "knots *images"]
    knots: int = eqx.field(static=True, default=6)
    interval_s: float = eqx.field(static=True, default=600.0)

    def __check_init__(self) -> None:
        if type(self.knots) is not int or self.knots % 2 or not 4 <= self.knots <= MOST:
            raise ValueError(f"knots = {self.knots!r} is not an even number from 4 to {MOST}")
        if type(self.interval_s) not in (int, float) or not 0 < self.interval_s <= _LONGEST_S:
            raise ValueError(
                f"interval_s = {self.interval_s!r} is not a positive number of seconds up to {_LONGEST_S:g}"
            )

    def labels(self, owner: str) -> tuple[str, ...]:
        """Return labels such as `camera_splines[kodak].c_3_mm`."""
        ends = [self.names[field][0].split("_") for field in dynamic_fields(type(self))]
        return tuple(f"{self.kind}[{owner}].{name}_{k + 1}_{unit}" for name, unit in ends for k in range(self.knots))

    def interior(self, interior: Any, exposure: Any) -> Any:
        """Return the interior orientation at the exposure."""
        weights = self.weights(exposure.in_flight)
        c, x_p, y_p = (jnp.sum(weights * v) for v in (self.c_spline, self.xp_spline, self.yp_spline))
        return dataclasses.replace(interior, c=interior.c + c, xp=interior.xp + x_p, yp=interior.yp + y_p)

    def weights(self, time: ArrayLike | float) -> Float[ArrayLike, "knots"]:
        """Return the weight of each knot at a time from the middle of the flight (s)."""
        end = (self.knots - 3) / 2
        d = jnp.abs(jnp.clip(time / self.interval_s, -end, end) - self.times / self.interval_s)
        near, far = (4 - 6 * d**2 + 3 * d**3) / 6, jnp.maximum(2 - d, 0.0) ** 3 / 6
        return jnp.where(d < 1, near, far)

    @property
    def times(self) -> Float[np.ndarray, "knots"]:
        """Return the time (s) of the largest weight of each knot, from the middle of the flight."""
        return (np.arange(self.knots) - (self.knots - 1) / 2) * self.interval_s

    @property
    def walk(self) -> Float[np.ndarray, "knots knots"]:
        """Return the prior covariance (mm^2) of the coefficients for a random walk of 1 mm^2/h."""
        hours = self.times / HOUR_S
        least = np.minimum(np.abs(hours)[:, None], np.abs(hours))
        return np.where(np.sign(hours)[:, None] == np.sign(hours), least, 0.0)
