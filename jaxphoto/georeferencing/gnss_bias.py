"""Shift and drift of the GNSS positions per strip and of the whole flight."""

from typing import Any

from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters


class StripBias(AbstractParameters):
    """Shift (m) and drift (m/s), per axis, of the GNSS positions of one strip."""

    kind = "strips"
    owner = "strip"
    names = {  # noqa: RUF012
        "shift": tuple(f"shift_{axis}_m" for axis in "XYZ"),
        "drift": tuple(f"drift_{axis}_m_per_s" for axis in "XYZ"),
    }

    shift: Float[Array, "3 *images"]
    drift: Float[Array, "3 *images"]


class FlightBias(AbstractParameters):
    """Shift (m) and drift (m/s) of the GNSS positions of the whole block, due to the datum or the reference station.

    Strips may have additional biases. Strip or flight biases then need prior information: weighted strip biases scatter
    about the flight bias, which control determines. Time is measured from the middle of the flight
    (`Exposure.in_flight`).
    """

    kind = "flight_bias"
    owner = "block"
    names = {  # noqa: RUF012
        "shift": tuple(f"shift_{axis}_m" for axis in "XYZ"),
        "drift": tuple(f"drift_{axis}_m_per_s" for axis in "XYZ"),
    }

    shift: Float[Array, "3 *images"]
    drift: Float[Array, "3 *images"]

    def station(self, position: Any, exposure: Any) -> Any:
        """Add shift and drift to the sensor's position (m)."""
        return position + self.shift + self.drift * exposure.in_flight
