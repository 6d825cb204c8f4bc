"""Clouds of laser points: LAS, LAZ, CSV and PLY to `Cloud` and back (docs/clouds.md)."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxphoto.io.clouds.cloud_reader import (
        Returns,
        cloud_chunks,
        cloud_system,
        extent,
        read_cloud,
        read_whole_and_chosen,
    )
    from jaxphoto.io.clouds.cloud_writer import write_cloud
    from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, frame_system
    from jaxphoto.io.clouds.placement import Placement

_MODULES = {
    "CoordinateSystem": "coordinate_system", "Placement": "placement", "Returns": "cloud_reader",
    "cloud_chunks": "cloud_reader", "cloud_system": "cloud_reader", "extent": "cloud_reader",
    "frame_system": "coordinate_system", "read_cloud": "cloud_reader", "read_whole_and_chosen": "cloud_reader",
    "write_cloud": "cloud_writer",
}  # fmt: skip

__all__ = [
    "CoordinateSystem",
    "Placement",
    "Returns",
    "cloud_chunks",
    "cloud_system",
    "extent",
    "frame_system",
    "read_cloud",
    "read_whole_and_chosen",
    "write_cloud",
]  # fmt: skip


# laspy takes a fifth of a second, and most uses of jaxphoto read no cloud: imported when first asked for.
def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'jaxphoto.io.clouds' has no attribute {name!r}")
    return getattr(importlib.import_module(f"jaxphoto.io.clouds.{_MODULES[name]}"), name)
