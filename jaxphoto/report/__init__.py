"""Tables, plots, the HTML report and the result folder of an adjustment."""

from typing import TYPE_CHECKING

from jaxphoto.later import later

if TYPE_CHECKING:
    from jaxphoto.report.block_plot import plot_block
    from jaxphoto.report.boresight import plot_boresight, print_boresight, write_boresight
    from jaxphoto.report.draws import plot_draws, plot_effects
    from jaxphoto.report.findings import Finding, Verdict
    from jaxphoto.report.flight import plot_position_offsets
    from jaxphoto.report.formatting import (
        TABLE_FORMATS,
        check_table_format,
        readable,
        to_latex,
        to_markdown,
        write_table,
    )
    from jaxphoto.report.lidar import plot_above, plot_lidar_heights
    from jaxphoto.report.model_choice import plot_models
    from jaxphoto.report.plots import (
        check_points_figure,
        correlation_figure,
        new_figure,
        plot_check_points,
        plot_convergence,
        plot_distortion,
        plot_error_ellipses,
        plot_exterior_correlation,
        plot_interior_correlation,
        plot_intersection_angles,
        plot_links,
        plot_mean_residuals,
        plot_overlap,
        plot_residuals,
        plot_residuals_by_radius,
        plot_sigma_map,
        plot_station_residuals,
        plot_w,
        plot_w_quantiles,
        prepare_pictures,
    )
    from jaxphoto.report.residual_findings import component_findings, component_tables, left_out_table, snooped_findings
    from jaxphoto.report.results import report_page, summary_of, write_results, write_tables
    from jaxphoto.report.sensitivity import plot_sensitivity
    from jaxphoto.report.stability import plot_change, plot_halves, plot_ray_offsets
    from jaxphoto.report.strips import plot_scanner_correlation, plot_strip_differences, plot_trajectory_errors
    from jaxphoto.report.sweep import plot_sweep
    from jaxphoto.report.tables import Tables, recovery_spread, recovery_table
    from jaxphoto.report.terminal import print_adjustment, print_components, print_warning
    from jaxphoto.report.verdict import verdict_of

__all__ = [
    "TABLE_FORMATS", "Finding", "Tables", "Verdict", "check_points_figure", "check_table_format",
    "component_findings", "component_tables", "correlation_figure", "left_out_table", "new_figure", "plot_above",
    "plot_block", "plot_boresight", "plot_change", "plot_check_points", "plot_convergence",
    "plot_distortion",  "plot_draws", "plot_effects", "plot_error_ellipses",
    "plot_exterior_correlation", "plot_halves", "plot_interior_correlation", "plot_intersection_angles",
    "plot_lidar_heights", "plot_links", "plot_mean_residuals", "plot_models", "plot_overlap",
    "plot_position_offsets", "plot_ray_offsets", "plot_residuals", "plot_residuals_by_radius",
    "plot_scanner_correlation", "plot_sensitivity", "plot_sigma_map", "plot_station_residuals",
    "plot_strip_differences", "plot_sweep", "plot_trajectory_errors", "plot_w", "plot_w_quantiles",
    "prepare_pictures", "print_adjustment", "print_boresight", "print_components", "print_warning", "readable",
    "recovery_spread", "recovery_table", "report_page", "snooped_findings", "summary_of", "to_latex", "to_markdown",
    "verdict_of", "write_boresight", "write_results", "write_table", "write_tables",
]  # fmt: skip

__getattr__, __dir__ = later(__name__)
