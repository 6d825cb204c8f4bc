"""Rasters written whole or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rasterio.io import DatasetWriter, MemoryFile

from jaxphoto.io.raster.opened import quiet
from jaxphoto.writing import whole_file


@contextmanager
def whole_raster(path: str | Path, **kind: Any) -> Iterator[DatasetWriter]:
    """A raster of some `kind`, as rasterio wants it told, to write into; it becomes the file `path`.

    It is made in memory: GDAL does not say when a disk is full. Raises what `whole_file` raises.
    """
    with quiet(), MemoryFile() as memory:
        with memory.open(**kind) as file:
            yield file
        with whole_file(Path(path)) as work:
            work.write_bytes(memory.getbuffer())
