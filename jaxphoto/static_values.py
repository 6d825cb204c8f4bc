"""Static values in the structure of a tree: index arrays, masks and dictionaries of descriptions.

`jax.jit`, `jax.vmap` and `jax.grad` treat the leaves of a tree as values. Indices must not be traced: they define the
relation between rows. A `StaticArray` is a tree without leaves, so JAX does not trace it, and two trees with equal
arrays have one structure, hence share a compiled program.
"""

import functools
import hashlib
import weakref
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import numpy as np


class Content:
    """Content of an array as a dictionary key: compared by its values, hashed once."""

    def __init__(self, array: np.ndarray):
        self.array = array

    @functools.cached_property
    def _hash(self) -> int:
        return hash((self.array.shape, self.array.dtype.str, self.array.tobytes()))

    @functools.cached_property
    def digest(self) -> str:
        """Return a hash that is the same in every process."""
        return hashlib.sha256(np.ascontiguousarray(self.array).data).hexdigest()

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if not isinstance(other, Content):
            return False
        return self.array.dtype == other.array.dtype and np.array_equal(self.array, other.array)

    def __repr__(self) -> str:
        return f"{self.array.dtype.name}{list(self.array.shape)} {self.digest[:16]}"


class StaticArray(np.ndarray):
    """Read-only array that JAX treats as structure. Results of operations are plain arrays."""

    _content: Content | None

    def __new__(cls, values: Any) -> "StaticArray":
        """Copy `values` to a static array; return a static array, or the static array of a plain view, unchanged."""
        if isinstance(values, cls) and values._content is not None:
            return values
        known = _contents.get(id(values))
        if known is not None and known.array is values:
            return _static(known)
        return _static(Content(np.array(values, subok=False)))

    def __array_finalize__(self, source: Any) -> None:
        self._content = None

    def __array_wrap__(self, array: np.ndarray, context: Any = None, return_scalar: bool = False) -> Any:
        plain = np.asarray(array)
        return plain[()] if return_scalar else plain

    def __getitem__(self, key: Any) -> Any:
        return np.asarray(self)[key]

    def __reduce__(self) -> Any:
        return StaticArray, (np.asarray(self),)

    def __deepcopy__(self, memo: Any) -> "StaticArray":
        return self

    @property
    def plain(self) -> np.ndarray:
        """Plain array for JAX functions: an argument, not structure."""
        return self.content.array

    @property
    def content(self) -> Content:
        """Content that identifies the array."""
        if self._content is None:
            self._content = Content(np.array(self, subok=False))
        return self._content


_contents: weakref.WeakValueDictionary[int, Content] = weakref.WeakValueDictionary()
"""Contents by identity of the array, which each content references."""


def _static(content: Content) -> StaticArray:
    content.array.setflags(write=False)
    _contents[id(content.array)] = content
    array: StaticArray = content.array.view(StaticArray)
    array._content = content
    return array


def _plain_method(name: str) -> Callable[..., Any]:
    def method(self: StaticArray, *arguments: Any, **named: Any) -> Any:
        return getattr(np.asarray(self), name)(*arguments, **named)

    method.__name__ = name
    return method


for _name in ("astype", "copy", "reshape", "ravel", "flatten", "transpose", "repeat", "take"):
    setattr(StaticArray, _name, _plain_method(_name))

# Return a new object each time: `equinox.tree_at` distinguishes nodes of a tree by identity.
jax.tree_util.register_pytree_node(StaticArray, lambda array: ((), array.content), lambda content, _: _static(content))


def is_static(value: Any) -> bool:
    """Return True if `value` is a `StaticArray`."""
    return isinstance(value, StaticArray)


def map_arrays(function: Callable[[Any], Any], tree: Any) -> Any:
    """Apply `function` to all arrays of `tree`; static ones stay static."""

    def one(value: Any) -> Any:
        return StaticArray(function(np.asarray(value))) if is_static(value) else function(value)

    return jax.tree.map(one, tree, is_leaf=is_static)


def with_plain_arrays(tree: Any) -> Any:
    """Return `tree` with its static arrays as leaves, for programs that run on blocks of any content."""
    return jax.tree.map(lambda value: np.asarray(value) if is_static(value) else value, tree, is_leaf=is_static)


class StaticDict(dict):
    """Hashable dictionary for static fields of modules. It must not be modified."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))


def ordered(value: Any) -> Any:
    """Return a dictionary whose order JAX preserves (it sorts the keys of a plain one); return any other value
    unchanged.
    """
    if not isinstance(value, dict):
        return value
    return OrderedDict((key, ordered(inner)) for key, inner in value.items())
