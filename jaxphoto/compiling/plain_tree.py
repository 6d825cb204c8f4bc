"""Tree of a program's results as plain JSON, and back; reading it executes nothing."""

import dataclasses
import sys
from typing import Any

import equinox as eqx

from jaxphoto.compiling.description import is_known


class Slot:
    """Placeholder for an array in the tree of a result."""


def to_json(tree: Any) -> Any:
    """Convert `tree` to JSON values. Raises TypeError for unsupported content."""
    if tree is None or type(tree) in (bool, int, float, str):
        return tree
    if isinstance(tree, Slot):
        return {"slot": None}
    if type(tree) in (list, tuple):
        return {type(tree).__name__: [to_json(part) for part in tree]}
    if type(tree) is dict and all(type(key) is str for key in tree):
        return {"dict": [[key, to_json(value)] for key, value in tree.items()]}
    names = _fields(type(tree))
    name = f"{type(tree).__module__}:{type(tree).__qualname__}"
    if names is None or _class(name) is not type(tree):
        raise TypeError(f"cannot serialise {type(tree)}; use a NamedTuple or an equinox Module defined at module level")
    return {name: [to_json(getattr(tree, field)) for field in names]}


def from_json(text: Any) -> Any:
    """Convert the JSON values of `to_json` to a tree. Raises TypeError or ValueError for anything else."""
    if text is None or type(text) in (bool, int, float, str):
        return text
    ((name, content),) = text.items()
    if name == "slot":
        return Slot()
    if name in ("list", "tuple"):
        return {"list": list, "tuple": tuple}[name](map(from_json, content))
    if name == "dict":
        return {key: from_json(value) for key, value in content}
    kind = _class(name)
    names = _fields(kind)
    if names is None:
        raise TypeError(f"unsupported class {name}; use a NamedTuple or an equinox Module")
    values = [from_json(part) for part in content]
    if issubclass(kind, tuple):
        return kind._make(values)  # type: ignore[attr-defined]
    made = object.__new__(kind)
    for field, value in zip(names, values, strict=True):
        # Bypass `__init__`, which may not accept placeholders, as JAX does when it rebuilds trees.
        object.__setattr__(made, field, value)
    return made


def _fields(kind: type) -> tuple[str, ...] | None:
    """Return the field names of a class; None for an unsupported class."""
    if issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return kind._fields
    if issubclass(kind, eqx.Module):
        return tuple(field.name for field in dataclasses.fields(kind))
    return None


def _class(name: str) -> type:
    """Return the class called "module:name". Raises TypeError unless its package is imported and in the cache key."""
    module, _, qualified = name.partition(":")
    found: Any = sys.modules.get(module) if is_known(module) else None
    for part in qualified.split("."):
        found = getattr(found, part, None)
    if not isinstance(found, type):
        raise TypeError(f"there is no class {name}")
    return found
