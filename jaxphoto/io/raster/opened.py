"""Opening rasters so that what is wrong with them is said in one sentence."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from jaxphoto.errors import InputError


@contextmanager
def quiet() -> Iterator[None]:
    """Without rasterio's warning of rasters that have no place on the earth: photographs and local frames have none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


@contextmanager
def opened_raster(path: Path) -> Iterator[rasterio.DatasetReader]:
    """A raster open for reading. Raises InputError where it is none, or damaged."""
    try:
        with quiet(), rasterio.open(path) as file:
            yield file
    except RasterioError as error:
        said = (str(error).strip() or type(error).__name__).splitlines()[0][:100]
        raise InputError(f"{path.name} cannot be read as a raster ({said}); copy it anew from its source") from None
