"""What a reader of one format gives: a cloud file that is open, before its coordinates are placed and filtered."""

import dataclasses
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem

CHUNK = 500_000
"""Points that are read, placed and filtered together."""
# What they may take: a point is long where a file says much of each.
_CHUNK_BYTES = 64 << 20


@dataclasses.dataclass(frozen=True)
class CloudSource:
    """A cloud file. `chunks` gives its points with the file's own coordinates, at most `CHUNK` at a time.

    `system` is what the file says of its coordinates. `most` is how many points there are at most, `extent` their least
    and greatest coordinates, both None where only reading tells. A chunk's `strips` are those met up to it.
    """

    name: str
    system: CoordinateSystem
    most: int | None
    extent: Float[np.ndarray, "2 3"] | None
    chunks: Callable[[], Iterator[Cloud]]


class StripNumbers:
    """Numbers strips in the order in which they are met."""

    def __init__(self) -> None:
        self._index: dict[str, int] = {}

    def of(self, ids: np.ndarray) -> np.ndarray:
        """The index in `names` of each of the strips `ids`."""
        place, known = pd.factorize(ids, sort=True)
        numbers = [self._index.setdefault(str(name), len(self._index)) for name in known]
        return np.array(numbers, np.int32)[place]

    @property
    def names(self) -> tuple[str, ...]:
        """The strips met so far."""
        return tuple(self._index)


def at_once(point_bytes: int, most: int = CHUNK) -> int:
    """How many points of so many bytes each are read together, at most `most`."""
    return max(1, min(most, _CHUNK_BYTES // point_bytes))


def check_file(path: Path) -> None:
    """Raise InputError where there is no file at `path` that can be read; a pipe or a device has no end."""
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file")
    if not path.exists():
        raise InputError(f"there is no file {path}; correct the name")
    if not (path.is_file() and os.access(path, os.R_OK)):
        raise InputError(f"{path} is no file that you may read; name another, or have its rights changed")
