"""Calibration board targets in photographs: detection by OpenCV, measurement by least squares."""

from jaxphoto.extras.photos.targets.board_description import SYNTAX, CharucoBoard, Chessboard, read_board
from jaxphoto.extras.photos.targets.circles import CircleGrid
from jaxphoto.extras.photos.targets.pattern import FoundBoard, Pattern, Targets, find_targets, rendered

__all__ = [
    "SYNTAX", "CharucoBoard", "Chessboard", "CircleGrid", "FoundBoard", "Pattern",
    "Targets", "find_targets", "read_board", "rendered",
]  # fmt: skip
