"""The binary files of COLMAP: little-endian records, read one after the other; a file that ends early is said so."""

import struct
from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.io.whole_text import read_whole

# Of points of some ten thousand images.
_MOST = 8_000_000_000


class BinaryFile:
    """The bytes of a file and how far they are read."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, read_whole(path, _MOST), 0

    def take(self, layout: str) -> tuple:
        """The values of a `struct` layout."""
        try:
            values = struct.unpack_from("<" + layout, self.data, self.at)
        except struct.error:
            raise self.error("the file ends early") from None
        self.at += struct.calcsize("<" + layout)
        return values

    def numbers(self, count: int) -> tuple[float, ...]:
        """`count` finite numbers."""
        values = self.take(f"{count}d")
        if not np.isfinite(values).all():
            raise self.error("there is a number in it that is not finite")
        return values

    def count(self, size: int) -> int:
        """How many records follow, of at least `size` bytes each."""
        count = self.take("Q")[0]
        if count * size > len(self.data) - self.at:
            raise self.error("the file ends early")
        return count

    def text(self) -> str:
        """What comes before the next zero."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.error("the file ends early")
        text = self.data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return text

    def rows(self, dtype: list[tuple[str, str]]) -> np.ndarray:
        """A count and as many records."""
        kind = np.dtype(dtype)
        values = np.frombuffer(self.data, kind, self.count(kind.itemsize), self.at)
        self.at += values.nbytes
        return values

    def error(self, message: str) -> InputError:
        """An error about this file."""
        return InputError(f"{self.path}: {message}; copy it again or let COLMAP write it again")
