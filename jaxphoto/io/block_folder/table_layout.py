"""Tables of a block folder: their columns, kinds of cells, required columns, and checks."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.block import Frame
from jaxphoto.georeferencing.map_frame import map_system
from jaxphoto.io.text_tables import Table

TOML = "block.toml"
XYZ = ("X_m", "Y_m", "Z_m")
PLACE = ("longitude_deg", "latitude_deg", "height_m")
SIGMA_XYZ = ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
ATTITUDE = ("roll_deg", "pitch_deg", "yaw_deg")
SIGMA_ATTITUDE = ("sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg")
VELOCITY = ("vX_m_per_s", "vY_m_per_s", "vZ_m_per_s")
RATE = ("rate_right_deg_per_s", "rate_forward_deg_per_s", "rate_up_deg_per_s")
FOOT = ("foot_X_m", "foot_Y_m", "foot_Z_m")
NORMAL = ("normal_X", "normal_Y", "normal_Z")
TURN = ("turn_right_m", "turn_forward_m", "turn_up_m")


class Column(NamedTuple):
    """A column of text or floats; a `sigma` is positive, an `angle` at most 360 degrees, a `whole` an integer."""

    name: str
    kind: Literal["text", "number", "coordinate", "sigma", "angle", "whole"] = "number"
    required: bool = False
    """True if column and cells must be present; coordinates may be empty, and sigmas may come from [sigmas]."""


class TableLayout(NamedTuple):
    """Layout of one CSV file of the folder."""

    columns: tuple[Column, ...]
    required: bool = False
    unique: tuple[str, ...] = ()
    """Columns whose combination is unique per row."""

    def names(self, required: bool) -> tuple[str, ...]:
        """Return the required or the optional columns."""
        return tuple(c.name for c in self.columns if c.required == required)

    @property
    def text(self) -> tuple[str, ...]:
        """Names of the text columns."""
        return tuple(c.name for c in self.columns if c.kind == "text")


def text(*names: str, required: bool = True) -> tuple[Column, ...]:
    """Return text columns."""
    return tuple(Column(name, "text", required) for name in names)


def numbers(*names: str, required: bool = False) -> tuple[Column, ...]:
    """Return numeric columns; the name determines the kind."""
    angles = (*ANGLES, *ATTITUDE)
    return tuple(
        Column(n, "sigma" if n.startswith("sigma_") else "angle" if n in angles else "number", required) for n in names
    )


LAYOUTS = {
    "images": TableLayout(
        (
            *text("image", "camera"), *text("strip", required=False),
            *numbers("time_s", "temperature_c", *XYZ, *ANGLES),
        ), True, ("image",),
    ),
    "image_points": TableLayout(
        (
            *text("image", "point"),
            *numbers("x_mm", "y_mm", "column_px", "row_px", "sigma_x_mm", "sigma_y_mm", "sigma_px"),
        ), True, ("image", "point"),
    ),
    "control_points": TableLayout((*text("point"), *numbers(*XYZ, *SIGMA_XYZ), *text("role", required=False))),
    "stations": TableLayout(
        (*text("image"), *(Column(name, "coordinate", True) for name in XYZ), *numbers(*SIGMA_XYZ, *VELOCITY)),
        unique=("image",),
    ),
    "attitudes": TableLayout(
        (*text("image"), *numbers(*ATTITUDE, required=True), *numbers(*SIGMA_ATTITUDE, *RATE)), unique=("image",)
    ),
    "object_points": TableLayout((*text("point"), *numbers(*XYZ, required=True)), unique=("point",)),
    "surfaces": TableLayout(
        (*text("point"), *numbers(*FOOT, *NORMAL, *TURN, "sigma_m", required=True), *text("strip", required=False))
    ),
}  # fmt: skip
"""Layouts of the block's own tables; `declared_tables` derives the others from the classes of observations."""


def coordinate_names(frame: Frame) -> tuple[str, ...]:
    """Return the names of the coordinate columns in the files of a block in `frame`."""
    geographic = frame.code is not None and map_system(frame.code).is_geographic
    return PLACE if geographic else XYZ


def layout_in(frame: Frame, layout: TableLayout) -> TableLayout:
    """Return the layout of a table of a block in `frame`."""
    names = dict(zip(XYZ, coordinate_names(frame), strict=True))
    return layout._replace(columns=tuple(c._replace(name=names.get(c.name, c.name)) for c in layout.columns))


def checked(table: Table, layout: TableLayout) -> Table:
    """Check a table and return all columns of its layout: text ids, floats, "" and NaN for empty cells.

    Raises RowError for the first invalid cell, and for duplicate rows.
    """
    columns: dict[str, np.ndarray] = {}
    for column, kind, required in layout.columns:
        if kind == "text":
            columns[column] = table.ids(column) if required else table.text(column)
        elif kind == "sigma":
            columns[column] = table.sigmas(column)
        elif column in table or required:
            columns[column] = table.numbers(column, empty=not required or kind == "coordinate")
        if kind == "angle" and column in columns:
            check_angles(table, columns[column][:, None], (column,))
        if kind == "whole":
            values = columns[column]
            for line in np.flatnonzero(values != np.round(values))[:1]:
                raise table.bad(line, f"{column} is {values[line]:g}, not a whole number like 2; correct it")
    result = Table(table.file, columns, table.files, table.rows)
    refuse_duplicates(result, {column: columns[column] for column in layout.unique})
    return result


def check_angles(table: Table, degrees: np.ndarray, columns: Sequence[str]) -> None:
    """Raise RowError for an angle above 360 degrees."""
    for line, axis in np.argwhere(np.abs(degrees) > 360)[:1]:
        message = f"{columns[axis]} = {degrees[line, axis]:g} is more than a full rotation; give the angle in degrees"
        raise table.bad(line, message)


def refuse_duplicates(table: Table, keys: dict[str, np.ndarray], thing: str = "") -> None:
    """Raise RowError if two rows agree in all `keys`."""
    frame = pd.DataFrame(keys)
    for line in np.flatnonzero(frame.duplicated())[:1] if keys else ():
        first = int(np.flatnonzero((frame == frame.iloc[line]).all(axis=1))[0])
        named = thing or ", ".join(f"{name} {values[line]}" for name, values in keys.items())
        raise table.bad(line, f"{named} is given twice, first in {table.place(first)}; delete one of the rows")
