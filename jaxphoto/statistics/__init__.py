"""What an adjustment is worth: covariance, correlation, reliability, significance, discrepancies."""

from jaxphoto.statistics.blunder_test import (
    DELTA0,
    LEAST_SIGMA0,
    LEVEL,
    BlunderTest,
    Hidden,
    Suspect,
    blunder_test,
    critical_w,
    detectable_errors,
    worst_checked,
)
from jaxphoto.statistics.camera_drift import (
    CameraDifferences,
    CameraDrift,
    camera_drifts,
    camera_wanderings,
    strip_differences,
)
from jaxphoto.statistics.common_observations import common_covariance
from jaxphoto.statistics.correlation import Correlations, correlation_matrix, correlations
from jaxphoto.statistics.covariance import EOP_NAMES, Covariance, Rotations, covariance
from jaxphoto.statistics.culprits import culprits
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
from jaxphoto.statistics.global_test import VarianceFactor, global_test, group_factors, stretch
from jaxphoto.statistics.ground import GroundCorrelations, ground_correlations
from jaxphoto.statistics.linear_forms import LinearForms, linear_forms
from jaxphoto.statistics.partial_redundancy import PartialRedundancy, partial_redundancy
from jaxphoto.statistics.partition import SPLITS, Partition, Parts, Selection, parts_of
from jaxphoto.statistics.patterns import MOST_PARTS, PatternTerm, ResidualPattern
from jaxphoto.statistics.positional_accuracy import (
    LEAST_CHECK_POINTS,
    AxisErrors,
    ComponentAccuracy,
    PositionalAccuracy,
    positional_accuracy,
)
from jaxphoto.statistics.quantiles import chi_square_limit
from jaxphoto.statistics.reliability import (
    LEAST_CHECKED,
    UNCHECKED,
    Redundancy,
    error_precision,
    normalised_residuals,
    prepare_statistics,
    redundancy_numbers,
)
from jaxphoto.statistics.responses import prepare_responses
from jaxphoto.statistics.significance import (
    SIGNIFICANCE_LEVEL,
    IfZero,
    Significance,
    chi_square_p,
    if_zero,
    significance,
)
from jaxphoto.statistics.trends import SURE, Hint, Trend, trends
from jaxphoto.statistics.undetected import Felt, UndetectedEffects, most_felt, undetected_effects
from jaxphoto.statistics.variance_components import VarianceComponents, variance_components
from jaxphoto.statistics.zero_test import POWER, ZeroTest, zero_test

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
