"""Least-recently-used cache, safe for use by several threads."""

from collections.abc import Callable, Hashable
from threading import Lock
from typing import Generic, TypeVar

_Value = TypeVar("_Value")


class LruCache(Generic[_Value]):
    """Cache of the `capacity` most recently used values, by key."""

    def __init__(self, capacity: int):
        self._capacity = capacity
        self._values: dict[Hashable, _Value] = {}
        self._lock = Lock()

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """Return the value of `key`; call `make` if it is not cached."""
        with self._lock:
            if key in self._values:
                self._values[key] = self._values.pop(key)
                return self._values[key]
        value = make()
        with self._lock:
            self._values[key] = value
            while len(self._values) > self._capacity:
                del self._values[next(iter(self._values))]
        return value

    def clear(self) -> None:
        """Remove all values."""
        with self._lock:
            self._values.clear()
