"""Declared parameters: related unknowns with one owner.

A file that adds an unknown defines one final subclass of `AbstractParameters`. It declares the owner, the name of each
scalar (ending in its unit), and optionally the effect on an interior orientation or a station. Order, priors, scales,
correlations, tables and files are derived from it.
"""

import dataclasses
from collections import OrderedDict
from collections.abc import Hashable, Iterator, Mapping
from typing import Any, ClassVar, Literal

import equinox as eqx
import numpy as np

from jaxphoto.arrays import from_list
from jaxphoto.short_repr import pretty_repr

UNITS = (
    "m", "rad", "mm", "s", "ms", "m_per_s", "rad_per_s", "mm_per_s", "mm_per_h", "per_h", "mm_per_K", "per_K", "ppm",
)  # fmt: skip
"""Allowed unit suffixes of the names of declared parameters. Each has a typical scale, `per_h` and `per_K` only for
parameters that modify cameras.
"""
Owner = Literal["image", "camera", "mount", "strip", "block"] | str
"""Owner of parameters: each image, each camera etc., or the whole block. Any other string is a partition of the images
defined by the block (`Block.partitions`), such as intervals of time.
"""


@pretty_repr
class AbstractParameters(eqx.Module):
    """Parameters of one owner; fields are scalars or vectors."""

    kind: eqx.AbstractClassVar[str]
    """Name of their table: the first part of their labels, as in `strips[a].shift_X_m`."""
    owner: eqx.AbstractClassVar[str]
    names: eqx.AbstractClassVar[Mapping[str, tuple[str, ...]]]
    """Name of every scalar of every field, ending in its unit: _m, _rad, _s, _ms, _mm, _m_per_s, _ppm ..."""
    modifies_interior: ClassVar[tuple[str, ...]] = ()
    """Fields of the interior orientation that `interior` changes, such as ("c",); it is then evaluated for every image.
    """
    sized: ClassVar[str] = ""
    """Field that contains the size of the other fields, if it differs between blocks; `names` then has one name for all
    scalars of a field, and `labels` has one each.
    """

    def __check_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, from_list(value))

    def interior(self, interior: Any, exposure: Any) -> Any:
        """Return the interior orientation of one image; overridden if `modifies_interior` names fields."""
        return interior

    def station(self, position: Any, exposure: Any) -> Any:
        """Return the position (m) that GNSS observes for a sensor at `position`; overridden by subclasses that move
        stations.
        """
        return position

    def labels(self, owner: str) -> tuple[str, ...]:
        """Return the paths of the parameters, in the order of `numbers_of`."""
        place = f"{self.kind}[{owner}]" if owner else self.kind
        return tuple(f"{place}.{name}" for f in dynamic_fields(type(self)) for name in self.names[f])


def unit_of(name: str) -> str:
    """Return the unit of a name: m of `shift_X_m`, m_per_s of `drift_X_m_per_s`; "" without unit."""
    return next((unit for unit in sorted(UNITS, key=len, reverse=True) if name.endswith(f"_{unit}")), "")


def dynamic_fields(cls: type) -> list[str]:
    """Return the fields of a module that contain values."""
    return [f.name for f in dataclasses.fields(cls) if not f.metadata.get("static", False)]


def leaves_in_order(tree: Any) -> Iterator[Any]:
    """Return the leaves of modules and dicts, dicts in insertion order (JAX sorts their keys)."""
    if isinstance(tree, AbstractParameters):
        for name in dynamic_fields(type(tree)):
            yield from leaves_in_order(getattr(tree, name))
    elif isinstance(tree, dict):
        for value in tree.values():
            yield from leaves_in_order(value)
    else:
        yield tree


def numbers_of(parameters: AbstractParameters) -> list:
    """Return all scalars of the fields, concatenated."""
    return [v for leaf in leaves_in_order(parameters) for v in (leaf if np.ndim(leaf) else (leaf,))]


def form_of(tree: Any) -> Hashable:
    """Return parameters without their values, for `filled`; hashable."""
    if isinstance(tree, AbstractParameters):
        cls = type(tree)
        fields = tuple((name, form_of(getattr(tree, name))) for name in dynamic_fields(cls))
        static = {f.name for f in dataclasses.fields(cls)} - {name for name, _ in fields}
        return cls, fields, tuple((name, getattr(tree, name)) for name in sorted(static))
    if isinstance(tree, dict):
        return dict, tuple((name, form_of(value)) for name, value in tree.items()), ()
    return np.shape(tree)


def filled(form: Any, numbers: Any) -> Any:
    """Fill a form with values along the first axis; further axes are retained."""
    return _filled(form, numbers, 0)[0]


def _filled(form: Any, numbers: Any, first: int) -> tuple[Any, int]:
    if not (form and isinstance(form[0], type)):
        size = int(np.prod(form, dtype=int))
        value = numbers[first : first + size].reshape(*form, *numbers.shape[1:]) if form else numbers[first]
        return value, first + size
    cls, fields, static = form
    values = {}
    for name, inner in fields:
        values[name], first = _filled(inner, numbers, first)
    return (OrderedDict(values) if cls is dict else cls(**values, **dict(static))), first


def size_of(form: Any) -> int:
    """Return the number of scalars in a form."""
    if form and isinstance(form[0], type):
        return sum(size_of(inner) for _, inner in form[1])
    return int(np.prod(form, dtype=int))
