"""The table of a class of observations in a block folder: its columns follow from the fields.

    touching("point"), one a row        start                           an id
    touching("point"), m a row          points_1, points_2              ids
    whole numbers                       axis
    numbers, one a row                  value_m                         unit of the class; rad are degrees in files
    numbers, one an axis                value_X_m, value_Y_m, value_Z_m

`columns` of the class names those of a field otherwise; () means that the field is zero and in no file.
"""

import dataclasses
import functools
import math
import typing
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.arrays import annotated

FILE_UNITS = {"rad": "deg", "rad_per_s": "deg_per_s"}
"""Units that files have in place of those of computations."""


class Column(NamedTuple):
    """One column of a table of observations."""

    name: str
    field: str
    place: tuple[int, ...]
    """Which of the field's numbers of a row; () for the only one."""
    touches: str
    """What an id in it names; "" where it holds numbers."""
    whole: bool
    scale: float
    """What its numbers are multiplied by."""

    @property
    def of_rows(self) -> tuple[Any, ...]:
        """The index of its numbers in the field of all rows."""
        return (slice(None), *self.place)


class RowField(NamedTuple):
    """What one row has of a field."""

    name: str
    touches: str
    whole: bool
    shape: tuple[int, ...]


@functools.cache
def row_fields(cls: type) -> list[RowField]:
    """The fields of a class of observations as annotated: `Int[np.ndarray, "n 2"]` is two indices a row."""
    hints, found = typing.get_type_hints(cls), []
    for field in dataclasses.fields(cls):
        touches = field.metadata.get("touches", "")
        axes, whole = annotated(hints[field.name]) or ([], False)
        if not all(axis.isdigit() for axis in axes[1:]):
            raise TypeError(
                f"{cls.__name__}.{field.name}: {' '.join(axes)!r} does not say how many numbers a row has; write them "
                'as in "n 3"'
            )
        found.append(RowField(field.name, touches, whole or bool(touches), tuple(map(int, axes[1:]))))
    return found


@functools.cache
def whole_fields(cls: type) -> tuple[str, ...]:
    """The fields of a class of observations that hold indices: those that touch something, and whole numbers."""
    fields = dataclasses.fields(cls)
    # Names in the annotations of a class within a function may be out of reach.
    hints = (
        typing.get_type_hints(cls) if any(isinstance(f.type, str) for f in fields) else {f.name: f.type for f in fields}
    )
    whole = {f.name for f in fields if (kind := annotated(hints[f.name])) is not None and kind[1]}
    return tuple(f.name for f in fields if "touches" in f.metadata or f.name in whole)


def columns_of(cls: Any) -> tuple[Column, ...]:
    """The columns of the table of a class of observations, in their order."""
    found: list[Column] = []
    for field in row_fields(cls):
        names = cls.columns.get(field.name, _names(cls, field))
        names = (names,) if isinstance(names, str) else names
        if names and len(names) != math.prod(field.shape):
            raise TypeError(
                f"{cls.__name__}.columns: {field.name} has {math.prod(field.shape)} numbers a row, but {names} are "
                f"{len(names)} names"
            )
        for place, name in zip(np.ndindex(*field.shape), names, strict=False):
            scale = np.pi / 180 if name.endswith(tuple(f"_{u}" for u in FILE_UNITS.values())) else 1.0
            found.append(Column(name, field.name, place, field.touches, field.whole, scale))
    return tuple(found)


def file_unit(cls: Any) -> str:
    """The unit of a class of observations as columns end in it: _m, _deg; "" where it has none."""
    unit = FILE_UNITS.get(cls.unit, cls.unit)
    return f"_{unit}" if unit else ""


def sigma_key(cls: Any) -> str:
    """The key under [sigmas] of block.toml that stands for sigmas which a table leaves out: distance_m."""
    return cls.group.removesuffix("s") + file_unit(cls)


def _names(cls: Any, field: RowField) -> tuple[str, ...]:
    unit = "" if field.whole else file_unit(cls)
    by_axis = not field.whole and len(cls.axes) > 1 and field.shape == (len(cls.axes),)
    ends = cls.axes if by_axis else ["_".join(str(k + 1) for k in place) for place in np.ndindex(*field.shape)]
    return tuple(f"{field.name}_{end}{unit}" if end else f"{field.name}{unit}" for end in ends)
