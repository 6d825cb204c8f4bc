"""An open cloud file, before transformation and selection."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem

CHUNK = 500_000
"""Number of points processed at a time."""


@dataclasses.dataclass(frozen=True)
class CloudSource:
    """A cloud file; `chunks` yields points in file coordinates, at most `CHUNK` at a time.

    `count` (number of points) and `extent` (minimum and maximum coordinates) are read from the header; None without
    one. `strips` of a chunk lists the strips found so far.
    """

    name: str
    system: CoordinateSystem
    count: int | None
    extent: Float[np.ndarray, "2 3"] | None
    chunks: Callable[[], Iterator[Cloud]]


class StripNumbers:
    """Strip indices in order of first appearance."""

    def __init__(self) -> None:
        self._index: dict[str, int] = {}

    def of(self, ids: np.ndarray) -> np.ndarray:
        """Return the index in `names` of each of the strip ids `ids`."""
        codes, unique = pd.factorize(ids, sort=True)
        return np.array([self._index.setdefault(str(name), len(self._index)) for name in unique], np.int32)[codes]

    @property
    def names(self) -> tuple[str, ...]:
        """Strips found so far."""
        return tuple(self._index)


def check_file(path: Path) -> None:
    """Raise InputError if there is no file at `path`."""
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a file")
    if not path.is_file():
        raise InputError(f"there is no file {path}; correct the name")


def no_points(name: str) -> InputError:
    """Return the error about a file without points."""
    return InputError(f"{name} has no points; name another cloud")


def source_ids(cloud: Cloud) -> np.ndarray:
    """Return point source IDs: the strip names if they are 16-bit integers, else their indices from 1."""
    assert cloud.strip is not None
    numbers = [int(name) if name.isdecimal() else 1 << 16 for name in cloud.strips]
    ids = np.array(numbers) if max(numbers, default=0) < 1 << 16 else np.arange(1, len(numbers) + 1)
    return ids[cloud.strip].astype(np.uint16)
