"""Columns of the table of an observation class in a block folder, derived from its fields.

    index_of("point"), one per row      start                           an id
    index_of("point"), m per row        points_1, points_2              ids
    integers                            axis
    numbers, one per row                value_m                         unit of the class; rad are degrees in files
    numbers, one per axis               value_X_m, value_Y_m, value_Z_m

`columns` of the class renames those of a field; () means that the field is zero and has no column.
"""

import dataclasses
import functools
import math
import typing
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.arrays import annotated

FILE_UNITS = {"rad": "deg", "rad_per_s": "deg_per_s"}
"""Units of files in place of those of computations."""


class Column(NamedTuple):
    """One column of a table of observations."""

    name: str
    field: str
    place: tuple[int, ...]
    """Index of the number within a row of the field; () for a single one."""
    touches: str
    """Kind of object that its ids name; "" for numbers."""
    whole: bool
    scale: float
    """Factor of its numbers."""

    @property
    def of_rows(self) -> tuple[Any, ...]:
        """Return the index of its numbers in the field of all rows."""
        return (slice(None), *self.place)


class RowField(NamedTuple):
    """Part of a field that belongs to one row."""

    name: str
    touches: str
    whole: bool
    shape: tuple[int, ...]


@functools.cache
def row_fields(cls: type) -> list[RowField]:
    """Return the annotated fields of an observation class: `Int[np.ndarray, "n 2"]` is two indices per row."""
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
    """Return the fields that hold indices: those that touch something, and integers."""
    fields = dataclasses.fields(cls)
    # Names in the annotations of a class within a function may be out of scope.
    hints = (
        typing.get_type_hints(cls) if any(isinstance(f.type, str) for f in fields) else {f.name: f.type for f in fields}
    )
    whole = {f.name for f in fields if (kind := annotated(hints[f.name])) is not None and kind[1]}
    return tuple(f.name for f in fields if "touches" in f.metadata or f.name in whole)


def columns_of(cls: Any) -> tuple[Column, ...]:
    """Return the columns of the table of an observation class, in order."""
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
    """Return the unit of an observation class as in column names: _m, _deg; "" if it has none."""
    unit = FILE_UNITS.get(cls.unit, cls.unit)
    return f"_{unit}" if unit else ""


def sigma_key(cls: Any) -> str:
    """Return the key under [sigmas] of block.toml for omitted sigmas: distance_m."""
    return cls.group.removesuffix("s") + file_unit(cls)


def _names(cls: Any, field: RowField) -> tuple[str, ...]:
    unit = "" if field.whole else file_unit(cls)
    by_axis = not field.whole and len(cls.axes) > 1 and field.shape == (len(cls.axes),)
    ends = cls.axes if by_axis else ["_".join(str(k + 1) for k in place) for place in np.ndindex(*field.shape)]
    return tuple(f"{field.name}_{end}{unit}" if end else f"{field.name}{unit}" for end in ends)
