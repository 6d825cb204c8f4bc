"""What a photogrammetrist does with a cloud: its heights or roofs as control, or everything adjusted at once."""

from jaxphoto.procedures.lidar.images_and_cloud import Simultaneous, simultaneous
from jaxphoto.procedures.lidar.roof_control import RoofControl, roof_control
from jaxphoto.procedures.lidar.until_still import Round
from jaxphoto.procedures.lidar.vertical_control import LidarControl, lidar_control

__all__ = ["LidarControl", "RoofControl", "Round", "Simultaneous", "lidar_control", "roof_control", "simultaneous"]
