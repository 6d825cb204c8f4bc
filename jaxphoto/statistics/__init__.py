"""What an adjustment is worth: covariance, correlation, reliability, significance, discrepancies."""

from jaxphoto.statistics.correlation import Correlations, correlation_matrix, correlations
from jaxphoto.statistics.covariance import EOP_NAMES, Covariance, Rotations, covariance
from jaxphoto.statistics.discrepancy import (
    Spread,
    a_priori_sigmas,
    angle_differences,
    check_discrepancies,
    observation_groups,
    physical_residuals,
    point_differences,
    residual_spread,
    spread_of,
)
from jaxphoto.statistics.reliability import (
    LEAST_CHECKED,
    Redundancy,
    error_precision,
    normalised_residuals,
    prepare_statistics,
    redundancy_numbers,
)
from jaxphoto.statistics.significance import (
    SIGNIFICANT_RATIO,
    Significance,
    chi_square_p,
    critical_value,
    significance,
)

__all__ = [
    "EOP_NAMES", "LEAST_CHECKED", "SIGNIFICANT_RATIO", "Correlations", "Covariance", "Redundancy", "Rotations",
    "Significance", "Spread", "a_priori_sigmas", "angle_differences", "check_discrepancies", "chi_square_p",
    "correlation_matrix", "correlations", "covariance", "critical_value", "error_precision", "normalised_residuals",
    "observation_groups", "physical_residuals", "point_differences", "prepare_statistics", "redundancy_numbers",
    "residual_spread", "significance", "spread_of",
]  # fmt: skip
