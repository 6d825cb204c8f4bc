"""Rasters: surface models, their shading, photographs and orthophotos, by rasterio (docs/surface_model.md)."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxphoto.io.raster.photograph import read_photograph, write_orthophoto
    from jaxphoto.io.raster.surface import read_dsm, write_dsm, write_hillshade

_MODULES = {
    "read_dsm": "surface", "read_photograph": "photograph", "write_dsm": "surface", "write_hillshade": "surface",
    "write_orthophoto": "photograph",
}  # fmt: skip

__all__ = ["read_dsm", "read_photograph", "write_dsm", "write_hillshade", "write_orthophoto"]


# rasterio takes a quarter of a second, and most uses of jaxphoto need no raster: imported when first asked for.
def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'jaxphoto.io.raster' has no attribute {name!r}")
    return getattr(importlib.import_module(f"jaxphoto.io.raster.{_MODULES[name]}"), name)
