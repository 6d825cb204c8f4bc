"""Laser points: their index, and what is known of the ground from them."""

from jaxphoto.lidar.grid import Grid, Nearest, around, index_cloud, nearest
from jaxphoto.lidar.height_settings import HeightFlag, HeightSettings
from jaxphoto.lidar.heights import Heights, heights_at

__all__ = [
    "Grid", "HeightFlag", "HeightSettings", "Heights", "Nearest", "around", "heights_at", "index_cloud", "nearest",
]  # fmt: skip
