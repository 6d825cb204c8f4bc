"""Point clouds: LAS, LAZ, COPC, CSV and PLY to `Cloud` and back (docs/clouds.md)."""

from jaxphoto.io.clouds.cloud_reader import (
    EVERY_CLASS,
    Returns,
    cloud_chunks,
    cloud_system,
    extent,
    point_count,
    read_cloud,
    selection,
)
from jaxphoto.io.clouds.cloud_writer import rewrite_cloud, write_cloud
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, Placement, frame_system

__all__ = [
    "EVERY_CLASS", "CoordinateSystem", "Placement", "Returns", "cloud_chunks", "cloud_system", "extent",
    "frame_system", "point_count", "read_cloud", "rewrite_cloud", "selection", "write_cloud",
]  # fmt: skip
