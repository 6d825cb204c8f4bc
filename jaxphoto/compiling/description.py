"""Text that identifies a compiled program, equal in every process.

Two different programs must never have the same text. Only values that the text identifies completely are described:
plain values, arrays by their type, containers, dataclasses, and, by name, functions and classes of packages whose
sources or versions are in the key of `store`.
"""

import dataclasses
import enum
import types
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxphoto.static_values import StaticArray

# Packages whose sources or versions are part of the key: a name in them identifies its content.
_KNOWN = frozenset({"jaxphoto", "jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy", "builtins"})
_PLAIN = (type(None), bool, int, float, complex, str, bytes)


class Indescribable(Exception):
    """Raised for a value that a text cannot identify; programs that depend on it are not stored."""


class _Leaf:
    """Placeholder for a leaf of a tree of which only the structure is known."""


def is_known(module: str) -> bool:
    """Return True if the key identifies a name in `module`."""
    return module.split(".")[0] in _KNOWN


def describe(value: Any) -> str:
    """Describe arguments, static or not; arrays by their type only. Raises Indescribable."""
    if type(value) in _PLAIN:
        return repr(value)
    if isinstance(value, _Leaf):
        return "leaf"
    if isinstance(value, StaticArray):
        return f"static {value.dtype.name} {value.shape} {value.content.digest}"
    if eqx.is_array(value):
        return _array(value)
    if isinstance(value, enum.Enum):
        return f"{_name(type(value))}.{value.name}"
    if isinstance(value, np.dtype):
        return f"dtype {value.str}"
    if isinstance(value, type | types.FunctionType):
        return _name(value)
    if isinstance(value, jax.tree_util.PyTreeDef):
        return f"tree {describe(jax.tree.unflatten(value, [_Leaf()] * value.num_leaves))}"
    return f"{_name(type(value))}({', '.join(map(describe, _content(value)))})"


def _content(value: Any) -> list:
    """Return the parts of a container or dataclass, in order."""
    if isinstance(value, tuple) and (type(value) is tuple or hasattr(value, "_fields")):
        return list(value)
    if type(value) is list:
        return value
    if type(value) is dict:
        return [part for item in value.items() for part in item]
    if dataclasses.is_dataclass(value):
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    raise Indescribable(f"{type(value)} is not known to be identified by its parts")


def _array(value: Any) -> str:
    """Return the type of an array: a compiled program depends on no other property of an argument."""
    text = f"array {np.dtype(value.dtype).name} {value.shape}"
    if not isinstance(value, jax.Array):
        return text
    devices: Any = value.sharding.device_set
    place = f" {value.sharding} {sorted(device.id for device in devices)}" if value.committed else ""
    return text + " weak" * value.weak_type + place


def _name(value: type | types.FunctionType) -> str:
    module, name = value.__module__ or "", value.__qualname__
    if not is_known(module) or "<" in name:
        raise Indescribable(f"{module}.{name} may mean something else elsewhere")
    return f"{module}.{name}"
