"""PLY: the vertices of an ASCII or binary file."""

import csv
import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import CHUNK, CloudSource, StripNumbers, at_once
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem
from jaxphoto.io.text_tables import LONGEST_LINE, is_number, natural

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# Names in lower case without the "scalar_" that some programs put before: no standard settles them.
_NAMES = {
    "classification": ("classification", "class"),
    "return_number": ("return_number", "returnnumber"),
    "number_of_returns": ("number_of_returns", "numberofreturns"),
    "time_s": ("time_s", "gps_time", "gpstime"),
    "strip": ("strip", "point_source_id", "pointsourceid"),
}
_LONGEST_HEADER = 1000
# What a cloud holds as a byte, and as a whole number, which a double holds up to here.
_BYTES = {"classification", "return_number", "number_of_returns"}
_LARGEST_STRIP = 2**53


@dataclasses.dataclass(frozen=True)
class _Vertices:
    """How the vertices lie in the file: from byte `begin` (line `lines` + 1 of a text) on."""

    order: str
    count: int
    fields: tuple[tuple[str, str], ...]
    begin: int
    lines: int

    @property
    def least_bytes(self) -> int:
        """Of a vertex: of its numbers, or in a text of a digit and the end of the line."""
        return sum(np.dtype(code).itemsize for _, code in self.fields) if self.order else 2


def open_ply(path: Path, given: CoordinateSystem | None) -> CloudSource:
    """A PLY file as a source, in the system `given`; elements other than vertices are left out.

    Raises InputError for a damaged header, vertices without x, y, z or with lists, and a file that is cut off.
    """
    vertices = _header(path)
    if vertices.count == 0:
        raise InputError(f"{path.name} holds no points; name another cloud")
    # Of a text it is known only that there cannot be more. Its last line may have no end.
    there = (path.stat().st_size - vertices.begin + (vertices.order == "")) // vertices.least_bytes
    if there < vertices.count:
        raise _cut_off(path, vertices, there)
    return CloudSource(path.name, given or CoordinateSystem(), vertices.count, None, lambda: _chunks(path, vertices))


def _chunks(path: Path, vertices: _Vertices) -> Iterator[Cloud]:
    places = {name.lower().removeprefix("scalar_"): name for name, _ in vertices.fields}
    known = {own: places[n] for own, names in _NAMES.items() for n in names if n in places}
    strips, read = StripNumbers(), 0
    for table in (_lines if vertices.order == "" else _records)(path, vertices):
        xyz = np.stack([np.asarray(table[places[axis]], float) for axis in "xyz"], axis=1)
        values = {own: np.asarray(table[name]) for own, name in known.items()}
        for wrong, what in _wrong(xyz, values):
            if wrong.any():
                raise _fault(path, vertices, read + int(np.flatnonzero(wrong)[0]), what)
        yield Cloud(
            xyz,
            classification=values["classification"].astype(np.uint8) if "classification" in values else None,
            returns=np.stack([values["return_number"], values["number_of_returns"]], axis=1).astype(np.uint8)
            if {"return_number", "number_of_returns"} <= set(values)
            else None,
            time=values["time_s"].astype(float) if "time_s" in values else None,
            strip=strips.of(values["strip"].astype(int)) if "strip" in values else None,
            strips=strips.names,
        )
        read += len(xyz)
    if read < vertices.count:
        raise _cut_off(path, vertices, read)


def _wrong(xyz: np.ndarray, values: dict[str, np.ndarray]) -> Iterator[tuple[np.ndarray, str]]:
    """Which vertices have something that is no value for a cloud, and what is wrong with it."""
    yield ~np.isfinite(xyz).all(axis=1), "x, y, z are not three finite numbers"
    for name in sorted(_BYTES & set(values)):
        yield ~_whole(values[name], 0, 255), f"{name} is not a whole number from 0 to 255"
    if "time_s" in values:
        yield ~np.isfinite(values["time_s"]), "the time is not a finite number"
    if "strip" in values:
        yield ~_whole(values["strip"], -_LARGEST_STRIP, _LARGEST_STRIP), "the strip is not a whole number"


def _whole(values: np.ndarray, least: int, most: int) -> np.ndarray:
    return (values >= least) & (values <= most) & (np.floor(values) == values)


def _fault(path: Path, vertices: _Vertices, vertex: int, what: str) -> InputError:
    where = f"row {vertices.lines + vertex + 1}" if vertices.order == "" else f"vertex {vertex + 1}"
    return InputError(f"{path.name}, {where}: {what}; mend or delete it")


def _cut_off(path: Path, vertices: _Vertices, there: int) -> InputError:
    return InputError(
        f"{path.name} is cut off: its header promises {vertices.count} points, but there are {there}"
        f"{' at most' if vertices.order == '' else ''}; copy it anew from its source"
    )


def _records(path: Path, vertices: _Vertices) -> Iterator[np.ndarray]:
    kind = np.dtype([(name, vertices.order + code) for name, code in vertices.fields])
    with path.open("rb") as file:
        file.seek(vertices.begin)
        left = vertices.count
        while left and len(records := np.fromfile(file, kind, min(at_once(kind.itemsize, CHUNK), left))):
            left -= len(records)
            yield records


def _lines(path: Path, vertices: _Vertices) -> Iterator[pd.DataFrame]:
    names = [name for name, _ in vertices.fields]
    try:
        with path.open("rb") as file:
            file.seek(vertices.begin)
            # No more rows than vertices: lines of other elements have other lengths.
            with pd.read_csv(
                file,
                sep=r"\s+",
                header=None,
                names=names,
                usecols=range(len(names)),
                nrows=vertices.count,
                dtype=float,
                quoting=csv.QUOTE_NONE,
                skip_blank_lines=False,
                chunksize=at_once(8 * len(names), CHUNK),
                encoding_errors="replace",
            ) as tables:
                yield from tables
    # What pandas finds wrong with a line is a ValueError too.
    except ValueError:
        raise _faulty_row(path, vertices) from None


def _faulty_row(path: Path, vertices: _Vertices) -> InputError:
    """The error about the first row that is not as many numbers as there are properties."""
    with path.open("rb") as file:
        file.seek(vertices.begin)
        rows = iter(lambda: file.readline(LONGEST_LINE), b"")
        for vertex, line in enumerate(itertools.islice(rows, vertices.count)):
            cells = line.decode("ascii", "replace").split()
            if len(cells) < len(vertices.fields) or not all(map(is_number, cells[: len(vertices.fields)])):
                return _fault(path, vertices, vertex, f"there are not {len(vertices.fields)} numbers")
    return InputError(f"{path.name} cannot be read as a table of numbers; write the cloud anew")


def _header(path: Path) -> _Vertices:
    order, count, fields, element, before = "", -1, [], "", False
    with path.open("rb") as file:
        if file.readline(8).strip() != b"ply":
            raise InputError(f"{path.name} does not begin as a PLY file does; name a PLY file")
        for line in range(2, _LONGEST_HEADER):
            words = file.readline(1000).decode("ascii", "replace").split()
            match words:
                case ["format", name, _] if name in _ORDERS:
                    order = name
                case ["element", "vertex", n] if (number := natural(n)) is not None:
                    count, element = number, "vertex"
                case ["element", name, n]:
                    before |= count < 0 and n != "0"
                    element = name
                case ["property", kind, name] if element != "vertex" or kind in _TYPES:
                    if element == "vertex":
                        fields.append((name, _TYPES[kind]))
                case ["property", "list", *_] if element != "vertex":
                    pass
                case ["end_header"]:
                    break
                case ["comment" | "obj_info", *_] | []:
                    pass
                case _:
                    raise InputError(
                        f"{path.name}, row {line}: {' '.join(words)!r} is no line of the header of a cloud"
                    )
        else:
            raise InputError(f"{path.name}: the header does not end; write the cloud anew")
        begin = file.tell()
    if order not in _ORDERS or count < 0 or not {"x", "y", "z"} <= {name.lower() for name, _ in fields}:
        raise InputError(f"{path.name}: the header has no format, or no vertices with x, y and z; write it anew")
    if len({name for name, _ in fields}) < len(fields):
        raise InputError(f"{path.name}: a property of the vertices is named twice; write the cloud anew")
    if before:
        raise InputError(f"{path.name}: other elements stand before the vertices; write the cloud with vertices first")
    return _Vertices(_ORDERS[order], count, tuple(fields), begin, line)
