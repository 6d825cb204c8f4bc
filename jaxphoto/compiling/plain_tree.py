"""The tree that a program's results fill, as plain JSON and back: nothing that is read can run anything."""

import dataclasses
import sys
from typing import Any

import equinox as eqx

from jaxphoto.compiling.description import is_known


class Slot:
    """Stands for an array in the tree of a result."""


def told(tree: Any) -> Any:
    """`tree` in what JSON has. Raises TypeError for what it cannot say."""
    if tree is None or type(tree) in (bool, int, float, str):
        return tree
    if isinstance(tree, Slot):
        return {"slot": None}
    if type(tree) in (list, tuple):
        return {type(tree).__name__: [told(part) for part in tree]}
    if type(tree) is dict and all(type(key) is str for key in tree):
        return {"dict": [[key, told(value)] for key, value in tree.items()]}
    names = _fields(type(tree))
    name = f"{type(tree).__module__}:{type(tree).__qualname__}"
    if names is None or _class(name) is not type(tree):
        raise TypeError(f"{type(tree)} cannot be kept")
    return {name: [told(getattr(tree, field)) for field in names]}


def tree_of(text: Any) -> Any:
    """What `told` tells of. Raises TypeError or ValueError for anything else."""
    if text is None or type(text) in (bool, int, float, str):
        return text
    ((name, content),) = text.items()
    if name == "slot":
        return Slot()
    if name in ("list", "tuple"):
        return {"list": list, "tuple": tuple}[name](map(tree_of, content))
    if name == "dict":
        return {key: tree_of(value) for key, value in content}
    kind = _class(name)
    names = _fields(kind)
    if names is None:
        raise TypeError(f"{name} is no class of plain fields")
    values = [tree_of(part) for part in content]
    if issubclass(kind, tuple):
        return kind._make(values)  # type: ignore[attr-defined]
    made = object.__new__(kind)
    for field, value in zip(names, values, strict=True):
        # As JAX puts trees together: without `__init__`, which may not take what stands for an array.
        object.__setattr__(made, field, value)
    return made


def _fields(kind: type) -> tuple[str, ...] | None:
    """Names of the fields that an instance consists of; None for a class of which that is not known."""
    if issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return kind._fields
    if issubclass(kind, eqx.Module):
        return tuple(field.name for field in dataclasses.fields(kind))
    return None


def _class(name: str) -> type:
    """A class of packages that are part of the key, already imported by who wants its program. Raises TypeError."""
    module, _, qualified = name.partition(":")
    found: Any = sys.modules.get(module) if is_known(module) else None
    for part in qualified.split("."):
        found = getattr(found, part, None)
    if not isinstance(found, type):
        raise TypeError(f"there is no class {name}")
    return found
