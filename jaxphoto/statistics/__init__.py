"""Statistics of an adjustment: covariance, reliability, blunder tests, significance, variance components."""

from jaxphoto.statistics.blunder_test import (
    LEAST_SIGMA0,
    LEVEL,
    BlunderTest,
    Suspect,
    blunder_test,
    critical_w,
    multiple_outlier_test,
)
from jaxphoto.statistics.correlated_noise import CorrelatedNoise, correlated_noise
from jaxphoto.statistics.correlation import (
    Correlations,
    GroundCorrelations,
    correlation_matrix,
    correlations,
    ground_correlations,
    linear_forms,
)
from jaxphoto.statistics.covariance import EOP_NAMES, Covariance, Rotations, common_covariance, covariance
from jaxphoto.statistics.discrepancy import (
    AxisErrors,
    a_priori_sigmas,
    angle_differences,
    check_discrepancies,
    observation_groups,
    physical_residuals,
    point_differences,
    residual_spread,
)
from jaxphoto.statistics.error_sizes import ErrorSizes, error_sizes
from jaxphoto.statistics.global_test import (
    VarianceFactor,
    expected_residual_scale,
    global_test,
    group_factors,
    p_value_of_excess,
    part_factors,
)
from jaxphoto.statistics.hat_matrix import prepare_hat_matrix
from jaxphoto.statistics.quantiles import chi_square_limit
from jaxphoto.statistics.reliability import (
    DELTA0,
    LEAST_CHECKED,
    UNCHECKED,
    MdbEffects,
    Redundancy,
    largest_interior_effects,
    largest_mdbs,
    mdb_effects,
    minimal_detectable_biases,
    normalised_residuals,
    prepare_statistics,
    redundancy_numbers,
)
from jaxphoto.statistics.significance import (
    SIGNIFICANCE_LEVEL,
    CameraDifferences,
    CameraDrift,
    Significance,
    ZeroTest,
    camera_drifts,
    camera_spline_differences,
    chi_square_p,
    fix_at_zero,
    significance,
    strip_differences,
)
from jaxphoto.statistics.systematic_effects import (
    MAX_GROUPS,
    SIGNIFICANT_RATIO,
    EffectTerm,
    EffectTest,
    SystematicEffect,
    TermEstimate,
    systematic_effect_tests,
)
from jaxphoto.statistics.variance_components import (
    SPLITS,
    Partition,
    Parts,
    Selection,
    VarianceComponents,
    partial_redundancy,
    partition_observations,
    variance_components,
)

__all__ = [
    "DELTA0", "EOP_NAMES", "LEAST_CHECKED", "LEAST_SIGMA0", "LEVEL", "MAX_GROUPS",
    "SIGNIFICANCE_LEVEL", "SIGNIFICANT_RATIO", "SPLITS", "UNCHECKED", "AxisErrors", "BlunderTest",
    "CameraDifferences", "CameraDrift", "CorrelatedNoise", "Correlations", "Covariance", "EffectTerm",
    "EffectTest", "ErrorSizes", "GroundCorrelations", "MdbEffects", "Partition", "Parts", "Redundancy", "Rotations",
    "Selection", "Significance", "Suspect", "SystematicEffect", "TermEstimate", "VarianceComponents", "VarianceFactor",
    "ZeroTest",
    "a_priori_sigmas", "angle_differences", "blunder_test", "camera_drifts", "camera_spline_differences",
    "check_discrepancies", "chi_square_limit", "chi_square_p", "common_covariance", "correlated_noise",
    "correlation_matrix", "correlations", "covariance", "critical_w", "error_sizes", "expected_residual_scale",
    "fix_at_zero", "global_test", "ground_correlations", "group_factors", "largest_interior_effects",
    "largest_mdbs", "linear_forms", "mdb_effects", "minimal_detectable_biases", "multiple_outlier_test",
    "normalised_residuals", "observation_groups", "p_value_of_excess", "part_factors", "partial_redundancy",
    "partition_observations", "physical_residuals", "point_differences", "prepare_hat_matrix", "prepare_statistics",
    "redundancy_numbers", "residual_spread", "significance", "strip_differences", "systematic_effect_tests",
    "variance_components",
]  # fmt: skip
