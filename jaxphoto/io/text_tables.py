"""Tables of text files: every line keeps its file and row, so that whatever is wrong in it can be named.

A row is counted as a spreadsheet counts it: header, comments and empty lines included, from 1.
"""

import csv
import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxphoto.errors import BlockError, InputError

# The index of a line in its table, from Python or from numpy.
Line = int | np.integer
# The columns in which a comma is not a decimal comma.
_TEXT = frozenset({"image", "camera", "strip", "point", "role"})


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

    def bad(self, line: Line, message: str) -> InputError:
        """An error about the content of one line."""
        return InputError(f"{self.place(line)}: {message}")

    def misfit(self, line: Line, message: str) -> BlockError:
        """An error about how one line fits the others."""
        return BlockError(f"{self.place(line)}: {message}")

    def text(self, column: str) -> np.ndarray:
        """A column as text; empty everywhere where the file has no such column."""
        return self.columns.get(column, np.full(len(self), "", object))

    def ids(self, column: str) -> np.ndarray:
        """A column of ids, none of them empty."""
        values = self.text(column)
        for line in np.flatnonzero(values == ""):
            raise self.bad(line, f"the {column} is empty; give its id or delete the row")
        return values

    def numbers(self, column: str, *, empty: bool = False) -> np.ndarray:
        """A column of finite numbers; NaN stands for an empty cell or a missing column where `empty` allows it."""
        if column not in self.columns:
            return np.full(len(self), np.nan)
        cells = self.columns[column]
        if cells.dtype == object:
            cells = self._parsed(column, cells)
        else:
            for line in np.flatnonzero(~np.isfinite(cells)):
                raise self.bad(line, f"{column} is {cells[line]}; give a finite number")
        if not empty:
            for line in np.flatnonzero(np.isnan(cells)):
                raise self.bad(line, f"{column} is empty; give a number or delete the row")
        return cells

    def sigmas(self, column: str) -> np.ndarray:
        """A column of standard deviations, positive where given and NaN where not."""
        values = self.numbers(column, empty=True)
        for line in np.flatnonzero(values <= 0):
            raise self.bad(
                line, f"{column} is {values[line]:g}; a standard deviation is positive, so give its true value"
            )
        return values

    def _parsed(self, column: str, cells: np.ndarray) -> np.ndarray:
        filled = cells != ""
        values = np.full(len(cells), np.nan)
        try:
            # Python's own conversion: it rounds correctly, so a number written by repr comes back exactly.
            values[filled] = cells[filled].astype(float)
            # The one thing it reads that is no number in a table is 1_000.
            bad = np.array(["_" in cell for cell in cells], bool)
        except ValueError:
            bad = np.array([cell != "" and not is_number(cell) for cell in cells], bool)
        for line in np.flatnonzero(bad):
            raise self.bad(line, f"{column} is {cells[line]!r}, not a number; write it like 12.34")
        for line in np.flatnonzero(filled & ~np.isfinite(values)):
            raise self.bad(
                line, f"{column} is {cells[line]!r}; give a finite number, or leave the cell empty if it is unknown"
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


def read_csv(path: Path, needed: Sequence[str], optional: Sequence[str] = (), text: Sequence[str] = ()) -> Table:
    """A CSV with a header: separated by commas, or by semicolons (then decimal commas are read too).

    Lines that start with `#` and empty lines are passed over, blanks around a cell are stripped, a byte order mark
    and any line ends are accepted. Columns in neither list are left out, with a UserWarning. A comma in the columns
    `text` is not a decimal comma.

    Raises InputError where the file, a needed column or a cell is missing or too many.
    """
    lines, rows = content_lines(path)
    if not lines:
        raise InputError(f"{path.name}: the file is empty; give it a header with the columns {', '.join(needed)}")
    separator = ";" if ";" in lines[0] else ","
    header, *records = _records(path, lines, rows, separator)
    header = [name.strip() for name in header]
    for name in header:
        if name and header.count(name) > 1:
            raise InputError(f"{path.name}, row {rows[0]}: the column {name} stands there twice; keep one of them")
    for name in needed:
        if name not in header:
            found = ", ".join(filter(None, header))
            raise InputError(f"{path.name}, row {rows[0]}: the column {name} is missing (found {found}); add it")
    unknown = [name for name in header if name and name not in needed and name not in optional]
    if unknown:
        message = f"{path.name}: columns that jaxphoto does not know are not used: {', '.join(unknown)}"
        warnings.warn(message, UserWarning, stacklevel=2)
    columns = {}
    for j, name in enumerate(header):
        if name in needed or name in optional:
            cells = [record[j].strip() for record in records]
            if separator == ";" and name not in _TEXT and name not in text:
                cells = [cell.replace(",", ".") for cell in cells]
            columns[name] = _objects(cells)
    return Table.of(path.name, columns, np.array(rows[1:], int))


def read_columns(path: Path, columns: Sequence[str], separator: str | None = ",") -> Table:
    """A file without a header whose columns are named by the caller; `separator` None means blanks."""
    lines, rows = content_lines(path)
    records = [[cell.strip() for cell in line.split(separator)] for line in lines]
    for record, row in zip(records, rows, strict=True):
        if len(record) != len(columns):
            raise InputError(
                f"{path.name}, row {row}: {len(record)} cells instead of {len(columns)} ({', '.join(columns)}); "
                "complete the row or correct the format"
            )
    cells = {name: _objects([record[j] for record in records]) for j, name in enumerate(columns)}
    return Table.of(path.name, cells, np.array(rows, int))


def content_lines(path: Path) -> tuple[list[str], list[int]]:
    """The lines of a text file that are neither empty nor comments, and their row numbers."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"there is no file {path}; add it, or correct the name") from None
    except OSError as error:
        raise InputError(f"{path.name} cannot be read ({error.strerror}); check that it is a readable file") from None
    except UnicodeDecodeError as error:
        row = error.object[: error.start].count(b"\n") + 1
        raise InputError(f"{path.name}, row {row}: the text is not UTF-8; save the file as UTF-8") from None
    # Not splitlines(): that also ends lines at form feeds and other characters an editor does not count.
    numbered = enumerate(text.split("\n"), start=1)
    kept = [(line, row) for row, line in numbered if line.strip() and not line.lstrip().startswith("#")]
    return [line for line, _ in kept], [row for _, row in kept]


def _records(path: Path, lines: list[str], rows: list[int], separator: str) -> list[list[str]]:
    try:
        records = list(csv.reader(lines, delimiter=separator, skipinitialspace=True, strict=True))
    except csv.Error:
        records = []
    if len(records) != len(lines):
        row = next((row for line, row in zip(lines, rows, strict=True) if line.count('"') % 2), rows[0])
        raise InputError(f"{path.name}, row {row}: the quotation marks do not pair; close or remove them in that row")
    width = len(records[0])
    for record, row in zip(records, rows, strict=True):
        if len(record) > width:
            raise InputError(
                f"{path.name}, row {row}: {len(record)} cells, but the header has {width}; remove the surplus ones"
                + (" (decimal commas need semicolons between the columns)" if separator == "," else "")
            )
        # Some spreadsheets leave out empty cells at the end of a row.
        record.extend([""] * (width - len(record)))
    return records


def _objects(cells: list[str]) -> np.ndarray:
    values = np.empty(len(cells), object)
    values[:] = cells
    return values


def is_number(cell: str) -> bool:
    """Whether a cell reads as a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True
