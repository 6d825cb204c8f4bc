"""Clouds of laser points: LAS, LAZ, CSV and PLY to `Cloud` and back (docs/clouds.md)."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxphoto.io.clouds.placement import Placement
    from jaxphoto.io.clouds.reader import Returns, cloud_chunks, cloud_system, extent, read_cloud
    from jaxphoto.io.clouds.system import System, frame_system
    from jaxphoto.io.clouds.writer import write_cloud

_MODULES = {
    "Placement": "placement", "Returns": "reader", "System": "system", "cloud_chunks": "reader",
    "cloud_system": "reader", "extent": "reader", "frame_system": "system", "read_cloud": "reader",
    "write_cloud": "writer",
}  # fmt: skip

__all__ = [
    "Placement", "Returns", "System", "cloud_chunks", "cloud_system", "extent", "frame_system", "read_cloud",
    "write_cloud",
]  # fmt: skip


# laspy takes a fifth of a second, and most uses of jaxphoto read no cloud: imported when first asked for.
def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'jaxphoto.io.clouds' has no attribute {name!r}")
    return getattr(importlib.import_module(f"jaxphoto.io.clouds.{_MODULES[name]}"), name)
