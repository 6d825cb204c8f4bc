"""Tables whose columns are named in the words of many programs: control points, marks and exposures.

Cells are separated by tabs, semicolons, commas or blanks; header words count in any case, order and unit.
Source: Agisoft Metashape User Manual, "Reference pane"; Pix4D documentation, "Tie points import format".
"""

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxphoto.errors import InputError, RowError, quoted
from jaxphoto.io.text_tables import LARGEST, finite

SYSTEM = re.compile(r"EPSG:\d|\+proj=|WGS84\s+UTM\s", re.IGNORECASE)
"""The first line of a file of OpenDroneMap, which names its coordinate system."""
PLACE = {
    "x": ("x", "easting", "east", "e", "longitude", "lon", "long"),
    "y": ("y", "northing", "north", "n", "latitude", "lat"),
    "z": ("z", "altitude", "height", "elevation", "h"),
    "sigma_x": ("sigma x", "accuracy x", "x accuracy", "x acc", "sigma", "accuracy"),
    "sigma_y": ("sigma y", "accuracy y", "y accuracy", "y acc"),
    "sigma_z": (
        "sigma z", "sigma vertical", "accuracy z", "z accuracy", "z acc", "accuracy vert", "accuracy vertical",
        "vertical accuracy",
    ),
    "sigma_plan": (
        "sigma plan", "sigma xy", "sigma horizontal", "accuracy xy", "accuracy x/y", "accuracy horz",
        "accuracy horizontal", "horizontal accuracy",
    ),
}  # fmt: skip
"""Words for coordinates and their standard deviations."""
_UNIT = re.compile(r"\s*[\[(][^\])]*[\])]|\s+m$|\s+deg$")
_LONGEST_WORD = 60

Columns = dict[str, int]
"""The place of each column by its meaning."""


class Cells(NamedTuple):
    """The cells of the rows of one file."""

    file: str
    records: list[list[str]]
    rows: list[int]
    called: str = "row"
    """The file's word for a row."""

    def place(self, k: int) -> str:
        """Return file and row for messages."""
        return f"{self.file}, {self.called} {self.rows[k]}"

    def bad(self, k: int, message: str) -> RowError:
        """Return an error about one row."""
        return RowError(f"{self.place(k)}: {message}", [self.rows[k]])

    def check(self, valid: Sequence[bool] | np.ndarray, message: Callable[[int], str]) -> None:
        """Raise RowError with the message of the first row that is not `valid`."""
        wrong = [k for k, good in enumerate(valid) if not good]
        if wrong:
            raise RowError(f"{self.place(wrong[0])}: {message(wrong[0])}", [self.rows[k] for k in wrong])

    def none(self, message: str) -> InputError:
        """Return an error about the file."""
        return InputError(f"{self.file}: {message}")

    def number(self, k: int, column: int, name: str) -> float:
        """Return the finite number in a cell."""
        value = finite(self.records[k][column])
        if value is None:
            cell = quoted(self.records[k][column])
            raise self.bad(k, f"{name} is {cell}, not a number below {LARGEST:g}; write it like 12.34")
        return value

    def height(self, k: int, column: int) -> float:
        """Return the number in a cell, NaN if it is empty or nan."""
        return np.nan if self.records[k][column].lower() in ("", "nan") else self.number(k, column, "the height")

    def sigma(self, k: int, column: int | None, name: str) -> float:
        """Return a standard deviation, NaN if column or cell is missing."""
        if column is None or len(self.records[k]) <= column or not self.records[k][column]:
            return np.nan
        value = self.number(k, column, name)
        if value <= 0:
            raise self.bad(k, f"{name} is {value:g}; a standard deviation is positive, so give its true value")
        return value


def columns_of(header: Sequence[str], words: Mapping[str, tuple[str, ...]]) -> Columns:
    """Return the first column for each meaning; a column has one meaning only."""
    cells = [header_words(cell) for cell in header]
    columns: Columns = {}
    for meaning, names in words.items():
        places = (k for name in names for k, cell in enumerate(cells) if name in cell and k not in columns.values())
        if (place := next(places, None)) is not None:
            columns[meaning] = place
    return columns


def in_degrees(header: Sequence[str], columns: Columns) -> bool:
    """Return True if the header calls the first two coordinates longitude and latitude."""
    return not {"longitude", "lon", "long", "latitude", "lat"}.isdisjoint(header_words(header[columns["x"]]))


def header_words(cell: str) -> list[str]:
    """Return a header cell without its unit, and its words on both sides of a slash."""
    if len(cell) > _LONGEST_WORD:
        return []
    text = re.sub(r"[\s_]+", " ", cell.strip().lstrip("#").strip().lower())
    text = _UNIT.sub("", text).strip()
    return [text, *(text.split("/") if "accuracy" not in text else ())]


def separator_of(line: str) -> str:
    """Return the separator of a row: a tab, a semicolon, a comma, else a blank."""
    return next((s for s in ("\t", ";", ",") if s in line), " ")


def split_row(file: str, line: str, row: int, separator: str) -> list[str]:
    """Return the cells of a row. Raise RowError for quotation marks that do not pair and rows that are too long."""
    try:
        (cells,) = (
            [line.split()]
            if separator == " "
            else csv.reader([line], delimiter=separator, skipinitialspace=True, strict=True)
        )
    except csv.Error:
        raise RowError(f"{file}, row {row}: the quotation marks do not pair; close or remove them", [row]) from None
    return [cell.strip() for cell in cells]


def with_points(cells: Cells, separator: str, *text: int) -> Cells:
    """Return cells with decimal points for decimal commas, except in the columns `text`."""
    if separator == ",":
        return cells
    records = [[c if k in text else c.replace(",", ".") for k, c in enumerate(row)] for row in cells.records]
    return cells._replace(records=records)
