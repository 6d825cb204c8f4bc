"""A dictionary of few entries: the one that was not used for longest goes."""

from collections.abc import Callable, Hashable
from threading import Lock
from typing import Generic, TypeVar

_Value = TypeVar("_Value")


class LastUsed(Generic[_Value]):
    """The values that were used last, `most` of them; threads may share it."""

    def __init__(self, most: int):
        self._most = most
        self._values: dict[Hashable, _Value] = {}
        self._lock = Lock()

    def get(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """Return the value of `key`, made by `make` where there is none."""
        with self._lock:
            found = self._values.pop(key, None)
        value = make() if found is None else found
        with self._lock:
            self._values[key] = value
            while len(self._values) > self._most:
                del self._values[next(iter(self._values))]
        return value
