"""PLY: the vertices of an ASCII or binary file."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_source import CHUNK, CloudSource, StripNumbers
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem

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
# What a cloud holds as a byte.
_BYTES = {"classification", "return_number", "number_of_returns"}


@dataclasses.dataclass(frozen=True)
class _Vertices:
    """How the vertices lie in the file: from byte `begin` (line `lines` + 1 of a text) on."""

    order: str
    count: int
    fields: tuple[tuple[str, str], ...]
    begin: int
    lines: int


def open_ply(path: Path, given: CoordinateSystem | None) -> CloudSource:
    """A PLY file as a source, in the system `given`; elements other than vertices are left out.

    Raises InputError for a damaged header, vertices without x, y, z or with lists, and a file that is cut off.
    """
    vertices = _header(path)
    if vertices.count == 0:
        raise InputError(f"{path.name} holds no points; name another cloud")
    return CloudSource(path.name, given or CoordinateSystem(), vertices.count, None, lambda: _chunks(path, vertices))


def _chunks(path: Path, vertices: _Vertices) -> Iterator[Cloud]:
    places = {name.lower().removeprefix("scalar_"): name for name, _ in vertices.fields}
    known = {own: places[n] for own, names in _NAMES.items() for n in names if n in places}
    strips, read = StripNumbers(), 0
    for table in (_lines if vertices.order == "" else _records)(path, vertices):
        xyz = np.stack([np.asarray(table[places[axis]], float) for axis in "xyz"], axis=1)
        lost = ~np.isfinite(xyz).all(axis=1)
        if lost.any():
            at = read + int(np.flatnonzero(lost)[0])
            where = f"row {vertices.lines + at + 1}" if vertices.order == "" else f"vertex {at + 1}"
            raise InputError(f"{path.name}, {where}: x, y, z are not three finite numbers; mend or delete it")
        values = {own: np.asarray(table[name]) for own, name in known.items()}
        for name in _BYTES & set(values):
            wrong = ~((values[name] >= 0) & (values[name] <= 255))
            if wrong.any():
                at = read + int(np.flatnonzero(wrong)[0])
                raise InputError(
                    f"{path.name}, vertex {at + 1}: {name} is not a number from 0 to 255; mend or delete it"
                )
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
        raise InputError(
            f"{path.name} is cut off: its header promises {vertices.count} points, but there are {read}; copy it anew "
            "from its source"
        )


def _records(path: Path, vertices: _Vertices) -> Iterator[np.ndarray]:
    kind = np.dtype([(name, vertices.order + code) for name, code in vertices.fields])
    with path.open("rb") as file:
        file.seek(vertices.begin)
        left = vertices.count
        while left and len(records := np.fromfile(file, kind, min(CHUNK, left))):
            left -= len(records)
            yield records


def _lines(path: Path, vertices: _Vertices) -> Iterator[pd.DataFrame]:
    names = [name for name, _ in vertices.fields]
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
            skip_blank_lines=False,
            chunksize=CHUNK,
            encoding_errors="replace",
        ) as tables:
            for table in tables:
                yield table.apply(pd.to_numeric, errors="coerce")


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
                case ["element", "vertex", n] if n.isdigit():
                    count, element = int(n), "vertex"
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
