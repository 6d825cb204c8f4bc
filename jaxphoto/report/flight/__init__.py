"""What came of a flight: one page that a stranger can judge it by, and a result folder for every part."""

from jaxphoto.report.flight.camera import camera_sentences
from jaxphoto.report.flight.figures import (
    plot_link_strength,
    plot_links,
    plot_overlap,
    plot_photograph_residuals,
    plot_position_offsets,
    plot_rays,
    plot_time_line,
)
from jaxphoto.report.flight.part import PartReport, report_of
from jaxphoto.report.flight.source import FlightSource
from jaxphoto.report.flight.written import block_folder, write_flight, write_part_orientation

__all__ = [
    "FlightSource", "PartReport", "block_folder", "camera_sentences", "plot_link_strength", "plot_links",
    "plot_overlap", "plot_photograph_residuals", "plot_position_offsets", "plot_rays", "plot_time_line", "report_of",
    "write_flight", "write_part_orientation",
]  # fmt: skip
