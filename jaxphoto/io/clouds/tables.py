"""Read and write clouds as tables with one row per point: CSV and PLY."""

import csv
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import CHUNK, CloudSource, StripNumbers, no_points, source_ids
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem

XYZ = ("X_m", "Y_m", "Z_m")
_RETURNS = ("return_number", "number_of_returns")
_BYTES = ("classification", *_RETURNS)
COLUMNS = (*XYZ, *_BYTES, "time_s", "strip")
"""Columns of a CSV; the first three are required."""
# PLY properties, in lower case and without CloudCompare's prefix "scalar_", and their CSV columns.
_PROPERTIES = {
    "x": "X_m", "y": "Y_m", "z": "Z_m", "classification": "classification", "class": "classification",
    "return_number": "return_number", "returnnumber": "return_number", "number_of_returns": "number_of_returns",
    "numberofreturns": "number_of_returns", "time_s": "time_s", "gps_time": "time_s", "gpstime": "time_s",
    "strip": "strip", "point_source_id": "strip", "pointsourceid": "strip",
}  # fmt: skip
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_LARGEST_INTEGER = 2**53


def _cloud(values: Mapping[str, np.ndarray], strips: StripNumbers) -> Cloud:
    small = {name: values[name].astype(np.uint8) for name in _BYTES if name in values}
    return Cloud(
        np.stack([np.asarray(values[name], float) for name in XYZ], axis=1),
        classification=small.get("classification"),
        returns=np.stack([small[name] for name in _RETURNS], axis=1) if set(_RETURNS) <= set(small) else None,
        time=np.asarray(values["time_s"], float) if "time_s" in values else None,
        strip=strips.of(values["strip"]) if "strip" in values else None,
        strips=strips.names,
    )


def _columns(cloud: Cloud, xyz: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of a CSV, except strip."""
    columns = dict(zip(XYZ, xyz.T, strict=True))
    if cloud.classification is not None:
        columns["classification"] = cloud.classification
    if cloud.returns is not None:
        columns |= dict(zip(_RETURNS, cloud.returns.T, strict=True))
    if cloud.time is not None:
        columns["time_s"] = cloud.time
    return columns


def _valid(name: str, values: np.ndarray) -> np.ndarray:
    """Return the mask of valid values of a column."""
    limits = (0, 255) if name in _BYTES else (-_LARGEST_INTEGER, _LARGEST_INTEGER) if name == "strip" else None
    if limits is None:
        return np.isfinite(values)
    return (values >= limits[0]) & (values <= limits[1]) & (np.floor(values) == values)


def _first_error(
    file: str, rows: Iterable[tuple[int, list[str]]], names: Sequence[str], numbers: set[str]
) -> InputError:
    """Return the error about the first invalid row."""
    for row, cells in rows:
        if len(cells) > len(names):
            return InputError(
                f"{file}, row {row}: {len(cells)} cells for {len(names)} columns; delete the extra cells "
                "(with decimal commas, separate columns by semicolons)"
            )
        for name, cell in itertools.zip_longest(names, cells, fillvalue=""):
            try:
                value = float(cell) if name in numbers else 0.0
            except ValueError:
                value = math.nan
            if not _valid(name, np.array([value]))[0]:
                kind = "whole number from 0 to 255" if name in _BYTES else "finite number"
                return InputError(f"{file}, row {row}: {name} is {cell[:50]!r}; give a {kind}, or delete the row")
    return InputError(f"{file} cannot be read as a table of numbers; re-export the cloud")


class _Layout(NamedTuple):
    header: list[str]
    separator: str
    decimal: str


def open_csv(path: Path, system: CoordinateSystem | None) -> CloudSource:
    """Open a CSV separated by commas, or by semicolons with decimal points or commas; # starts a comment.

    Columns not in `COLUMNS` are ignored. Raises InputError for a missing column and, with its row, for an invalid cell.
    """
    lines = [cells[0] for _, cells in itertools.islice(_csv_rows(path, "\n", "."), 2)]
    if not lines:
        raise InputError(f"{path.name} is empty; give it a header with the columns {', '.join(XYZ)}")
    separator = ";" if ";" in lines[0] else ","
    header = [cell.strip() for cell in lines[0].split(separator)]
    for name in COLUMNS:
        if header.count(name) > 1 or (name in XYZ and name not in header):
            fault = "is given twice" if name in header else f"is missing (found {', '.join(header)})"
            raise InputError(f"{path.name}: the column {name} {fault}; correct the header")
    decimal = "," if separator == ";" and "," in "".join(lines[1:]) else "."
    layout = _Layout(header, separator, decimal)
    return CloudSource(path.name, system or CoordinateSystem(), None, None, lambda: _csv_chunks(path, layout))


def _csv_chunks(path: Path, layout: _Layout) -> Iterator[Cloud]:
    numbers = [name for name in layout.header if name in COLUMNS and name != "strip"]
    # Make names unique: pandas does not strip names, and rejects duplicates.
    names = [name if name in COLUMNS else f"#{j}" for j, name in enumerate(layout.header)]
    strips = StripNumbers()
    try:
        # Read all columns without an index: otherwise pandas shifts the cells of rows that are too long.
        with pd.read_csv(
            path,
            sep=layout.separator,
            decimal=layout.decimal,
            comment="#",
            skipinitialspace=True,
            index_col=False,
            header=0,
            names=names,
            dtype={name: float if name in numbers else str for name in names},  # type: ignore[arg-type]
            keep_default_na=False,
            na_values=[""],
            chunksize=CHUNK,
            encoding="utf-8-sig",
        ) as tables:
            for table in tables:
                values = {name: table[name].to_numpy() for name in numbers}
                if not all(_valid(name, column).all() for name, column in values.items()):
                    raise ValueError
                if "strip" in table:
                    values["strip"] = table["strip"].fillna("").to_numpy(object)
                yield _cloud(values, strips)
    # pandas raises ValueError for every invalid line.
    except ValueError:
        rows = itertools.islice(_csv_rows(path, layout.separator, layout.decimal), 1, None)
        raise _first_error(path.name, rows, layout.header, set(numbers)) from None


def _csv_rows(path: Path, separator: str, decimal: str) -> Iterator[tuple[int, list[str]]]:
    """Yield row number and cells of each line, skipping empty lines and comments."""
    try:
        with path.open(encoding="utf-8-sig") as lines:
            for row, line in enumerate(lines, start=1):
                if (text := line.strip()) and not text.startswith("#"):
                    yield row, [cell.strip().replace(decimal, ".") for cell in text.split(separator)]
    except UnicodeDecodeError:
        raise InputError(f"{path.name} is not UTF-8; save it as UTF-8") from None


def write_csv(parts: Iterable[tuple[Cloud, np.ndarray]], count: int | None, path: Path) -> None:
    """Write pairs (cloud, coordinates) as one CSV file with the columns `COLUMNS`."""
    with path.open("w", encoding="utf-8", newline="") as file:
        for k, (part, xyz) in enumerate(parts):
            table = pd.DataFrame(_columns(part, xyz))
            if part.strip is not None:
                table["strip"] = np.array(part.strips, object)[part.strip]
            table.to_csv(file, index=False, header=k == 0)


class _Vertices(NamedTuple):
    """Vertex layout of a PLY file; vertices start at byte `begin`, after `lines` header lines."""

    order: str
    n: int
    fields: list[tuple[str, str]]
    begin: int
    lines: int


def open_ply(path: Path, system: CoordinateSystem | None) -> CloudSource:
    """Open a PLY file, ASCII or binary, whose vertices precede all other elements.

    Raises InputError for an invalid header, invalid values and a truncated file.
    """
    vertices = _ply_header(path)
    if vertices.n == 0:
        raise no_points(path.name)
    if path.stat().st_size - vertices.begin < vertices.n:
        raise InputError(f"{path.name} is cut off: its header promises {vertices.n} points; copy it again")
    chunks = partial(_ply_chunks, path, vertices)
    return CloudSource(path.name, system or CoordinateSystem(), vertices.n, None, chunks)


def _ply_header(path: Path) -> _Vertices:
    order, count, fields, element, before, row = "", -1, list[tuple[str, str]](), "", False, 1
    with path.open("rb") as file:
        if file.readline(8).strip() != b"ply":
            raise InputError(f"{path.name} does not begin with the PLY signature; give a PLY file")
        for row, line in enumerate(iter(lambda: file.readline(1000), b""), 2):
            match words := line.decode("ascii", "replace").split():
                case ["format", name, _] if name in _ORDERS:
                    order = name
                case ["element", "vertex", n] if n.isdecimal():
                    count, element = int(n), "vertex"
                case ["element", name, n]:
                    before |= count < 0 and n != "0"
                    element = name
                case ["property", kind, name] if element == "vertex" and kind in _TYPES:
                    fields.append((name, _TYPES[kind]))
                case ["property", *_] if element != "vertex":
                    pass
                case ["end_header"]:
                    break
                case ["comment" | "obj_info", *_] | []:
                    pass
                case _:
                    raise InputError(
                        f"{path.name}, row {row}: {' '.join(words)!r} is not a valid PLY header entry; re-export it"
                    )
        else:
            raise InputError(f"{path.name}: the header has no end; re-export the cloud")
        begin = file.tell()
    if order not in _ORDERS or count < 0 or not {"x", "y", "z"} <= {name.lower() for name, _ in fields}:
        raise InputError(f"{path.name}: the header has no format, or no vertices with x, y and z; re-export it")
    if before:
        raise InputError(f"{path.name}: other elements precede the vertices; write the cloud with vertices first")
    return _Vertices(_ORDERS[order], count, fields, begin, row)


def _ply_chunks(path: Path, vertices: _Vertices) -> Iterator[Cloud]:
    keys = [_PROPERTIES.get(name.lower().removeprefix("scalar_"), f"#{name}") for name, _ in vertices.fields]
    strips, read = StripNumbers(), 0
    with path.open("rb") as file:
        file.seek(vertices.begin)
        try:
            for table in _ply_tables(file, vertices, keys):
                values = {key: np.asarray(table[key]) for key in keys if not key.startswith("#")}
                for key, column in values.items():
                    valid = _valid(key, column)
                    if vertices.order and not valid.all():
                        vertex = read + int(np.argmin(valid)) + 1
                        raise InputError(
                            f"{path.name}, vertex {vertex}: {key} is not a valid number; delete the vertex"
                        )
                    if not valid.all():
                        raise ValueError
                if "strip" in values:
                    values["strip"] = values["strip"].astype(int)
                yield _cloud(values, strips)
                read += len(table)
        except InputError:
            raise
        except ValueError:
            file.seek(vertices.begin)
            lines = (line.decode("ascii", "replace").split()[: len(keys)] for line in file)
            rows = itertools.islice(enumerate(lines, vertices.lines + 1), vertices.n)
            raise _first_error(path.name, rows, keys, set(keys)) from None
    if read < vertices.n:
        raise InputError(
            f"{path.name} is cut off: its header promises {vertices.n} points, but there are {read}; copy it again "
            "from its source"
        )


def _ply_tables(file: IO[bytes], vertices: _Vertices, keys: list[str]) -> Iterator[pd.DataFrame | np.ndarray]:
    """Yield the vertices, at most `CHUNK` at a time."""
    if vertices.order:
        record = np.dtype([(key, vertices.order + kind) for key, (_, kind) in zip(keys, vertices.fields, strict=True)])
        left = vertices.n
        while left and len(records := np.fromfile(file, record, min(CHUNK, left))):
            left -= len(records)
            yield records
        return
    # Read vertex lines only: lines of other elements differ in length.
    with pd.read_csv(
        file,
        sep=r"\s+",
        header=None,
        names=keys,
        usecols=range(len(keys)),
        nrows=vertices.n,
        dtype=float,
        quoting=csv.QUOTE_NONE,
        skip_blank_lines=False,
        chunksize=CHUNK,
        encoding_errors="replace",
    ) as tables:
        yield from tables


def write_ply(parts: Iterable[tuple[Cloud, np.ndarray]], count: int | None, path: Path) -> None:
    """Write pairs (cloud, coordinates), `count` points in total, as one binary PLY file."""
    types = {"<f8": "double", "|u1": "uchar", "<u2": "ushort"}
    with path.open("wb") as file:
        for k, (part, xyz) in enumerate(parts):
            columns = {name.removesuffix("_m").lower() if name in XYZ else name: values
                       for name, values in _columns(part, xyz).items()}  # fmt: skip
            if part.strip is not None:
                columns["point_source_id"] = source_ids(part)
            records = np.empty(len(part), [(name, values.dtype.str) for name, values in columns.items()])
            for name, values in columns.items():
                records[name] = values
            if k == 0:
                header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
                header += [f"property {types[values.dtype.str]} {name}" for name, values in columns.items()]
                file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
            # Use `file.write`, which raises OSError on a full disk; `ndarray.tofile` does not report the cause.
            file.write(records.tobytes())
