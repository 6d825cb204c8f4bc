"""Targets of calibration boards in photographs: found by OpenCV, placed by least squares, with standard deviations."""

from jaxphoto.image_measurement.targets.board_description import SYNTAX, read_board
from jaxphoto.image_measurement.targets.chessboard import Chessboard
from jaxphoto.image_measurement.targets.circle_grid import CircleGrid
from jaxphoto.image_measurement.targets.circular_targets import CircularTargets
from jaxphoto.image_measurement.targets.detection import Targets, find_targets
from jaxphoto.image_measurement.targets.markers import ArucoGrid, CharucoBoard
from jaxphoto.image_measurement.targets.pattern import FoundBoard, Pattern
from jaxphoto.image_measurement.targets.rendering import rendered

__all__ = [
    "SYNTAX", "ArucoGrid", "CharucoBoard", "Chessboard", "CircleGrid", "CircularTargets", "FoundBoard", "Pattern",
    "Targets", "find_targets", "read_board", "rendered",
]  # fmt: skip
