"""A camera that changes during a flight: principal distance, principal point and K1 as straight lines of time.

With t the time (h) from the middle of the flight, the mean time of all its exposures, an exposure sees through

    c + dc t,    x_p + dx_p t,    y_p + dy_p t,    K1 + dK1 t

so that the interior orientation that is estimated beside the rates is that of the middle of the flight. A positive rate
of c is a principal distance that grows. What these can be taken for: docs/live_cameras.md.
"""

import dataclasses
from typing import Any

from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters

Scalar = Float[Array, "*images"] | float
HOUR_S = 3600.0
"""Seconds of an hour."""


class CameraRates(AbstractParameters):
    """Rates of one camera: of c, x_p and y_p in mm/h, of K1 in its own unit (mm^-2 of `Brown`) an hour.

    A distortion without a coefficient k1 has no use for the last, which then has to be held.
    """

    kind = "camera_rates"
    owner = "camera"
    names = {  # noqa: RUF012
        "c_rate": ("c_rate_mm_per_h",),
        "xp_rate": ("xp_rate_mm_per_h",),
        "yp_rate": ("yp_rate_mm_per_h",),
        "k1_rate": ("k1_rate_per_h",),
    }
    bends = ("c", "x_p", "y_p", "k1")

    c_rate: Scalar
    xp_rate: Scalar
    yp_rate: Scalar
    k1_rate: Scalar

    def interior(self, interior: Any, exposure: Any) -> Any:
        """The interior orientation at the exposure."""
        hours, distortion = exposure.in_flight / HOUR_S, interior.distortion
        if "k1" in distortion.coefficients:
            distortion = dataclasses.replace(distortion, k1=distortion.k1 + self.k1_rate * hours)
        return dataclasses.replace(
            interior,
            c=interior.c + self.c_rate * hours,
            x_p=interior.x_p + self.xp_rate * hours,
            y_p=interior.y_p + self.yp_rate * hours,
            distortion=distortion,
        )
