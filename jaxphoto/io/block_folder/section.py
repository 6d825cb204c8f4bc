"""A table of block.toml that knows its own name, so that every message can say where the mistake is."""

from typing import Any

import numpy as np

from jaxphoto.arrays import on_device
from jaxphoto.errors import InputError
from jaxphoto.unknowns import FIXED, FREE, Prior, Weighted


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
            raise self.error(key, f"{values!r} is not a table; write it as [{self._below(key)}]")
        return Section(self.file, self._below(key), values)

    def text(self, key: str, default: str | None = None) -> str:
        """A piece of text."""
        value = self._needed(key) if default is None else self.values.get(key, default)
        if not isinstance(value, str):
            raise self.error(key, f'{value!r} is not text; put it in quotation marks, like "{value}"')
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

    def count(self, key: str) -> int:
        """A whole number above zero."""
        value = self._needed(key)
        if isinstance(value, bool) or not isinstance(value, int) or value <= 0:
            raise self.error(key, f"{value!r} is not a positive whole number; give one")
        return value

    def vector(self, key: str) -> np.ndarray:
        """Three finite numbers, zeros where the key is absent."""
        value = self.values.get(key, [0.0, 0.0, 0.0])
        if not isinstance(value, list) or len(value) != 3:
            raise self.error(key, f"{value!r} is not a list of three numbers; write it like [0.0, 0.0, 0.0]")
        return np.array([self._finite(key, v) for v in value])

    def prior(self, key: str, start, unit: str = "", scale: float = 1.0) -> Prior | Weighted:
        """`"free"`, `"fixed"` (also where absent) or `{ sigma = ... }`, weighted at `start` unless `value` is given.

        `start` is in jaxphoto's unit, which is the file's times `scale`; `unit` may end the two names (sigma_deg).
        """
        status = self.values.get(key, "fixed")
        if status == "free":
            return FREE
        if status == "fixed":
            return FIXED
        names = {name: [n for n in (name, name + unit) if isinstance(status, dict) and n in status] for name in _KEYS}
        if not isinstance(status, dict) or not names["sigma"] or set(status) - {n for ns in names.values() for n in ns}:
            raise self.error(key, f'{status!r} is no status; write "free", "fixed" or {{ sigma{unit} = ... }}')
        shape = np.shape(start)
        sigma = self._array(key, status[names["sigma"][0]], shape) * scale
        if not np.all(sigma > 0):
            raise self.error(key, f'sigma = {status[names["sigma"][0]]} is not positive; give the true one or "fixed"')
        value = self._array(key, status[names["value"][0]], shape) * scale if names["value"] else np.asarray(start)
        return Weighted(on_device(value), on_device(sigma))

    def _array(self, key: str, value, shape: tuple[int, ...]) -> np.ndarray:
        values = value if isinstance(value, list) else [value]
        numbers = np.array([self._finite(key, v) for v in values])
        if len(numbers) not in (1, *shape):
            raise self.error(key, f"{value!r} has {len(numbers)} numbers; give one, or one per axis")
        return np.broadcast_to(numbers, shape).copy() if shape else numbers.reshape(())

    def _finite(self, key: str, value) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise self.error(key, f"{value!r} is not a finite number; write it like 12.34, without quotation marks")
        return float(value)

    def _needed(self, key: str):
        if key not in self.values:
            raise self.error(key, "the key is missing; add it")
        return self.values[key]

    def _below(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key


_KEYS = ("sigma", "value")
