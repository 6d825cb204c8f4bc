"""A table of block.toml that knows its own name, so that every message can say where the mistake is."""

import math
from typing import Any

import numpy as np

from jaxphoto.arrays import on_device
from jaxphoto.errors import InputError, quoted
from jaxphoto.io.names import harm_in
from jaxphoto.io.text_tables import LARGEST
from jaxphoto.observations import is_covariance
from jaxphoto.unknowns import FIXED, FREE, Prior, Weighted

MOST = 10**9
"""Of anything that is counted. Numbers of things that are made have limits of their own."""


class Section:
    """The keys of one TOML table, read by kind; `file` and `path` (cameras.kodak) are for messages."""

    def __init__(self, file: str, path: str, values: dict[str, Any]):
        self.file, self.path, self.values = file, path, values

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def __iter__(self):
        return iter(self.values)

    def error(self, key: str, message: str) -> InputError:
        """An error about one key, or with key "" about the whole table."""
        table = f"[{self.path}] " if self.path else ""
        return InputError(f"{self.file}, {table}{key}".rstrip(" ,") + f": {message}")

    def known(self, *keys: str) -> None:
        """Raise InputError for a key that is not among `keys`: a misspelt one would silently do nothing."""
        for key in self.values:
            if key not in keys:
                raise self.error(key, f"no such key is known; use {', '.join(keys)} or remove it")

    def section(self, key: str) -> "Section":
        """The table under `key`, empty where there is none."""
        values = self.values.get(key, {})
        if not isinstance(values, dict):
            raise self.error(key, f"{quoted(values)} is not a table; write it as [{self._below(key)}]")
        return Section(self.file, self._below(key), values)

    def text(self, key: str, default: str | None = None) -> str:
        """A piece of text."""
        value = self._needed(key) if default is None else self.values.get(key, default)
        if not isinstance(value, str):
            raise self.error(key, f'{quoted(value)} is not text; put it in quotation marks, like "..."')
        return value

    def name(self, key: str) -> str:
        """A piece of text that results show as the name of something."""
        value = self.text(key)
        if harm := harm_in(value):
            raise self.error(key, f"the name {quoted(value)} {harm}")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """A list of pieces of text; none where the key is absent."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            raise self.error(key, f'{quoted(value)} is not a list of text; write it like ["a", "b"]')
        return tuple(value)

    def truth(self, key: str) -> bool:
        """Yes or no; no where the key is absent."""
        value = self.values.get(key, False)
        if not isinstance(value, bool):
            raise self.error(key, f"{quoted(value)} is neither true nor false; write one of them")
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        value = self._needed(key) if default is None else self.values.get(key, default)
        return self._finite(key, value)

    def positive(self, key: str) -> float:
        """A finite number above zero."""
        value = self.number(key)
        if value <= 0:
            raise self.error(key, f"{value:g} is not positive; give the true value")
        return value

    def count(self, key: str, most: int = MOST) -> int:
        """A whole number above zero, and not above `most`."""
        value = self._needed(key)
        if isinstance(value, bool) or not isinstance(value, int) or value <= 0:
            raise self.error(key, f"{quoted(value)} is not a positive whole number; give one")
        if value > most:
            raise self.error(key, f"{quoted(value)} is too large, the most are {most}; give the true number")
        return value

    def vector(self, key: str, size: int = 3) -> np.ndarray:
        """Finite numbers, zeros where the key is absent."""
        value = self.values.get(key, [0.0] * size)
        if not isinstance(value, list) or len(value) != size:
            many = "three" if size == 3 else size
            raise self.error(key, f"{quoted(value)} is not a list of {many} numbers; write it like {[0.0] * size}")
        return np.array([self._finite(key, v) for v in value])

    def prior(self, key: str, start, unit: str = "", scale: float = 1.0) -> Prior | Weighted:
        """`"free"`, `"fixed"` (also where absent) or `{ sigma = ... }`, weighted at `start` unless `value` is given.

        A vector may have `covariance`, the rows of a matrix, in place of `sigma`.

        `start` is in jaxphoto's unit, which is the file's times `scale`; `unit` may end the two names (sigma_deg).
        """
        status = self.values.get(key, "fixed")
        if status == "free":
            return FREE
        if status == "fixed":
            return FIXED
        shape = np.shape(start)
        names = {name: [n for n in (name, name + unit) if isinstance(status, dict) and n in status] for name in _KEYS}
        names["covariance"] = ["covariance"] if isinstance(status, dict) and "covariance" in status and shape else []
        known = {n for ns in names.values() for n in ns}
        if not isinstance(status, dict) or bool(names["sigma"]) == bool(names["covariance"]) or set(status) - known:
            raise self.error(key, f'{quoted(status)} is no status; write "free", "fixed" or {{ sigma{unit} = ... }}')
        value = self._array(key, status[names["value"][0]], shape) * scale if names["value"] else np.asarray(start)
        if names["covariance"]:
            matrix = self.covariance(key, status["covariance"], *shape)
            return Weighted(on_device(value), covariance=on_device(matrix * scale**2))
        sigma = self._array(key, status[names["sigma"][0]], shape) * scale
        if not np.all(sigma > 0):
            raise self.error(key, f'sigma = {status[names["sigma"][0]]} is not positive; give the true one or "fixed"')
        return Weighted(on_device(value), on_device(sigma))

    def covariance(self, key: str, rows: Any, size: int) -> np.ndarray:
        """A covariance matrix of `size` numbers, which `key` gives by `rows`."""
        lengths = [len(row) if isinstance(row, list) else 0 for row in rows] if isinstance(rows, list) else []
        if lengths != [size] * size:
            raise self.error(
                key, f"the covariance is no matrix of {size} x {size}; write {size} lists of {size} numbers"
            )
        matrix = np.array([[self._finite(key, v) for v in row] for row in rows])
        if not np.array_equal(matrix, matrix.T) or not is_covariance(matrix):
            raise self.error(key, "the covariance is not symmetric and positive definite; correct it, or give sigma")
        return matrix

    def _array(self, key: str, value, shape: tuple[int, ...]) -> np.ndarray:
        values = value if isinstance(value, list) else [value]
        numbers = np.array([self._finite(key, v) for v in values])
        if len(numbers) not in (1, *shape):
            raise self.error(key, f"{quoted(value)} has {len(numbers)} numbers; give one, or one per axis")
        return np.broadcast_to(numbers, shape).copy() if shape else numbers.reshape(())

    def _finite(self, key: str, value) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
            raise self.error(
                key, f"{quoted(value)} is not a finite number; write it like 12.34, without quotation marks"
            )
        if abs(value) > LARGEST:
            raise self.error(key, f"{value:g} is larger than any number can be here; give the true one")
        return float(value)

    def _needed(self, key: str):
        if key not in self.values:
            raise self.error(key, "the key is missing; add it")
        return self.values[key]

    def _below(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key


_KEYS = ("sigma", "value")


def _is_finite(value: int | float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:
        # A whole number beyond the floats.
        return False
