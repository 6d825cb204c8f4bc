"""Common shift and drift of the GNSS positions of a flight, in addition to those of its strips."""

from typing import Any

from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters


class FlightBias(AbstractParameters):
    """Shift (m) and drift (m/s) of the GNSS positions of the whole block: a datum offset, a reference station.

    Strips may have biases in addition. One of the two then needs prior information: weighted strip biases scatter about
    that of the flight, which control determines. Time is that of the flight (`Exposure.in_flight`).
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
        """Return the sensor's position (m) with shift and drift."""
        return position + self.shift + self.drift * exposure.in_flight
