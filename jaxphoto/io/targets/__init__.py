"""Targets of calibration boards in photographs: found by OpenCV, placed by least squares, with standard deviations."""

from jaxphoto.io.targets.board import SYNTAX, read_board
from jaxphoto.io.targets.chessboard import Chessboard
from jaxphoto.io.targets.circle_grid import CircleGrid
from jaxphoto.io.targets.circular_targets import CircularTargets
from jaxphoto.io.targets.detection import Targets, find_targets
from jaxphoto.io.targets.markers import ArucoGrid, CharucoBoard
from jaxphoto.io.targets.pattern import Found, Pattern
from jaxphoto.io.targets.rendering import rendered

__all__ = [
    "SYNTAX", "ArucoGrid", "CharucoBoard", "Chessboard", "CircleGrid", "CircularTargets", "Found", "Pattern",
    "Targets", "find_targets", "read_board", "rendered",
]  # fmt: skip
