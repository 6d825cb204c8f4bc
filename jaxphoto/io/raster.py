"""Rasters by rasterio: surface models, hillshades, photographs and orthophotos (docs/clouds.md)."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from pyproj import CRS

from jaxphoto.camera import Sensor
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import check_file
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, epsg_system, system_of
from jaxphoto.lidar.raster import Picture, Raster
from jaxphoto.optional import extra
from jaxphoto.writing import whole_file

with extra():
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError
    from rasterio.io import DatasetWriter, MemoryFile

_NODATA = -9999.0


def read_dsm(path: str | Path, epsg: int | None = None) -> tuple[Raster, CoordinateSystem]:
    """Read the surface model in the first band of a raster, in metres, and its coordinate system.

    `epsg` replaces the system of the file. Heights that are not finite are missing. Raises InputError for a file
    that is not a raster, has no georeferencing, is not north up, is in degrees, has cells that are not square, or no
    height.
    """
    path = Path(path)
    with _opened(path) as file:
        band = file.read(1, masked=True)
        place, crs = file.transform, file.crs
    if epsg is not None:
        system = epsg_system(epsg, path.name)
    else:
        system = system_of(CRS.from_wkt(crs.to_wkt()), path.name) if crs else CoordinateSystem()
    valid = ~np.ma.getmaskarray(band) & np.isfinite(band.data)
    for invalid, problem in (
        (place.is_identity, "has no georeferencing; write it with its place"),
        (place.b or place.d or place.a <= 0 or place.e >= 0, "is not north up; resample it"),
        (system.geographic, f"is in {system.name}, in degrees; resample it to a map system"),
        (not np.isclose(place.a, -place.e, rtol=1e-6), f"has cells of {place.a:g} x {-place.e:g}; resample to squares"),
        (not valid.any(), "has no heights; name another surface model"),
    ):
        if invalid:
            raise InputError(f"{path.name} {problem}")
    heights = np.where(valid, band.data, 0).astype(float) * system.units[1]
    heights[~valid] = np.nan
    plane = system.units[0]
    return Raster(heights, place.c * plane, place.f * plane, place.a * plane), system


def write_dsm(path: str | Path, raster: Raster, system: CoordinateSystem = CoordinateSystem()) -> None:  # noqa: B008
    """Write a surface model as GeoTIFF in `system`: float32 heights (m), tiled, lossless, nodata -9999."""
    heights = np.where(np.isnan(raster.heights), _NODATA, raster.heights).astype(np.float32)
    profile = _geotiff(raster, system) | {"dtype": "float32", "count": 1, "nodata": _NODATA, "predictor": 3}
    with _whole_raster(path, **profile) as file:
        file.write(heights, 1)
        file.units = ("metre",)
        file.set_band_description(1, "height")


def write_hillshade(path: str | Path, shade: Float[np.ndarray, "rows columns"]) -> None:
    """Write a hillshade of 0 to 1 as a grey PNG, transparent where it is NaN."""
    grey = np.rint(255 * np.nan_to_num(shade)).astype(np.uint8)
    alpha = np.where(np.isnan(shade), 0, 255).astype(np.uint8)
    rows, columns = shade.shape
    with _whole_raster(path, driver="PNG", height=rows, width=columns, count=2, dtype="uint8") as file:
        file.write(np.stack([grey, alpha]))


def read_photograph(path: str | Path, sensor: Sensor) -> np.ndarray:
    """Read the pixels (bands, height, width) of a photograph as stored, without applying its EXIF orientation.

    Raises InputError for a file that is not an image or damaged, or that does not have the size of the sensor.
    """
    path = Path(path)
    with _opened(path) as file:
        if (file.width, file.height) != (sensor.width_px, sensor.height_px):
            rotated = (file.height, file.width) == (sensor.width_px, sensor.height_px)
            raise InputError(
                f"{path.name} has {file.width} x {file.height} pixels, but its camera {sensor.width_px} x "
                f"{sensor.height_px}; name {'the photograph before it was rotated' if rotated else 'another'}"
            )
        return file.read()


def write_orthophoto(
    path: str | Path,
    picture: Picture,
    raster: Raster,
    system: CoordinateSystem = CoordinateSystem(),  # noqa: B008
) -> None:
    """Write an orthophoto as GeoTIFF on the cells of `raster`, with a mask of the cells that the image sees."""
    profile = _geotiff(raster, system) | {"dtype": picture.pixels.dtype, "count": len(picture.pixels)}
    # Predictor 2 is that of integers, 3 that of floats.
    profile["predictor"] = 2 if picture.pixels.dtype.kind in "iu" else 3
    if len(picture.pixels) == 3:
        profile["photometric"] = "RGB"
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), _whole_raster(path, **profile) as file:
        file.write(picture.pixels)
        file.write_mask(picture.seen)


def _geotiff(raster: Raster, system: CoordinateSystem) -> dict[str, Any]:
    """The rasterio profile of a GeoTIFF on the cells of `raster`."""
    rows, columns = raster.heights.shape
    return {
        "driver": "GTiff",
        "height": rows,
        "width": columns,
        "transform": rasterio.Affine(raster.cell_m, 0, raster.west, 0, -raster.cell_m, raster.north),
        "crs": None if system.metric is None else rasterio.crs.CRS.from_wkt(system.metric.to_wkt()),
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
        "compress": "deflate",
        "BIGTIFF": "IF_SAFER",
    }


@contextmanager
def _opened(path: Path) -> Iterator[rasterio.DatasetReader]:
    """Open a raster for reading. Raises InputError if there is none, or it is damaged."""
    check_file(path)
    try:
        with _without_georeferencing(), rasterio.open(path) as file:
            yield file
    except RasterioError as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:100]
        raise InputError(f"{path.name} cannot be read as a raster ({reason}); copy it again from its source") from None


@contextmanager
def _whole_raster(path: str | Path, **profile: Any) -> Iterator[DatasetWriter]:
    """A raster to write into, which becomes the file `path`; in memory, because GDAL does not report a full disk."""
    with _without_georeferencing(), MemoryFile() as memory:
        with memory.open(**profile) as file:
            yield file
        with whole_file(Path(path)) as work:
            work.write_bytes(memory.getbuffer())


@contextmanager
def _without_georeferencing() -> Iterator[None]:
    """Ignore rasterio's warning about photographs and rasters of local frames."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield
