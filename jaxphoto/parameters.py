"""What declares unknowns: parameters that belong together and have one owner.

A file that adds an unknown holds one final subclass of `AbstractParameters`. It says whose the parameters are, what
each number is called (the unit is the name's end), and perhaps what they do to an interior orientation or a station.
Order, priors of every kind, scales, correlations, tables and files follow from that.
"""

import dataclasses
from collections import OrderedDict
from collections.abc import Hashable, Iterator, Mapping
from typing import Any, ClassVar, Literal

import equinox as eqx
import numpy as np

from jaxphoto.arrays import from_list
from jaxphoto.short_repr import shown

UNITS = (
    "m", "rad", "mm", "s", "ms", "m_per_s", "rad_per_s", "mm_per_s", "mm_per_h", "per_h", "mm_per_K", "per_K", "ppm",
)  # fmt: skip
"""Units that the names of declared parameters may end in; a typical scale is known of these, of `per_h` and
`per_K` where cameras are bent."""
Owner = Literal["image", "camera", "mount", "strip", "block"] | str
"""Whose parameters are: of each image, of each camera and so on, or of the whole block. Any other word is a partition
of the images that the block names (`Block.partitions`), such as intervals of time."""


@shown
class AbstractParameters(eqx.Module):
    """Parameters of one owner; fields are numbers or vectors."""

    kind: eqx.AbstractClassVar[str]
    """The table that holds them: the first word of their labels, as in `strips[a].shift_X_m`."""
    owner: eqx.AbstractClassVar[str]
    names: eqx.AbstractClassVar[Mapping[str, tuple[str, ...]]]
    """The name of every number of every field. Its end is its unit: _m, _rad, _s, _ms, _mm, _m_per_s, _ppm ..."""
    bends: ClassVar[tuple[str, ...]] = ()
    """Fields of the interior orientation that `interior` changes, such as ("c",); then it is asked for every image."""
    sized: ClassVar[str] = ""
    """The field that says how many numbers each of the others has, where that differs from block to block; `names` then
    has one name for all of them, and `labels` says those of each."""

    def __check_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, from_list(value))

    def interior(self, interior: Any, exposure: Any) -> Any:
        """The interior orientation of one image; a subclass that names fields in `bends` says what becomes of it."""
        return interior

    def station(self, position: Any, exposure: Any) -> Any:
        """What GNSS observes (m) of a sensor at `position`; a subclass that moves stations adds to it."""
        return position

    def labels(self, owner: str) -> tuple[str, ...]:
        """Paths of the parameters, in the order of `numbers_of`."""
        place = f"{self.kind}[{owner}]" if owner else self.kind
        return tuple(f"{place}.{name}" for f in dynamic_fields(type(self)) for name in self.names[f])


def unit_of(name: str) -> str:
    """m of `shift_X_m`, m_per_s of `drift_X_m_per_s`; "" of a name that ends in no unit."""
    return next((unit for unit in sorted(UNITS, key=len, reverse=True) if name.endswith(f"_{unit}")), "")


def dynamic_fields(cls: type) -> list[str]:
    """The fields of a module that hold numbers."""
    return [f.name for f in dataclasses.fields(cls) if not f.metadata.get("static", False)]


def leaves_in_order(tree: Any) -> Iterator[Any]:
    """The leaves of modules and dicts, dicts in the order in which they were filled (JAX sorts their keys)."""
    if isinstance(tree, AbstractParameters):
        for name in dynamic_fields(type(tree)):
            yield from leaves_in_order(getattr(tree, name))
    elif isinstance(tree, dict):
        for value in tree.values():
            yield from leaves_in_order(value)
    else:
        yield tree


def numbers_of(parameters: AbstractParameters) -> list:
    """All numbers of the fields, one after the other."""
    return [v for leaf in leaves_in_order(parameters) for v in (leaf if np.ndim(leaf) else (leaf,))]


def form_of(tree: Any) -> Hashable:
    """Everything of parameters but their numbers: what `filled` puts numbers into. It can be hashed."""
    if isinstance(tree, AbstractParameters):
        cls = type(tree)
        fields = tuple((name, form_of(getattr(tree, name))) for name in dynamic_fields(cls))
        static = {f.name for f in dataclasses.fields(cls)} - {name for name, _ in fields}
        return cls, fields, tuple((name, getattr(tree, name)) for name in sorted(static))
    if isinstance(tree, dict):
        return dict, tuple((name, form_of(value)) for name, value in tree.items()), ()
    return np.shape(tree)


def filled(form: Any, numbers: Any) -> Any:
    """The parameters of a form from their numbers, along the first axis; further axes stay."""
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
    """How many numbers a form holds."""
    if form and isinstance(form[0], type):
        return sum(size_of(inner) for _, inner in form[1])
    return int(np.prod(form, dtype=int))
