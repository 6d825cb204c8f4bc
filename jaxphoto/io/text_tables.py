"""Tables of text files: every line keeps its file and row, so that whatever is wrong in it can be named.

A row is counted as a spreadsheet counts it: header, comments and empty lines included, from 1.
"""

import collections
import csv
import dataclasses
import math
import warnings
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import pandas as pd

from jaxphoto.errors import BlockError, InputError, RowError, quoted, shown
from jaxphoto.io.names import LONGEST, harm_in, harmless
from jaxphoto.io.whole_text import LARGE, read_text

T = TypeVar("T")
# The index of a line in its table, from Python or from numpy.
Line = int | np.integer
# The columns in which a comma is not a decimal comma.
_TEXT = frozenset({"image", "camera", "strip", "point", "role"})
LARGEST = 1e30
"""No length, angle, time or coefficient is larger; the square of it is a number yet."""
# What fits into 64 bits.
_DIGITS = 18
# Cells of a column that are mostly different, as numbers are: a fifth of what Python's own texts need.
_PACKED = np.dtypes.StringDType()
# So many lines are taken apart at a time: memory for their cells then serves for the next ones as well.
_PIECE = 10_000
MOST_COLUMNS, LONGEST_LINE = 1_000, 100_000
"""Columns of a table, the widest of which has some fifty, and characters of a row."""


@dataclasses.dataclass(frozen=True)
class Table:
    """Columns of equal length; text, or floats where a reader has them already.

    `files` and `rows` (both (n,)) say where each line stands, `file` where the table as a whole does.
    """

    file: str
    columns: dict[str, np.ndarray]
    files: np.ndarray
    rows: np.ndarray

    @staticmethod
    def of(file: str, columns: dict[str, np.ndarray], rows: np.ndarray | None = None) -> "Table":
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
        if cells is None:
            return np.full(len(self), "", object)
        return cells.astype(object) if cells.dtype == _PACKED else cells

    def ids(self, column: str) -> np.ndarray:
        """A column of ids, none of them empty."""
        values = self.names(column)
        self.check(values == "", lambda line: f"the {column} is empty; give its id or delete the row")
        return values

    def names(self, column: str) -> np.ndarray:
        """A column of ids, some of which may be empty; none does harm where results show it (`jaxphoto.io.names`)."""
        values = self.text(column)
        if not harmless(pd.unique(values).tolist()):
            harm = [harm_in(name) for name in values]
            self.check(np.array(list(map(bool, harm))), lambda k: f"the {column} {quoted(values[k])} {harm[int(k)]}")
        return values

    def numbers(self, column: str, *, empty: bool = False) -> np.ndarray:
        """A column of finite numbers; NaN stands for an empty cell or a missing column where `empty` allows it."""
        if column not in self.columns:
            return np.full(len(self), np.nan)
        cells = self.columns[column]
        if cells.dtype in (object, _PACKED):
            cells = self._parsed(column, cells)
        else:
            self.check(~np.isfinite(cells), lambda line: f"{column} is {cells[line]}; give a finite number")
        self.check(
            np.abs(cells) > LARGEST,
            lambda line: f"{column} is {cells[line]:g}, larger than any number can be here; correct it",
        )
        if not empty:
            self.check(np.isnan(cells), lambda line: f"{column} is empty; give a number or delete the row")
        return cells

    def sigmas(self, column: str) -> np.ndarray:
        """A column of standard deviations, positive where given and NaN where not."""
        values = self.numbers(column, empty=True)
        self.check(
            values <= 0,
            lambda line: f"{column} is {values[line]:g}; a standard deviation is positive, so give its true value",
        )
        return values

    def _parsed(self, column: str, cells: np.ndarray) -> np.ndarray:
        filled = cells != ""
        values = np.full(len(cells), np.nan)
        try:
            # Python's own conversion: it rounds correctly, so a number written by repr comes back exactly.
            values[filled] = cells[filled].astype(float)
            # The one thing it reads that is no number in a table is 1_000.
            bad = np.strings.find(cells.astype(_PACKED), "_") >= 0
        except ValueError:
            bad = np.array([cell != "" and not is_number(cell) for cell in cells], bool)
        self.check(bad, lambda line: f"{column} is {quoted(cells[line])}, not a number; write it like 12.34")
        self.check(
            filled & ~np.isfinite(values),
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
    """A CSV with a header: separated by commas, or by semicolons or tabs (then decimal commas are read too).

    Lines that start with `#` and empty lines are passed over, blanks around a cell are stripped, a byte order mark
    and any line ends are accepted. Columns in neither list are left out, with a UserWarning. A comma in the columns
    `text` is not a decimal comma.

    Raises InputError where the file, a needed column or a cell is missing, too many or too long.
    """
    lines, rows = content_lines(path, without)
    if not lines:
        raise InputError(f"{path.name}: the file is empty; give it a header with the columns {', '.join(needed)}")
    separator = ";" if ";" in lines[0] else "\t" if "\t" in lines[0] and "," not in lines[0] else ","
    header = [name.strip() for name in _record(path, lines[0], rows[0], separator)]
    for name, count in collections.Counter(header).items():
        if name and count > 1:
            raise InputError(f"{path.name}, row {rows[0]}: the column {name} stands there twice; keep one of them")
    for name in needed:
        if name not in header:
            found = ", ".join(filter(None, header))
            raise InputError(f"{path.name}, row {rows[0]}: the column {name} is missing (found {found}); add it")
    known = {name: j for j, name in enumerate(header) if name in needed or name in optional}
    if unknown := [name for name in header if name and name not in known]:
        message = f"{path.name}: columns that jaxphoto does not know are not used: {', '.join(unknown)}"
        warnings.warn(shown(message), UserWarning, stacklevel=2)
    parts: dict[str, list[np.ndarray]] = {name: [] for name in known}
    named = {name: dict[str, str]() for name in known if name in _TEXT or name in text}
    for piece in _pieces(path, lines, rows, separator, len(header)):
        for name, j in known.items():
            cells = [cell.strip() for cell in piece[j]]
            if name in named:
                # Ids come again and again: each is kept once.
                parts[name].append(_objects([named[name].setdefault(cell, cell) for cell in cells]))
            else:
                plain = [cell.replace(",", ".") for cell in cells] if separator != "," else cells
                parts[name].append(np.array(plain, _PACKED))
    columns = {name: np.concatenate(several) if several else _objects([]) for name, several in parts.items()}
    return _of_short_cells(Table.of(path.name, columns, np.array(rows[1:], int)))


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


def _pieces(path: Path, lines: list[str], rows: list[int], separator: str, width: int) -> Iterator[list[list[str]]]:
    """The cells of all lines but the first, some thousand lines at a time, by column."""
    for at in range(1, len(lines), _PIECE):
        piece = lines[at : at + _PIECE]
        text = separator.join(piece)
        plain = '"' not in text and "\r" not in text and max(map(len, piece)) <= LONGEST_LINE
        if plain and all(line.count(separator) == width - 1 for line in piece):
            # Without a list for each line, of which Python would have to keep account.
            cells = text.split(separator)
            yield [cells[j::width] for j in range(width)]
        else:
            numbered = zip(rows[at : at + _PIECE], piece, strict=True)
            records = each_row(lambda row, line: _record(path, line, row, separator, width), numbered)
            yield list(map(list, zip(*records, strict=True)))


def _record(path: Path, line: str, row: int, separator: str, width: int = 0) -> list[str]:
    """The cells of a line, as many as `width` (0: as there are, of the first line)."""
    if len(line) > LONGEST_LINE:
        raise RowError(
            f"{path.name}, row {row}: the row has {len(line)} characters, and one of a table has at most "
            f"{LONGEST_LINE}; correct it",
            [row],
        )
    try:
        (record,) = csv.reader([line], delimiter=separator, skipinitialspace=True, strict=True)
    except csv.Error:
        raise RowError(
            f"{path.name}, row {row}: the quotation marks do not pair; close or remove them in that row", [row]
        ) from None
    width = width or len(record)
    if width > MOST_COLUMNS:
        raise InputError(
            f"{path.name}, row {row}: the header has {width} columns, and a table has at most {MOST_COLUMNS}; "
            "correct it"
        )
    if len(record) > width:
        raise RowError(
            f"{path.name}, row {row}: {len(record)} cells, but the header has {width}; remove the surplus ones"
            + (" (decimal commas need semicolons between the columns)" if separator == "," else ""),
            [row],
        )
    # Some spreadsheets leave out empty cells at the end of a row.
    return record + [""] * (width - len(record))


def _of_short_cells(table: Table) -> Table:
    """The table. Raises InputError for a cell that is longer than any id or number: arrays of text would explode."""
    for column, cells in table.columns.items():
        if max(map(len, cells), default=0) > LONGEST:
            line, cell = next((k, cell) for k, cell in enumerate(cells) if len(cell) > LONGEST)
            raise table.bad(
                line, f"{column} is {quoted(cell)} of {len(cell)} characters, the most are {LONGEST}; correct it"
            )
    return table


def _objects(cells: list[str]) -> np.ndarray:
    values = np.empty(len(cells), object)
    values[:] = cells
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
