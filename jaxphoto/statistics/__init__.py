"""What an adjustment is worth: covariance, correlation, reliability, significance, discrepancies."""

from jaxphoto.statistics.blunder_test import (
    LEAST_SIGMA0,
    LEVEL,
    BlunderTest,
    Suspect,
    blunder_test,
    critical_w,
    culprits,
)
from jaxphoto.statistics.correlation import (
    Correlations,
    GroundCorrelations,
    LinearForms,
    correlation_matrix,
    correlations,
    ground_correlations,
    linear_forms,
)
from jaxphoto.statistics.covariance import EOP_NAMES, Covariance, Rotations, common_covariance, covariance
from jaxphoto.statistics.discrepancy import (
    LEAST_CHECK_POINTS,
    AxisErrors,
    ComponentAccuracy,
    PositionalAccuracy,
    Spread,
    a_priori_sigmas,
    angle_differences,
    check_discrepancies,
    observation_groups,
    physical_residuals,
    point_differences,
    positional_accuracy,
    residual_spread,
    spread_of,
)
from jaxphoto.statistics.global_test import VarianceFactor, global_test, group_factors, stretch
from jaxphoto.statistics.hat_matrix import prepare_responses
from jaxphoto.statistics.quantiles import chi_square_limit
from jaxphoto.statistics.reliability import (
    DELTA0,
    LEAST_CHECKED,
    UNCHECKED,
    Felt,
    Hidden,
    Redundancy,
    UndetectedEffects,
    detectable_errors,
    error_precision,
    most_felt,
    normalised_residuals,
    prepare_statistics,
    redundancy_numbers,
    undetected_effects,
    worst_checked,
)
from jaxphoto.statistics.significance import (
    POWER,
    SIGNIFICANCE_LEVEL,
    CameraDifferences,
    CameraDrift,
    IfZero,
    Significance,
    ZeroTest,
    camera_drifts,
    camera_wanderings,
    chi_square_p,
    if_zero,
    significance,
    strip_differences,
    zero_test,
)
from jaxphoto.statistics.systematic_effects import MOST_PARTS, SURE, Hint, PatternTerm, ResidualPattern, Trend, trends
from jaxphoto.statistics.variance_components import (
    SPLITS,
    PartialRedundancy,
    Partition,
    Parts,
    Selection,
    VarianceComponents,
    partial_redundancy,
    parts_of,
    variance_components,
)

__all__ = [
    "DELTA0", "EOP_NAMES", "LEAST_CHECKED", "LEAST_CHECK_POINTS", "LEAST_SIGMA0", "LEVEL", "MOST_PARTS", "POWER",
    "SIGNIFICANCE_LEVEL", "SPLITS", "SURE", "UNCHECKED",
    "AxisErrors", "BlunderTest", "CameraDifferences", "CameraDrift",
    "ComponentAccuracy", "Correlations", "Covariance", "Felt", "GroundCorrelations", "Hidden", "Hint", "IfZero",
    "LinearForms", "PartialRedundancy", "Partition", "Parts", "PatternTerm", "PositionalAccuracy", "Redundancy",
    "ResidualPattern",
    "Rotations", "Selection", "Significance", "Spread", "Suspect", "Trend", "UndetectedEffects", "VarianceComponents",
    "VarianceFactor", "ZeroTest",
    "a_priori_sigmas", "angle_differences",
    "blunder_test", "camera_drifts", "camera_wanderings", "check_discrepancies", "chi_square_limit", "chi_square_p",
    "common_covariance",
    "correlation_matrix", "correlations", "covariance", "critical_w", "culprits", "detectable_errors",
    "error_precision",
    "global_test", "ground_correlations", "group_factors", "if_zero", "linear_forms", "most_felt",
    "normalised_residuals", "observation_groups", "partial_redundancy", "parts_of", "physical_residuals",
    "point_differences", "positional_accuracy", "prepare_responses", "prepare_statistics", "redundancy_numbers",
    "residual_spread", "significance", "spread_of", "stretch", "strip_differences", "trends",
    "undetected_effects", "variance_components", "worst_checked", "zero_test",
]  # fmt: skip
