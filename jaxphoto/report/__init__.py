"""Tables, plots, the HTML report and the result folder of an adjustment."""

from jaxphoto.report.boresight import print_boresight, write_boresight
from jaxphoto.report.findings import Finding, Level, Verdict
from jaxphoto.report.page import report_page
from jaxphoto.report.plots import (
    check_points_figure,
    correlation_figure,
    layout_figure,
    mean_residuals_figure,
    new_figure,
    prepare_pictures,
    residuals_figure,
)
from jaxphoto.report.results import summary_of, write_results
from jaxphoto.report.snooped import left_out_table, snooped_findings
from jaxphoto.report.style import STYLE
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_adjustment, print_warning
from jaxphoto.report.verdict import verdict_of
from jaxphoto.report.weights import component_findings, component_tables, print_components

__all__ = [
    "STYLE",
    "Finding",
    "Level",
    "Tables",
    "Verdict",
    "check_points_figure",
    "component_findings",
    "component_tables",
    "correlation_figure",
    "layout_figure",
    "left_out_table",
    "mean_residuals_figure",
    "new_figure",
    "prepare_pictures",
    "print_adjustment",
    "print_boresight",
    "print_components",
    "print_warning",
    "report_page",
    "residuals_figure",
    "snooped_findings",
    "summary_of",
    "verdict_of",
    "write_boresight",
    "write_results",
]  # fmt: skip
