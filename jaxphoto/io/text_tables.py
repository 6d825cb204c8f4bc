"""Text tables, read by pandas; each line retains its file and row number for messages.

Rows are numbered from 1, including header, comments and empty lines, as in a spreadsheet.
"""

import dataclasses
import io
import math
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxphoto.errors import BlockError, InputError, RowError, quoted, shown
from jaxphoto.io.text_files import read_text

# Index of a line in its table, as Python or NumPy integer.
Line = int | np.integer
# Columns in which a comma is not a decimal comma.
_TEXT = frozenset({"image", "camera", "strip", "point", "role"})
LARGEST = 1e30
"""Maximum absolute value of lengths, angles, times and coefficients; squares of values below it are finite."""


@dataclasses.dataclass(frozen=True)
class Table:
    """Columns of equal length: text, or floats with NaN for empty cells.

    `files` and `rows` (n,) locate each line; `file` names the whole table.
    """

    file: str
    columns: dict[str, Any]
    files: np.ndarray
    rows: np.ndarray

    @staticmethod
    def of(file: str, columns: dict[str, Any], rows: np.ndarray | None = None) -> "Table":
        """Build a table of one file; without `rows`, lines are numbered from 1."""
        n = len(next(iter(columns.values()))) if columns else 0
        return Table(file, columns, np.full(n, file, object), np.arange(1, n + 1) if rows is None else rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __contains__(self, column: str) -> bool:
        return column in self.columns

    def take(self, chosen: np.ndarray) -> "Table":
        """Select lines by a mask or by indices."""
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return Table(self.file, columns, self.files[chosen], self.rows[chosen])

    def place(self, line: Line) -> str:
        """Return file and row of a line, for messages."""
        return f"{self.files[line]}, row {self.rows[line]}"

    def bad(self, line: Line, message: str) -> RowError:
        """Return an error about the content of one line."""
        return RowError(f"{self.place(line)}: {message}", [int(self.rows[line])])

    def misfit(self, line: Line, message: str) -> BlockError:
        """Return an error about the relation of one line to others."""
        return BlockError(f"{self.place(line)}: {message}")

    def check(self, wrong: np.ndarray, message: Callable[[Line], str]) -> None:
        """Raise RowError for the lines of a mask, with the message of the first."""
        lines = np.flatnonzero(wrong)
        if len(lines):
            raise RowError(f"{self.place(lines[0])}: {message(lines[0])}", self.rows[lines].tolist())

    def text(self, column: str) -> np.ndarray:
        """Return a text column; empty strings if the column is missing."""
        cells = self.columns.get(column)
        return np.full(len(self), "", object) if cells is None else np.asarray(cells, object)

    def ids(self, column: str) -> np.ndarray:
        """Return an id column. Raises RowError for an empty id."""
        values = self.text(column)
        self.check(values == "", lambda line: f"the {column} is empty; give its id or delete the row")
        return values

    def find(self, column: str, known: Sequence[str], message: Callable[[str], str]) -> np.ndarray:
        """Return the index in `known` of the id of each line. Raises BlockError with `message` for an unknown id."""
        named = self.ids(column)
        index = pd.Index(np.array(known, object)).get_indexer(pd.Index(named))
        for line in np.flatnonzero(index < 0)[:1]:
            raise self.misfit(line, message(named[line]))
        return index

    def numbers(self, column: str, *, empty: bool = False) -> np.ndarray:
        """Return a column of finite floats; `empty` permits NaN for empty cells and missing columns."""
        cells = self.columns.get(column)
        if cells is None:
            return np.full(len(self), np.nan)
        values = cells if cells.dtype == float else self._parsed(column, cells)
        self.check(
            np.abs(values) > LARGEST,
            lambda line: f"{column} is {values[line]:g}, not a plausible finite number; correct it",
        )
        if not empty:
            self.check(np.isnan(values), lambda line: f"{column} is empty; give a number or delete the row")
        return values

    def matrix(self, columns: Sequence[str], *, empty: bool = False) -> np.ndarray:
        """Return columns of finite floats, (n, columns)."""
        return np.stack([self.numbers(column, empty=empty) for column in columns], axis=1)

    def sigmas(self, column: str) -> np.ndarray:
        """Return a column of positive standard deviations; NaN for empty cells."""
        values = self.numbers(column, empty=True)
        self.check(
            values <= 0,
            lambda line: f"{column} is {values[line]:g}; a standard deviation is positive; correct it",
        )
        return values

    def _parsed(self, column: str, cells: Any) -> np.ndarray:
        cells = np.asarray(cells, object)
        try:
            # Parse by Python, which rounds correctly: numbers written by repr are restored exactly.
            values = np.where(cells == "", "nan", cells).astype(float)
            wrong = np.array(["_" in cell for cell in cells], bool)
        except ValueError:
            wrong = np.array([cell != "" and not is_number(cell) for cell in cells], bool)
        self.check(wrong, lambda line: f"{column} is {quoted(cells[line])}, not a number; write it like 12.34")
        self.check(
            (cells != "") & ~np.isfinite(values),
            lambda k: f"{column} is {quoted(cells[k])}; give a finite number, or leave the cell empty if it is unknown",
        )
        return values


def concatenate(tables: Sequence[Table]) -> Table:
    """Concatenate tables with the same columns."""
    first = tables[0]
    columns = {name: np.concatenate([t.columns[name] for t in tables]) for name in first.columns}
    return Table(
        ", ".join(t.file for t in tables),
        columns,
        np.concatenate([t.files for t in tables]),
        np.concatenate([t.rows for t in tables]),
    )


def read_csv(path: Path, needed: Sequence[str], optional: Sequence[str] = (), text: Sequence[str] = ()) -> Table:
    """Read a CSV file with a header, separated by commas, semicolons or tabs (the latter two also with decimal commas).

    Empty lines and lines that start with `#` are skipped. Columns in neither list are ignored with a UserWarning. In
    the columns `text`, a comma is not a decimal comma.

    Raises InputError if the file or a needed column is missing, or if a row has too many cells.
    """
    # Avoid splitlines(): it also splits at form feeds and other characters that editors do not count as line ends.
    numbered = enumerate(read_text(path).split("\n"), 1)
    content = [(row, line) for row, line in numbered if line.strip() and not line.lstrip().startswith("#")]
    rows, lines = [row for row, _ in content], [line for _, line in content]
    if not lines:
        raise InputError(f"{path.name}: the file is empty; give it a header with the columns {', '.join(needed)}")
    separator = ";" if ";" in lines[0] else "\t" if "\t" in lines[0] and "," not in lines[0] else ","
    cells = _cells(path, lines, rows, separator)
    header = cells.iloc[0].str.strip().tolist()
    for name in filter(None, header):
        if header.count(name) > 1:
            raise InputError(f"{path.name}, row {rows[0]}: the column {name} is given twice; keep one of them")
    for name in needed:
        if name not in header:
            listed = ", ".join(filter(None, header))
            raise InputError(f"{path.name}, row {rows[0]}: the column {name} is missing (found {listed}); add it")
    if unknown := [name for name in header if name and name not in needed and name not in optional]:
        message = f"{path.name}: unknown columns are not used: {', '.join(unknown)}"
        warnings.warn(shown(message), UserWarning, stacklevel=2)
    columns: dict[str, Any] = {}
    for j, name in enumerate(header):
        if name in needed or name in optional:
            column = cells[j].iloc[1:].str.strip()
            if name in _TEXT or name in text:
                # Ids repeat: store each string once.
                codes, ids = pd.factorize(column)
                columns[name] = ids.to_numpy(object)[codes]
            else:
                columns[name] = (column if separator == "," else column.str.replace(",", ".", regex=False)).array
    return Table.of(path.name, columns, np.array(rows[1:], int))


def _cells(path: Path, lines: list[str], rows: list[int], separator: str) -> pd.DataFrame:
    """Read all cells as text. Raises RowError for a row with too many cells or an open quotation."""
    try:
        return pd.read_csv(
            io.StringIO("\n".join(lines)), sep=separator, header=None, dtype=str, na_filter=False, skipinitialspace=True
        )
    except pd.errors.ParserError as error:
        surplus = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", str(error))
        quotation = next((k for k, line in enumerate(lines) if line.count('"') % 2), len(lines) - 1)
    if surplus is not None and int(surplus[2]) <= quotation + 1:
        row, hint = rows[int(surplus[2]) - 1], ""
        if separator == ",":
            hint = " (decimal commas need semicolons between the columns)"
        message = f"{surplus[3]} cells, but the header has {surplus[1]}; remove the extra cells{hint}"
    else:
        row, message = rows[quotation], "unpaired quotation marks; close or remove them in that row"
    raise RowError(f"{path.name}, row {row}: {message}", [row])


def finite(cell: str) -> float | None:
    """Parse a finite number; None for other text, or above `LARGEST`."""
    value = float(cell) if is_number(cell) else math.inf
    return value if abs(value) <= LARGEST else None


def is_number(cell: str) -> bool:
    """Return True if a cell is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True
