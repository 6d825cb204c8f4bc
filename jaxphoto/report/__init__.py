"""Tables, plots, the HTML report and the result folder of an adjustment."""

from jaxphoto.report.boresight import print_boresight, write_boresight
from jaxphoto.report.page import STYLE, report_page
from jaxphoto.report.plots import (
    check_points_figure,
    correlation_figure,
    layout_figure,
    new_figure,
    prepare_pictures,
    residuals_figure,
)
from jaxphoto.report.results import check_target, summary_of, write_results
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_adjustment
from jaxphoto.report.verdict import warnings_of

__all__ = [
    "STYLE", "Tables", "check_points_figure", "check_target", "correlation_figure", "layout_figure", "new_figure",
    "prepare_pictures", "print_adjustment", "print_boresight", "report_page", "residuals_figure", "summary_of",
    "warnings_of", "write_boresight", "write_results",
]  # fmt: skip
