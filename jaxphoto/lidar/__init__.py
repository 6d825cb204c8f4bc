"""Laser point clouds: spatial index, heights, planes, strips, surface models."""

from jaxphoto.lidar.grid import Grid, Nearest, around, index_cloud, nearest
from jaxphoto.lidar.heights import HeightFlag, Heights, HeightSettings, heights_at
from jaxphoto.lidar.planes import Patch, Plane, fit_plane, planar_patches, plane_distance, plane_feet, roof_centroid
from jaxphoto.lidar.pseudo_control import BlockControl, PseudoControl, pseudo_control_of_block, pseudo_control_points

__all__ = [
    "BlockControl", "Grid", "HeightFlag", "HeightSettings", "Heights", "Nearest", "Patch", "Plane", "PseudoControl",
    "around", "fit_plane", "heights_at", "index_cloud", "nearest", "planar_patches", "plane_distance", "plane_feet",
    "pseudo_control_of_block", "pseudo_control_points", "roof_centroid",
]  # fmt: skip
