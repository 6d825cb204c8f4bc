"""Linear change of a camera during a flight: principal distance, principal point and K1.

For time or temperature t of the camera, the interior orientation of an exposure is

    c + dc t,    x_p + dx_p t,    y_p + dy_p t,    K1 + dK1 t

Time is in hours from the middle of the flight, the mean time of all exposures; temperature in kelvins from the
reference of the block (`Temperatures`), by default the mean of all exposures. The interior orientation estimated
together with the rates refers to the middle of the flight or to the reference temperature. A positive rate of c is an
increasing principal distance. Effects that rates may absorb: docs/time_dependent_cameras.md.
"""

import abc
import dataclasses
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters

Scalar = Float[Array, "*images"] | float
HOUR_S = 3600.0
"""Seconds per hour."""


class AbstractCameraRates(AbstractParameters):
    """Rates of change of one camera per unit of `along`: c, x_p, y_p in mm, K1 in its own unit (mm^-2 for `Brown`).

    K1 must be fixed if the distortion has no coefficient k1.
    """

    along: eqx.AbstractClassVar[str]
    """Name of the independent variable, followed by its unit."""
    owner = "camera"
    modifies_interior = ("c", "xp", "yp", "k1")

    c_rate: Scalar
    xp_rate: Scalar
    yp_rate: Scalar
    k1_rate: Scalar

    @staticmethod
    @abc.abstractmethod
    def argument(exposure: Any) -> Any:
        """Return the independent variable of one or more exposures, relative to the reference of the camera."""

    def interior(self, interior: Any, exposure: Any) -> Any:
        """Return the interior orientation at the exposure."""
        t, distortion = self.argument(exposure), interior.distortion
        if "k1" in distortion.coefficients:
            distortion = dataclasses.replace(distortion, k1=distortion.k1 + self.k1_rate * t)
        return dataclasses.replace(
            interior,
            c=interior.c + self.c_rate * t,
            xp=interior.xp + self.xp_rate * t,
            yp=interior.yp + self.yp_rate * t,
            distortion=distortion,
        )


class CameraRates(AbstractCameraRates):
    """Rates of change of one camera per hour."""

    kind = "camera_rates"
    along = "time_h"
    names = {  # noqa: RUF012
        "c_rate": ("c_rate_mm_per_h",),
        "xp_rate": ("xp_rate_mm_per_h",),
        "yp_rate": ("yp_rate_mm_per_h",),
        "k1_rate": ("k1_rate_per_h",),
    }

    @staticmethod
    def argument(exposure: Any) -> Any:
        """Return the time (h) from the middle of the flight."""
        return exposure.in_flight / HOUR_S


class ThermalRates(AbstractCameraRates):
    """Rates of change of one camera per kelvin of its temperature.

    Source: Smith and Cope (2010), The effects of temperature variation on single-lens-reflex digital camera calibration
    parameters, ISPRS Archives 38 (5).
    """

    kind = "thermal_rates"
    along = "temperature_K"
    names = {  # noqa: RUF012
        "c_rate": ("c_rate_mm_per_K",),
        "xp_rate": ("xp_rate_mm_per_K",),
        "yp_rate": ("yp_rate_mm_per_K",),
        "k1_rate": ("k1_rate_per_K",),
    }

    @staticmethod
    def argument(exposure: Any) -> Any:
        """Return the temperature difference (K) from the reference of the block."""
        return exposure.temperature


RATES: tuple[type[AbstractCameraRates], ...] = (CameraRates, ThermalRates)
"""All classes of linear change."""
