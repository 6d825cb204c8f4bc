"""What came of a flight: one page that a stranger can judge it by, and a result folder for every part."""

from jaxphoto.report.flight import figures
from jaxphoto.report.flight.camera import camera_sentences
from jaxphoto.report.flight.figures import *  # noqa: F403 - every picture that is defined there
from jaxphoto.report.flight.part import PartReport, report_of
from jaxphoto.report.flight.source import FlightSource
from jaxphoto.report.flight.written import block_folder, write_flight, write_part_orientation

__all__ = [
    *figures.__all__, "FlightSource", "PartReport", "block_folder", "camera_sentences", "report_of", "write_flight",
    "write_part_orientation",
]  # fmt: skip
