"""What a certificate of calibration is made of: a result folder, as it was read."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.camera.conditions import Conditions
from jaxphoto.statistics import AxisErrors
from jaxphoto.writing.inputs import InputFile


class LastCalibration(NamedTuple):
    """An earlier calibration of the same camera."""

    name: str
    interior: InteriorOrientation
    covariance: Float[np.ndarray, "q q"] | None
    input: InputFile
    """The file that it was read from."""
    shared: bool = False
    """Whether it is of the same photographs, or of some of them."""


class FormatBand(NamedTuple):
    """What `jaxphoto halves` found of the same camera: 95 % of the errors by place in the format."""

    cells_mm: Float[np.ndarray, "cells 2"]
    band_px: Float[np.ndarray, "cells"]
    factor: float
    sigma_factor: float
    input: InputFile


class ExteriorCorrelation(NamedTuple):
    """Of one exterior with one interior parameter over all images."""

    exterior: str
    interior: str
    mean_abs: float
    max_abs: float


class Certified(NamedTuple):
    """A calibrated camera, and all that is known of how it was calibrated."""

    camera: str
    sensor: Sensor
    interior: InteriorOrientation
    covariance: Float[np.ndarray, "p p"] | None
    """A posteriori, of `parameter_names(interior)`, zero where held."""
    summary: Mapping[str, Any]
    """summary.json."""
    with_exterior: Sequence[ExteriorCorrelation]
    conditions: Sequence[Conditions]
    """Of photographs, where their files were read; none otherwise."""
    inputs: Sequence[InputFile]
    all_inputs: bool
    """Whether the results tell all files that they were made of; the photographs alone are not all."""
    last: LastCalibration | None = None
    band: FormatBand | None = None

    @property
    def sigma_factor(self) -> float:
        """By what sigmas are to be multiplied because neighbouring rays err alike; 1 where nothing says so."""
        told = self.summary.get("sigma_factor", 1.0)
        return float(told) if isinstance(told, int | float) and math.isfinite(told) and told > 1 else 1.0

    @property
    def shifted_axes(self) -> list[str]:
        """Axes in which the mean error of check points has to be looked into."""
        found = []
        for axis, of in dict(self.summary.get("check_points", {})).items():
            n, mean, rmse = (of.get(key, math.nan) for key in ("n", "mean_m", "rmse_m"))
            if AxisErrors(axis, n, mean, rmse).biased:
                found.append(axis)
        return found
