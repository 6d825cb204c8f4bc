"""Whether a file can hold the pixels that it says it has."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from jaxphoto.errors import InputError

# Of the memory that they take, so much is given to the pixels of any file.
_FREE_BYTES = 200_000_000
# Bytes of a file for each pixel of a larger picture, at least. JPEG has 0.05 and more where something is to be seen,
# surface models come to 0.02 only where nine tenths of them are empty; a picture of one colour has 0.001.
_LEAST_BYTES = 0.02


def check_pixels(path: Path, width: int, height: int, bytes_each: int = 1, bands: int = 1) -> None:
    """Raise InputError for a picture or raster that says it has far more pixels than its file can hold.

    Memory, `bytes_each` a pixel of each of its bands, is taken by what it says: a damaged number, or a picture of one
    colour, else fills it.
    """
    pixels = width * height * bands
    if pixels * bytes_each > _FREE_BYTES and pixels * _LEAST_BYTES > path.stat().st_size:
        in_bands = f" in {bands} bands" if bands > 4 else ""
        raise InputError(
            f"{path.name} says it has {width} x {height} pixels{in_bands}, which is far "
            f"more than its {path.stat().st_size} bytes can show; if it is not damaged, store it without compression"
        )


@contextmanager
def pictures_of_any_size() -> Iterator[None]:
    """Have Pillow open what it takes for an attack: more than 179 million pixels, which aerial cameras have."""
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit
