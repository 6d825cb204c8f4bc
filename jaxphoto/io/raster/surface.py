"""Surface models as GeoTIFF, and their shading as a picture."""

from pathlib import Path

import numpy as np
import rasterio
from jaxtyping import Float
from pyproj import CRS
from rasterio.enums import Interleaving

from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import check_file
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, epsg_system, system_of
from jaxphoto.io.picture_size import check_pixels
from jaxphoto.io.raster.opened import opened_raster
from jaxphoto.io.raster.whole_raster import whole_raster
from jaxphoto.lidar.raster import Raster

_NODATA = -9999.0
_TILE = 256
# In memory, of a cell that is read: its height in double precision besides what the file has.
_BYTES = 16


def write_dsm(path: str | Path, raster: Raster, system: CoordinateSystem = CoordinateSystem()) -> None:  # noqa: B008
    """Write a surface model as GeoTIFF: float32 heights (m), tiled, compressed without loss; whole or not at all.

    `system` is that of its coordinates; a local frame writes none. Cells without height are nodata (-9999).
    """
    heights = np.where(np.isnan(raster.heights), _NODATA, raster.heights).astype(np.float32)
    kind = {**layout(raster, system), "dtype": "float32", "count": 1, "nodata": _NODATA, "predictor": 3}
    with whole_raster(path, **kind) as file:
        file.write(heights, 1)
        file.units = ("metre",)
        file.set_band_description(1, "height")


def layout(raster: Raster, system: CoordinateSystem) -> dict:
    """What every GeoTIFF on the cells of `raster` has in common, as rasterio wants it."""
    rows, columns = raster.heights.shape
    return {
        "driver": "GTiff",
        "height": rows,
        "width": columns,
        "transform": rasterio.Affine(raster.cell_m, 0, raster.west, 0, -raster.cell_m, raster.north),
        "crs": None if system.metric is None else rasterio.crs.CRS.from_wkt(system.metric.to_wkt()),
        "tiled": True,
        "blockxsize": _TILE,
        "blockysize": _TILE,
        "compress": "deflate",
        "BIGTIFF": "IF_SAFER",
    }


def read_dsm(path: str | Path, epsg: int | None = None) -> tuple[Raster, CoordinateSystem]:
    """The surface model in the first band of a raster, in metres, and the system of its coordinates.

    `epsg` names the system in place of what the file says. Raises InputError for a file that is no raster or damaged,
    without place, turned against its system, in degrees, with cells that are no squares, or without any height. A cell
    whose height is not finite has none.
    """
    path = Path(path)
    check_file(path)
    with opened_raster(path) as file:
        check_pixels(path, file.width, file.height, _BYTES)
        if file.interleaving == Interleaving.pixel:
            # Of the first band alone a whole tile cannot be read.
            tile_height, tile_width = file.block_shapes[0]
            check_pixels(path, tile_width, tile_height, np.dtype(file.dtypes[0]).itemsize, file.count)
        bands = file.read(1, masked=True)
        place, crs = file.transform, file.crs
    if epsg is not None:
        system = epsg_system(epsg, path.name)
    else:
        system = system_of(CRS.from_wkt(crs.to_wkt()), path.name) if crs else CoordinateSystem()
    if place.is_identity:
        raise InputError(f"{path.name} does not say where its cells lie; write it with its georeferencing")
    if place.b or place.d or place.a <= 0 or place.e >= 0:
        raise InputError(f"{path.name} is not north up; resample it so that its rows run east")
    if system.geographic:
        raise InputError(f"{path.name} is in {system.name}, in degrees; resample it to a map system")
    if not np.isclose(place.a, -place.e, rtol=1e-6):
        raise InputError(f"{path.name} has cells of {place.a:g} x {-place.e:g}; resample it to squares")
    # Some of what is not a number would warn when it becomes double.
    known = ~np.ma.getmaskarray(bands) & np.isfinite(bands.data)
    heights = np.where(known, bands.data, 0).astype(float) * system.units[1]
    heights[~known] = np.nan
    if np.isnan(heights).all():
        raise InputError(f"{path.name} has no heights; name another surface model")
    plane = system.units[0]
    return Raster(heights, place.c * plane, place.f * plane, place.a * plane), system


def write_hillshade(path: str | Path, shade: Float[np.ndarray, "rows columns"]) -> None:
    """Write a shading of 0 to 1 as a grey PNG, transparent where it is NaN."""
    grey = np.rint(255 * np.nan_to_num(shade)).astype(np.uint8)
    alpha = np.where(np.isnan(shade), 0, 255).astype(np.uint8)
    rows, columns = shade.shape
    kind = {"driver": "PNG", "height": rows, "width": columns, "count": 2, "dtype": "uint8"}
    with whole_raster(path, **kind) as file:
        file.write(np.stack([grey, alpha]))
