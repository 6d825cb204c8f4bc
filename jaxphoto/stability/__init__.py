"""Stability of a camera: comparison of interior orientations (Habib et al. 2006)."""

from jaxphoto.stability.band import LEVEL, Differences, ErrorBand, concentration, error_band, leading_unit, overlap
from jaxphoto.stability.bundles import (
    ALIGNED,
    METHODS,
    UNKNOWNS,
    Method,
    as_arrays,
    bundle_offsets,
    check_rays,
    frame_sigma,
    image_grid,
    image_rays,
    parameter_vector,
    regular_rays,
    rmse_offset,
    with_parameters,
)
from jaxphoto.stability.comparison import Analysis, Change, analyse, change, offset_uncertainty
from jaxphoto.stability.distortion_curve import NORMAL_95, DistortionCurve, distortion_curve
from jaxphoto.stability.quadratic_form import QuadraticForm

__all__ = [
    "ALIGNED", "LEVEL", "METHODS", "NORMAL_95", "UNKNOWNS", "Analysis", "Change", "Differences", "DistortionCurve",
    "ErrorBand", "Method", "QuadraticForm", "analyse", "as_arrays", "bundle_offsets", "change", "check_rays",
    "concentration", "distortion_curve", "error_band", "frame_sigma", "image_grid", "image_rays", "leading_unit",
    "offset_uncertainty", "overlap", "parameter_vector", "regular_rays", "rmse_offset", "with_parameters",
]  # fmt: skip
