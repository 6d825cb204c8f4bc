"""CSV: X_m, Y_m, Z_m and, where they are known, classification, returns, time and strip."""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError, quoted
from jaxphoto.io.clouds.cloud_source import CHUNK, CloudSource, StripNumbers
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem
from jaxphoto.io.names import harm_in
from jaxphoto.io.text_tables import LONGEST_LINE, MOST_COLUMNS, is_number

XYZ = ("X_m", "Y_m", "Z_m")
RETURNS = ("return_number", "number_of_returns")
_BYTES = ("classification", *RETURNS)
COLUMNS = (*XYZ, *_BYTES, "time_s", "strip")


def open_csv(path: Path, given: CoordinateSystem | None) -> CloudSource:
    """A CSV as a source, in the system `given`; columns that are not in `COLUMNS` are left out.

    Separators are commas, or semicolons, then with decimal commas or points; lines that start with # are comments.
    Raises InputError, with the row, where a column is missing or a cell is no finite number.
    """
    layout = _layout(path)
    for name in XYZ:
        if name not in layout.header:
            found = ", ".join(layout.header)
            raise InputError(f"{path.name}: the column {name} is missing (found {found}); add it, in metres")
    return CloudSource(path.name, given or CoordinateSystem(), None, None, lambda: _chunks(path, layout))


@dataclasses.dataclass(frozen=True)
class _Dialect:
    """How a table is written: its columns, and what separates cells and begins decimals."""

    header: list[str]
    separator: str
    decimal: str


def _chunks(path: Path, layout: _Dialect) -> Iterator[Cloud]:
    numbers = [name for name in layout.header if name in COLUMNS and name != "strip"]
    # Names of ours, since pandas strips none and takes none twice.
    names = [name if name in COLUMNS else f"#{j}" for j, name in enumerate(layout.header)]
    kinds: dict[str, type] = {name: float if name in numbers else str for name in names}
    strips = StripNumbers()
    try:
        # Without an index and with all columns: else surplus cells would shift the others unnoticed.
        with pd.read_csv(
            path,
            sep=layout.separator,
            decimal=layout.decimal,
            comment="#",
            skipinitialspace=True,
            index_col=False,
            header=0,
            names=names,
            dtype=kinds,  # type: ignore[arg-type]
            keep_default_na=False,
            na_values=[""],
            chunksize=CHUNK,
            encoding="utf-8-sig",
        ) as tables:
            for table in tables:
                values = {name: table[name].to_numpy() for name in numbers}
                strip = table["strip"].fillna("").to_numpy(object) if "strip" in table else None
                if (
                    not all(np.isfinite(v).all() for v in values.values())
                    or not all(np.isin(values[name], np.arange(256)).all() for name in _BYTES if name in values)
                    or (strip is not None and any(map(harm_in, pd.unique(strip))))
                ):
                    raise _fault(path, layout, numbers)
                small = {name: values[name].astype(np.uint8) for name in _BYTES if name in values}
                has_returns = all(name in values for name in RETURNS)
                yield Cloud(
                    np.stack([values[name] for name in XYZ], axis=1),
                    classification=small.get("classification"),
                    returns=np.stack([small[name] for name in RETURNS], axis=1) if has_returns else None,
                    time=values.get("time_s"),
                    strip=None if strip is None else strips.of(strip),
                    strips=strips.names,
                )
    except InputError:
        raise
    # What pandas finds wrong with a line is a ValueError too.
    except ValueError:
        raise _fault(path, layout, numbers) from None


def _fault(path: Path, layout: _Dialect, numbers: list[str]) -> InputError:
    """The error about the first row in which something is wrong."""
    rows = _rows(path, layout.separator)
    next(rows)
    for row, cells in rows:
        if len(cells) > len(layout.header):
            return _surplus(path, row, cells, layout.header)
        found = dict(zip(layout.header, [*cells, *[""] * (len(layout.header) - len(cells))], strict=True))
        for name in numbers:
            cell = found[name].replace(layout.decimal, ".")
            if not is_number(cell) or not math.isfinite(float(cell)):
                what = quoted(found[name]) if found[name] else "empty"
                return InputError(f"{path.name}, row {row}: {name} is {what}; give a finite number or delete the row")
            if name in _BYTES and not (float(cell).is_integer() and 0 <= float(cell) <= 255):
                return InputError(f"{path.name}, row {row}: {name} is {found[name]}; give a whole number from 0 to 255")
        if harm := harm_in(found.get("strip", "")):
            return InputError(f"{path.name}, row {row}: the strip {quoted(found['strip'])} {harm}")
    return InputError(f"{path.name} cannot be read as a table; see that its cells are numbers without quotation marks")


def _surplus(path: Path, row: int, cells: list[str], header: list[str]) -> InputError:
    return InputError(
        f"{path.name}, row {row}: {len(cells)} cells, but the header has {len(header)}; remove the surplus ones "
        "(decimal commas need semicolons between the columns)"
    )


def _layout(path: Path) -> _Dialect:
    """What the header and the first line of numbers tell."""
    lines = [(row, cells[0]) for row, cells in itertools.islice(_rows(path, "\n"), 2)]
    if not lines:
        raise InputError(f"{path.name} is empty; give it a header with the columns {', '.join(XYZ)}")
    separator = ";" if ";" in lines[0][1] else ","
    header, *first = [[cell.strip() for cell in text.split(separator)] for _, text in lines]
    if len(header) > MOST_COLUMNS:
        raise InputError(
            f"{path.name}, row {lines[0][0]}: the header has {len(header)} columns, and a table has at most "
            f"{MOST_COLUMNS}; correct it"
        )
    for name in COLUMNS:
        if header.count(name) > 1:
            raise InputError(f"{path.name}, row {lines[0][0]}: the column {name} stands there twice; keep one of them")
    for cells in first:
        if len(cells) > len(header):
            raise _surplus(path, lines[1][0], cells, header)
    return _Dialect(
        header, separator, "," if separator == ";" and any("," in cell for cells in first for cell in cells) else "."
    )


def _rows(path: Path, separator: str) -> Iterator[tuple[int, list[str]]]:
    """The lines that are neither empty nor comments as cells, with their row from 1."""
    row = 0
    try:
        with path.open(encoding="utf-8-sig") as lines:
            for row, line in enumerate(iter(lambda: lines.readline(LONGEST_LINE + 1), ""), start=1):
                text = line.strip()
                if len(line) > LONGEST_LINE:
                    raise InputError(
                        f"{path.name}, row {row}: the row has more than {LONGEST_LINE} characters; correct it"
                    )
                if text and not text.startswith("#"):
                    yield row, [cell.strip() for cell in text.split(separator)]
    except UnicodeDecodeError:
        raise InputError(f"{path.name}, after row {row}: the text is not UTF-8; save the file as UTF-8") from None
