"""Clouds of laser points: LAS, LAZ, CSV and PLY to `Cloud` and back (docs/clouds.md)."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxphoto.io.clouds.cloud_reader import (
        EVERY_CLASS,
        Returns,
        chosen_of,
        cloud_chunks,
        cloud_system,
        extent,
        most_points,
        read_cloud,
    )
    from jaxphoto.io.clouds.cloud_writer import rewrite_cloud, write_cloud
    from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, frame_system
    from jaxphoto.io.clouds.placement import Placement

_MODULES = {
    "CoordinateSystem": "coordinate_system", "EVERY_CLASS": "cloud_reader", "Placement": "placement",
    "Returns": "cloud_reader", "chosen_of": "cloud_reader", "cloud_chunks": "cloud_reader",
    "cloud_system": "cloud_reader", "extent": "cloud_reader", "frame_system": "coordinate_system",
    "most_points": "cloud_reader", "read_cloud": "cloud_reader", "rewrite_cloud": "cloud_writer",
    "write_cloud": "cloud_writer",
}  # fmt: skip

__all__ = [
    "EVERY_CLASS",
    "CoordinateSystem",
    "Placement",
    "Returns",
    "chosen_of",
    "cloud_chunks",
    "cloud_system",
    "extent",
    "frame_system",
    "most_points",
    "read_cloud",
    "rewrite_cloud",
    "write_cloud",
]  # fmt: skip


# laspy takes a fifth of a second, and most uses of jaxphoto read no cloud: imported when first asked for.
def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'jaxphoto.io.clouds' has no attribute {name!r}")
    return getattr(importlib.import_module(f"jaxphoto.io.clouds.{_MODULES[name]}"), name)
