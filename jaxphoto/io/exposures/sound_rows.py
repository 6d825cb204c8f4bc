"""Files of exposures some of whose rows are wrong: these are left out and named, unless they are half of all."""

from collections.abc import Callable
from pathlib import Path

from jaxphoto.errors import InputError, RowError, few
from jaxphoto.io.control_table import separator_of
from jaxphoto.io.exposures.records import Exposures
from jaxphoto.io.whole_text import LARGE, read_text


def of_sound_rows(path: Path, read: Callable[[frozenset[int]], Exposures]) -> Exposures:
    """What `read` makes of the file without the rows that it is given, these being all for which it raises RowError.

    A last row that is cut off is one of them: half a number reads as well as a whole one. Raises InputError where the
    file as a whole is at fault, and the first of the rows' where half of them are wrong.
    """
    text = read_text(path, LARGE)
    rows = [(k, line) for k, line in enumerate(text.split("\n"), 1) if line.strip() and line.lstrip()[0] not in "#%"]
    first = None if text.endswith("\n") else _cut_off(path.name, rows)
    without = first.rows if first else frozenset[int]()
    while True:
        try:
            found = read(without)
            break
        except RowError as error:
            first, without = first or error, without | error.rows
        except InputError as error:
            # Where the header or all rows are left out, what comes of that tells nothing.
            if first and (rows[0][0] in without or 2 * len(without) >= len(rows)):
                raise first from None
            raise error from None
    if first is None:
        return found
    if len(without) >= len(found.rows):
        raise first
    are = "is" if len(without) == 1 else "are"
    total, numbers = len(found.rows) + len(without), few(list(map(str, sorted(without))))
    why = str(first).removeprefix(f"{path.name}, ")
    return found._replace(
        without=tuple(sorted(without)), why=f"{len(without)} of {total} rows {are} left out ({numbers}); {why}"
    )


def _cut_off(file: str, rows: list[tuple[int, str]]) -> RowError | None:
    """The error of a last row that has fewer cells than the one before, in a file without an end of the line."""
    if len(rows) < 3:
        return None
    (_, before), (row, last) = rows[-2:]
    separator = separator_of(before)
    cells = [len(line.split(None if separator == " " else separator)) for line in (before, last)]
    if cells[1] >= cells[0]:
        return None
    return RowError(f"{file}, row {row}: the file ends within the row; copy it anew, or complete it", [row])
