"""A principal distance that changes while the camera warms up or cools down."""

import dataclasses
from typing import Any

from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters


class PrincipalDistanceRate(AbstractParameters):
    """Rate of c of one camera: c + rate t, with t from the middle of the flight (s, `Exposure.in_flight`)."""

    kind = "c_rates"
    owner = "camera"
    names = {"rate": ("c_rate_mm_per_s",)}  # noqa: RUF012
    bends = ("c",)

    rate: Float[Array, "*images"] | float

    def interior(self, interior: Any, exposure: Any) -> Any:
        """The interior orientation at the exposure."""
        return dataclasses.replace(interior, c=interior.c + self.rate * exposure.in_flight)
