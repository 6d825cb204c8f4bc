"""Photographs, and the orthophotos that are made of them."""

from pathlib import Path

import numpy as np
import rasterio

from jaxphoto.camera import Sensor
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import check_file
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem
from jaxphoto.io.picture_size import check_pixels
from jaxphoto.io.raster.opened import opened_raster
from jaxphoto.io.raster.surface import layout
from jaxphoto.io.raster.whole_raster import whole_raster
from jaxphoto.lidar.orthophoto import Picture
from jaxphoto.lidar.raster import Raster


def read_photograph(path: str | Path, sensor: Sensor) -> np.ndarray:
    """The pixels (bands, height, width) of a photograph as the sensor gave them, whatever an EXIF orientation says.

    Raises InputError for a file that is no picture or damaged, and where it has not the size of the sensor.
    """
    path = Path(path)
    check_file(path)
    with opened_raster(path) as file:
        if (file.width, file.height) != (sensor.width_px, sensor.height_px):
            turned = (file.height, file.width) == (sensor.width_px, sensor.height_px)
            raise InputError(
                f"{path.name} has {file.width} x {file.height} pixels, but its camera {sensor.width_px} x "
                f"{sensor.height_px}; name {'the photograph as it was before it was turned' if turned else 'another'}"
            )
        check_pixels(path, file.width, file.height, max(np.dtype(kind).itemsize for kind in file.dtypes), file.count)
        return file.read()


def write_orthophoto(
    path: str | Path,
    picture: Picture,
    raster: Raster,
    system: CoordinateSystem = CoordinateSystem(),  # noqa: B008
) -> None:
    """Write an orthophoto as GeoTIFF on the cells of `raster`; a mask in it says which cells the image does not see."""
    bands = len(picture.pixels)
    # rasterio has no predictor for floats of all kinds; 2 is that of whole numbers.
    predictor = 2 if picture.pixels.dtype.kind in "iu" else 3
    colours = {"photometric": "RGB"} if bands == 3 else {}
    kind = {**layout(raster, system), "dtype": picture.pixels.dtype, "count": bands, "predictor": predictor, **colours}
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), whole_raster(path, **kind) as file:
        file.write(picture.pixels)
        file.write_mask(picture.seen)
