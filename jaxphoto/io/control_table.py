"""Tables with column names of other programs: control points, image marks and exposures.

Cells are separated by tabs, semicolons, commas or blanks. Column names are matched ignoring case, order and unit.
Source: Agisoft Metashape User Manual, "Reference pane"; Pix4D documentation, "Tie points import format".
"""

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxphoto.errors import InputError, RowError, quoted
from jaxphoto.io.text_tables import LARGEST, finite

SYSTEM = re.compile(r"EPSG:\d|\+proj=|WGS\s?84(?:\s+UTM\s|\s*$)", re.IGNORECASE)
"""First line of an OpenDroneMap file, which names its coordinate system."""
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
"""Column names of coordinates and their standard deviations."""
_UNIT = re.compile(r"\s*[\[(][^\])]*[\])]|\s+m$|\s+deg$")
_LONGEST_WORD = 60

Columns = dict[str, int]
"""Index of each column, by its meaning."""


class Cells(NamedTuple):
    """Cells of the rows of a file."""

    file: str
    records: list[list[str]]
    rows: list[int]

    def place(self, k: int) -> str:
        """Return file and row for messages."""
        return f"{self.file}, row {self.rows[k]}"

    def bad(self, k: int, message: str) -> RowError:
        """Return an error about row `k`."""
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
        """Parse a finite number. Raise RowError for other cells."""
        value = finite(self.records[k][column])
        if value is None:
            cell = quoted(self.records[k][column])
            raise self.bad(k, f"{name} is {cell}, not a number below {LARGEST:g}; write it like 12.34")
        return value

    def height(self, k: int, column: int) -> float:
        """Parse a height; NaN if the cell is empty or nan."""
        return np.nan if self.records[k][column].lower() in ("", "nan") else self.number(k, column, "the height")

    def sigma(self, k: int, column: int | None, name: str) -> float:
        """Parse a standard deviation; NaN if column or cell is missing."""
        if column is None or len(self.records[k]) <= column or not self.records[k][column]:
            return np.nan
        value = self.number(k, column, name)
        if value <= 0:
            raise self.bad(k, f"{name} is {value:g}; a standard deviation is positive; correct it")
        return value


def columns_of(header: Sequence[str], words: Mapping[str, tuple[str, ...]]) -> Columns:
    """Return the first matching column of each meaning; a column has one meaning only."""
    cells = [header_words(cell) for cell in header]
    columns: Columns = {}
    for meaning, names in words.items():
        places = (k for name in names for k, cell in enumerate(cells) if name in cell and k not in columns.values())
        if (place := next(places, None)) is not None:
            columns[meaning] = place
    return columns


def in_degrees(header: Sequence[str], columns: Columns) -> bool:
    """Return True if the header names longitude or latitude."""
    return not {"longitude", "lon", "long", "latitude", "lat"}.isdisjoint(header_words(header[columns["x"]]))


def header_words(cell: str) -> list[str]:
    """Return a header cell without its unit, followed by its words on both sides of a slash."""
    if len(cell) > _LONGEST_WORD:
        return []
    text = re.sub(r"[\s_]+", " ", cell.strip().lstrip("#").strip().lower())
    text = _UNIT.sub("", text).strip()
    return [text, *(text.split("/") if "accuracy" not in text else ())]


def separator_of(line: str) -> str:
    """Return the separator of a row: a tab, a semicolon, a comma, else a blank."""
    return next((s for s in ("\t", ";", ",") if s in line), " ")


def split_row(file: str, line: str, row: int, separator: str) -> list[str]:
    """Split a row into cells. Raise RowError for unpaired quotation marks."""
    try:
        (cells,) = (
            [line.split()]
            if separator == " "
            else csv.reader([line], delimiter=separator, skipinitialspace=True, strict=True)
        )
    except csv.Error:
        raise RowError(f"{file}, row {row}: unpaired quotation marks; close or remove them", [row]) from None
    return [cell.strip() for cell in cells]


def with_points(cells: Cells, separator: str, *text: int) -> Cells:
    """Replace decimal commas by points, except in the columns `text`."""
    if separator == ",":
        return cells
    records = [[c if k in text else c.replace(",", ".") for k, c in enumerate(row)] for row in cells.records]
    return cells._replace(records=records)
