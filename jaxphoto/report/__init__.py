"""Tables, plots, the HTML report and the result folder of an adjustment."""

from jaxphoto.report import figures
from jaxphoto.report.block_in_space import block_in_space
from jaxphoto.report.block_plot import layout_figure, plot_block
from jaxphoto.report.boresight import plot_boresight, print_boresight, write_boresight
from jaxphoto.report.change import plot_change
from jaxphoto.report.cubes import correlation_cube, covariance_array, draws_cube
from jaxphoto.report.draws import plot_draws, plot_effects
from jaxphoto.report.figures import *  # noqa: F403 - every picture that is defined there
from jaxphoto.report.findings import Finding, Level, Verdict
from jaxphoto.report.flight import figures as flight_figures
from jaxphoto.report.flight.figures import *  # noqa: F403
from jaxphoto.report.halves import plot_halves
from jaxphoto.report.lidar import plot_above, plot_lidar_heights
from jaxphoto.report.model_choice import plot_models
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
from jaxphoto.report.stability import plot_ray_offsets
from jaxphoto.report.strip_figures import plot_scanner_correlation, plot_strip_differences, plot_trajectory_errors
from jaxphoto.report.sweep import plot_sweep
from jaxphoto.report.table_files import TABLE_FORMATS, check_table_format, to_latex, to_markdown, write_table
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_adjustment, print_warning
from jaxphoto.report.to_plotly import to_plotly
from jaxphoto.report.verdict import verdict_of
from jaxphoto.report.weights import component_findings, component_tables, print_components

__all__ = [
    *figures.__all__, *flight_figures.__all__,
    "TABLE_FORMATS", "Finding", "Level", "Tables", "Verdict", "block_in_space", "check_points_figure",
    "check_table_format", "component_findings", "component_tables", "correlation_cube", "correlation_figure",
    "covariance_array", "draws_cube", "layout_figure", "left_out_table", "mean_residuals_figure", "new_figure",
    "page_head", "plot_above", "plot_block", "plot_boresight", "plot_change", "plot_draws", "plot_effects",
    "plot_halves", "plot_lidar_heights", "plot_models", "plot_ray_offsets", "plot_scanner_correlation",
    "plot_sensitivity", "plot_strip_differences", "plot_sweep", "plot_trajectory_errors", "prepare_pictures",
    "print_adjustment", "print_boresight", "print_components", "print_warning", "recovery_spread", "recovery_table",
    "report_page", "residuals_figure", "snooped_findings", "summary_of", "to_latex", "to_markdown", "to_plotly",
    "verdict_of", "write_boresight", "write_results", "write_table", "write_tables",
]  # fmt: skip
