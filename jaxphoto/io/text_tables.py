"""Tables of text files, read by pandas: every line keeps its file and row, which messages name.

A row is counted as a spreadsheet counts it: header, comments and empty lines included, from 1.
"""

import dataclasses
import io
import math
import re
import warnings
from collections.abc import Callable, Container, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from jaxphoto.errors import BlockError, InputError, RowError, quoted, shown
from jaxphoto.io.whole_text import LARGE, read_text

T = TypeVar("T")
# The index of a line in its table, from Python or from numpy.
Line = int | np.integer
# The columns in which a comma is not a decimal comma.
_TEXT = frozenset({"image", "camera", "strip", "point", "role"})
LARGEST = 1e30
"""No length, angle, time or coefficient is larger; its square is still a number."""
# What fits into 64 bits.
_DIGITS = 18
MOST_COLUMNS, LONGEST_LINE = 1_000, 100_000
"""Columns of a table, and characters of a row."""


@dataclasses.dataclass(frozen=True)
class Table:
    """Columns of equal length: arrays of text or of floats (NaN: empty), or pandas' arrays of text.

    `files` and `rows` (both (n,)) give the place of each line, `file` that of the whole table.
    """

    file: str
    columns: dict[str, Any]
    files: np.ndarray
    rows: np.ndarray

    @staticmethod
    def of(file: str, columns: dict[str, Any], rows: np.ndarray | None = None) -> "Table":
        """A table all of whose lines stand in one file (`rows` None: one after the other from 1)."""
        n = len(next(iter(columns.values()))) if columns else 0
        return Table(file, columns, np.full(n, file, object), np.arange(1, n + 1) if rows is None else rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __contains__(self, column: str) -> bool:
        return column in self.columns

    def take(self, chosen: np.ndarray) -> "Table":
        """The lines chosen by a mask or by indices."""
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return Table(self.file, columns, self.files[chosen], self.rows[chosen])

    def place(self, line: Line) -> str:
        """The file and row of a line, as messages name it."""
        return f"{self.files[line]}, row {self.rows[line]}"

    def bad(self, line: Line, message: str) -> RowError:
        """An error about the content of one line."""
        return RowError(f"{self.place(line)}: {message}", [int(self.rows[line])])

    def check(self, wrong: np.ndarray, message: Callable[[Line], str]) -> None:
        """Raise RowError, with the message of the first, for lines that are `wrong` (a mask)."""
        lines = np.flatnonzero(wrong)
        if len(lines):
            raise RowError(f"{self.place(lines[0])}: {message(lines[0])}", self.rows[lines].tolist())

    def misfit(self, line: Line, message: str) -> BlockError:
        """An error about how one line fits the others."""
        return BlockError(f"{self.place(line)}: {message}")

    def text(self, column: str) -> np.ndarray:
        """A column as text; empty everywhere where the file has no such column."""
        cells = self.columns.get(column)
        return np.full(len(self), "", object) if cells is None else np.asarray(cells, object)

    def ids(self, column: str) -> np.ndarray:
        """A column of ids, none of them empty."""
        values = self.text(column)
        self.check(values == "", lambda line: f"the {column} is empty; give its id or delete the row")
        return values

    def find(self, column: str, known: Sequence[str], message: Callable[[str], str]) -> np.ndarray:
        """The index in `known` of the id in each line. Raises BlockError with the `message` about an unknown id."""
        named = self.ids(column)
        index = pd.Index(np.array(known, object)).get_indexer(pd.Index(named))
        for line in np.flatnonzero(index < 0)[:1]:
            raise self.misfit(line, message(named[line]))
        return index

    def numbers(self, column: str, *, empty: bool = False) -> np.ndarray:
        """A column of finite numbers; NaN stands for an empty cell or a missing column where `empty` allows it."""
        cells = self.columns.get(column)
        if cells is None:
            return np.full(len(self), np.nan)
        values = cells if cells.dtype == float else self._parsed(column, cells)
        self.check(
            np.abs(values) > LARGEST,
            lambda line: f"{column} is {values[line]:g}, not a finite number that can be measured; correct it",
        )
        if not empty:
            self.check(np.isnan(values), lambda line: f"{column} is empty; give a number or delete the row")
        return values

    def matrix(self, columns: Sequence[str], *, empty: bool = False) -> np.ndarray:
        """Columns of numbers beside each other, (n, columns)."""
        return np.stack([self.numbers(column, empty=empty) for column in columns], axis=1)

    def sigmas(self, column: str) -> np.ndarray:
        """A column of standard deviations, positive where given and NaN where not."""
        values = self.numbers(column, empty=True)
        self.check(
            values <= 0,
            lambda line: f"{column} is {values[line]:g}; a standard deviation is positive, so give its true value",
        )
        return values

    def _parsed(self, column: str, cells: Any) -> np.ndarray:
        cells = np.asarray(cells, object)
        try:
            # Python's conversion rounds correctly: a number written by repr comes back exactly.
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
    """One table of several with the same columns."""
    first = tables[0]
    columns = {name: np.concatenate([t.columns[name] for t in tables]) for name in first.columns}
    return Table(
        ", ".join(t.file for t in tables),
        columns,
        np.concatenate([t.files for t in tables]),
        np.concatenate([t.rows for t in tables]),
    )


def read_csv(
    path: Path,
    needed: Sequence[str],
    optional: Sequence[str] = (),
    text: Sequence[str] = (),
    without: Container[int] = (),
) -> Table:
    """A CSV file with a header: separated by commas, or by semicolons or tabs (then with decimal commas, too).

    Lines that start with `#`, empty lines and rows `without` are skipped. Columns in neither list are left out, with a
    UserWarning. A comma in the columns `text` is not a decimal comma.

    Raises InputError where the file or a needed column is missing, or a row has too many cells.
    """
    lines, rows = content_lines(path, without)
    if not lines:
        raise InputError(f"{path.name}: the file is empty; give it a header with the columns {', '.join(needed)}")
    separator = ";" if ";" in lines[0] else "\t" if "\t" in lines[0] and "," not in lines[0] else ","
    cells = _cells(path, lines, rows, separator)
    header = cells.iloc[0].str.strip().tolist()
    for name in filter(None, header):
        if header.count(name) > 1:
            raise InputError(f"{path.name}, row {rows[0]}: the column {name} stands there twice; keep one of them")
    for name in needed:
        if name not in header:
            listed = ", ".join(filter(None, header))
            raise InputError(f"{path.name}, row {rows[0]}: the column {name} is missing (found {listed}); add it")
    if unknown := [name for name in header if name and name not in needed and name not in optional]:
        message = f"{path.name}: columns that jaxphoto does not know are not used: {', '.join(unknown)}"
        warnings.warn(shown(message), UserWarning, stacklevel=2)
    columns: dict[str, Any] = {}
    for j, name in enumerate(header):
        if name in needed or name in optional:
            column = cells[j].iloc[1:].str.strip()
            if name in _TEXT or name in text:
                # Ids repeat: each is kept once.
                codes, ids = pd.factorize(column)
                columns[name] = ids.to_numpy(object)[codes]
            else:
                columns[name] = (column if separator == "," else column.str.replace(",", ".", regex=False)).array
    return Table.of(path.name, columns, np.array(rows[1:], int))


def _cells(path: Path, lines: list[str], rows: list[int], separator: str) -> pd.DataFrame:
    """All cells as text. Raises RowError for a row with too many cells or an open quotation."""
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
        message = f"{surplus[3]} cells, but the header has {surplus[1]}; remove the surplus ones{hint}"
    else:
        row, message = rows[quotation], "the quotation marks do not pair; close or remove them in that row"
    raise RowError(f"{path.name}, row {row}: {message}", [row])


def content_lines(path: Path, without: Container[int] = ()) -> tuple[list[str], list[int]]:
    """The lines of a text file that are neither empty nor comments nor `without`, and their row numbers."""
    # Not splitlines(): that also ends lines at form feeds and other characters an editor does not count.
    lines = read_text(path, LARGE).split("\n")
    content = lambda line: line.strip() and not line.lstrip().startswith("#")  # noqa: E731
    rows = [row for row, line in enumerate(lines, 1) if content(line) and row not in without]
    return [lines[row - 1] for row in rows], rows


def each_row(read: Callable[[int, str], T], numbered: Iterable[tuple[int, str]]) -> list[T]:
    """What `read` makes of the rows and their lines. Raises the first RowError that it raises, with the rows of all."""
    values: list[T] = []
    first, rows = None, set[int]()
    for row, line in numbered:
        try:
            values.append(read(row, line))
        except RowError as error:
            first = first or error
            rows.update(error.rows)
    if first is not None:
        raise RowError(str(first), rows)
    return values


def natural(cell: str) -> int | None:
    """The whole number, zero or more, that a cell is; None where it is none, or has more digits than any count."""
    return int(cell) if cell.isascii() and cell.isdigit() and len(cell) <= _DIGITS else None


def finite(cell: str) -> float | None:
    """The number that a cell is; None where it is none, not finite or larger than any can be here."""
    value = float(cell) if is_number(cell) else math.inf
    return value if abs(value) <= LARGEST else None


def is_number(cell: str) -> bool:
    """Whether a cell reads as a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True
