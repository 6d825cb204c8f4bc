"""Procedures with a point cloud: heights or roofs as control, simultaneous adjustment, strip adjustment."""

from jaxphoto.procedures.lidar.images_and_cloud import Simultaneous, simultaneous
from jaxphoto.procedures.lidar.iterate_to_convergence import Round
from jaxphoto.procedures.lidar.roof_control import RoofControl, roof_control
from jaxphoto.procedures.lidar.strip_adjustment import StripAdjustment, StripDifference, StripRound, adjust_strips
from jaxphoto.procedures.lidar.strip_model import Photographs, ScannerPriors
from jaxphoto.procedures.lidar.vertical_control import LidarControl, lidar_control

__all__ = [
    "LidarControl", "Photographs", "RoofControl", "Round", "ScannerPriors", "Simultaneous", "StripAdjustment",
    "StripDifference", "StripRound", "adjust_strips", "lidar_control", "roof_control", "simultaneous",
]  # fmt: skip
