"""A camera that changes during a flight: principal distance, principal point and K1 as straight lines.

Along time or along the temperature of the camera, t, an exposure sees through

    c + dc t,    x_p + dx_p t,    y_p + dy_p t,    K1 + dK1 t

Time counts in hours from the middle of the flight, the mean time of all its exposures; temperature in kelvins from the
reference of the block (`Temperatures`), the mean of all exposures unless it names another. So the interior orientation
that is estimated beside the rates is that of the middle of the flight, or at the reference temperature. A positive rate
of c is a principal distance that grows. What these can be taken for: docs/live_cameras.md.
"""

import abc
import dataclasses
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from jaxphoto.parameters import AbstractParameters

Scalar = Float[Array, "*images"] | float
HOUR_S = 3600.0
"""Seconds of an hour."""


class AbstractCameraRates(AbstractParameters):
    """Rates of one camera: of c, x_p, y_p in mm, of K1 in its own unit (mm^-2 of `Brown`), over the unit of `along`.

    A distortion without a coefficient k1 has no use for the last, which then has to be held.
    """

    along: eqx.AbstractClassVar[str]
    """What a camera changes with: a word, and after it the unit."""
    owner = "camera"
    bends = ("c", "x_p", "y_p", "k1")

    c_rate: Scalar
    xp_rate: Scalar
    yp_rate: Scalar
    k1_rate: Scalar

    @staticmethod
    @abc.abstractmethod
    def argument(exposure: Any) -> Any:
        """How far the exposure (or each of many) is along the line, from where the interior orientation holds."""

    def interior(self, interior: Any, exposure: Any) -> Any:
        """The interior orientation at the exposure."""
        t, distortion = self.argument(exposure), interior.distortion
        if "k1" in distortion.coefficients:
            distortion = dataclasses.replace(distortion, k1=distortion.k1 + self.k1_rate * t)
        return dataclasses.replace(
            interior,
            c=interior.c + self.c_rate * t,
            x_p=interior.x_p + self.xp_rate * t,
            y_p=interior.y_p + self.yp_rate * t,
            distortion=distortion,
        )


class CameraRates(AbstractCameraRates):
    """Rates of one camera in an hour."""

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
        """Hours from the middle of the flight."""
        return exposure.in_flight / HOUR_S


class ThermalRates(AbstractCameraRates):
    """Rates of one camera with its temperature, for a kelvin.

    Source: Smith and Cope (2010), The effects of temperature variation on single-lens-reflex digital camera
    calibration parameters, ISPRS Archives 38 (5).
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
        """Kelvins above the reference of the block."""
        return exposure.temperature


RATES: tuple[type[AbstractCameraRates], ...] = (CameraRates, ThermalRates)
"""All that a camera may change with along a line."""
