"""Tables, plots, the HTML report and the result folder of an adjustment."""

from jaxphoto.report.block_in_space import block_in_space
from jaxphoto.report.block_plot import layout_figure, plot_block
from jaxphoto.report.boresight import print_boresight, write_boresight
from jaxphoto.report.cubes import correlation_cube, covariance_array, draws_cube
from jaxphoto.report.draws import plot_draws, plot_effects
from jaxphoto.report.figures import (
    plot_check_points,
    plot_convergence,
    plot_density,
    plot_distortion,
    plot_distortion_band,
    plot_error_ellipses,
    plot_exterior_correlation,
    plot_interior_correlation,
    plot_intersection_angles,
    plot_mean_residuals,
    plot_point_sigmas,
    plot_residuals,
    plot_residuals_by_radius,
    plot_sigma_map,
    plot_station_residuals,
)
from jaxphoto.report.findings import Finding, Level, Verdict
from jaxphoto.report.flight.figures import (
    plot_link_strength,
    plot_links,
    plot_overlap,
    plot_photograph_residuals,
    plot_position_offsets,
    plot_rays,
    plot_time_line,
)
from jaxphoto.report.page import report_page
from jaxphoto.report.page_head import page_head
from jaxphoto.report.plots import (
    check_points_figure,
    correlation_figure,
    mean_residuals_figure,
    new_figure,
    prepare_pictures,
    residuals_figure,
)
from jaxphoto.report.recovery import recovery_spread, recovery_table
from jaxphoto.report.results import summary_of, write_results, write_tables
from jaxphoto.report.sensitivity import plot_sensitivity
from jaxphoto.report.snooped import left_out_table, snooped_findings
from jaxphoto.report.strip_figures import plot_scanner_correlation, plot_strip_differences, plot_trajectory_errors
from jaxphoto.report.sweep import plot_sweep
from jaxphoto.report.table_files import TABLE_FORMATS, check_table_format, to_latex, to_markdown, write_table
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_adjustment, print_warning
from jaxphoto.report.to_plotly import to_plotly
from jaxphoto.report.verdict import verdict_of
from jaxphoto.report.weights import component_findings, component_tables, print_components

__all__ = [
    "TABLE_FORMATS",
    "Finding",
    "Level",
    "Tables",
    "Verdict",
    "block_in_space",
    "check_points_figure",
    "check_table_format",
    "component_findings",
    "component_tables",
    "correlation_cube",
    "correlation_figure",
    "covariance_array",
    "draws_cube",
    "layout_figure",
    "left_out_table",
    "mean_residuals_figure",
    "new_figure",
    "page_head",
    "plot_block",
    "plot_check_points",
    "plot_convergence",
    "plot_density",
    "plot_distortion",
    "plot_distortion_band",
    "plot_draws",
    "plot_effects",
    "plot_error_ellipses",
    "plot_exterior_correlation",
    "plot_interior_correlation",
    "plot_intersection_angles",
    "plot_link_strength",
    "plot_links",
    "plot_mean_residuals",
    "plot_overlap",
    "plot_photograph_residuals",
    "plot_point_sigmas",
    "plot_position_offsets",
    "plot_rays",
    "plot_residuals",
    "plot_residuals_by_radius",
    "plot_scanner_correlation",
    "plot_sensitivity",
    "plot_sigma_map",
    "plot_station_residuals",
    "plot_strip_differences",
    "plot_sweep",
    "plot_time_line",
    "plot_trajectory_errors",
    "prepare_pictures",
    "print_adjustment",
    "print_boresight",
    "print_components",
    "print_warning",
    "recovery_spread",
    "recovery_table",
    "report_page",
    "residuals_figure",
    "snooped_findings",
    "summary_of",
    "to_latex",
    "to_markdown",
    "to_plotly",
    "verdict_of",
    "write_boresight",
    "write_results",
    "write_table",
    "write_tables",
]  # fmt: skip
