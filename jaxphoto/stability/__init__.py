"""How alike two interior orientations are: the stability of a camera (Habib et al. 2006)."""

from jaxphoto.stability.alignment import ALIGNED, METHODS, UNKNOWNS, Method
from jaxphoto.stability.analysis import Analysis, analyse
from jaxphoto.stability.band import Differences, ErrorBand, band_of, concentration, leading_unit, overlap
from jaxphoto.stability.bundles import image_grid, image_rays, parameter_vector, with_parameters
from jaxphoto.stability.change import Change, ParameterChange, change, mahalanobis
from jaxphoto.stability.combination import Combination, combine
from jaxphoto.stability.comparison import BundleOffsets, bundle_offsets, check_rays, regular_rays, rmse_offset
from jaxphoto.stability.distortion_curve import NORMAL_95, DistortionCurve, distortion_curve
from jaxphoto.stability.format_sigma import format_sigma
from jaxphoto.stability.quadratic_form import QuadraticForm
from jaxphoto.stability.uncertainty import LEVEL, OffsetUncertainty, offset_uncertainty

__all__ = [
    "ALIGNED", "LEVEL", "METHODS", "NORMAL_95", "UNKNOWNS", "Analysis", "BundleOffsets", "Change", "Combination",
    "Differences", "DistortionCurve", "ErrorBand",
    "Method", "OffsetUncertainty", "ParameterChange", "QuadraticForm", "analyse", "band_of", "bundle_offsets",
    "change", "check_rays", "combine", "concentration", "distortion_curve", "format_sigma", "image_grid",
    "image_rays", "leading_unit", "mahalanobis", "offset_uncertainty", "overlap", "parameter_vector", "regular_rays",
    "rmse_offset", "with_parameters",
]  # fmt: skip
