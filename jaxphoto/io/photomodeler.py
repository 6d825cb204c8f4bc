"""PhotoModeler's text export, with DBAT's control files beside it or alone -> the tables of a block folder.

    title; tolerance, iterations, width, height; standard deviations; c, px, py, width, height (mm), K1 K2 K3 P1 P2
    of every photograph six lines with its number: name; X Y Z kappa phi omega; their sigmas; covariances or nothing;
        its camera; its sigmas
    an empty line, then of each control point, object point and mark in turn, an empty line after each kind:
        id X Y Z and sigmas; the same; photograph id x y and sigmas (pixels, counted as by DBAT,
            see dbat/script_camera.py)

K and P are added to a coordinate that is reduced to the principal point, where our Brown model subtracts: all change
sign. px and py count from pixel (0, 0), as DBAT takes them, half a pixel outside the upper left corner; y down. The
angles are those of docs/conventions.md in degrees. Control is read from `ctrlpts-weighted.txt`, camera stations from
`fake-camera-positions.txt`, in the same folder. The orientations and object points are in a frame of their own, and
read only where there is no such control.
Sources: PhotoModeler's help, "Lens Distortion Formulation" and "Decentering lens distortion"; exports that come with
DBAT.
"""

import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.camera_section import PIXEL_MM
from jaxphoto.io.block_folder.table_layout import ANGLES, SIGMA_XYZ, XYZ
from jaxphoto.io.dbat import CAMERA, control_table
from jaxphoto.io.text_tables import Table, finite, is_number, read_columns
from jaxphoto.io.whole_text import LARGE, read_text

CONTROL, STATIONS = "ctrlpts-weighted.txt", "fake-camera-positions.txt"
# The export's own standard deviations mark the kind of point (1 manual, 0 automatic); DBAT takes 1 pixel for all.
_SIGMA_PX = 1.0
# Numbers in rows 2 to 4 of the header; the second may lack the size of photographs.
_HEADERS = ((4, 9, 10), (2, 9, 10))
# Lines of a photograph, and where its orientation stands among them.
_BLOCK, _OUTER = 6, 1
_POINT, _MARK = ("point", "x", "y", "z", "sx", "sy", "sz"), ("im", "point", "x", "y", "sx", "sy")
_KEPT = {"c_mm": "free", "xp_mm": "free", "yp_mm": "free"}
# Control points that place a block.
_LEAST = 3
# Pixels whose sides differ by no more are square.
_SQUARE = 1e-9
_BEGIN = 2_000

_Lines = list[tuple[int, list[str]]]


class _PhotographRows(NamedTuple):
    names: dict[str, str]
    """By their numbers."""
    exterior: Table


def recognises(source: Path) -> bool:
    """Whether `source` is an export, or a folder that holds exactly one."""
    return len(_exports(source)) == 1


def read_photomodeler(source: Path) -> BlockTables:
    """The block of an export and the files beside it.

    Without these it starts at the orientations and points of the export, with its control where that has three points
    and a free network otherwise, and the camera is free in c_mm, xp_mm, yp_mm and the coefficients that are not zero.
    """
    exports = _exports(source)
    if len(exports) != 1:
        raise InputError(f"{source} holds {len(exports)} text exports of PhotoModeler; name the one to read")
    path = exports[0]
    lines = read_text(path, LARGE).split("\n")
    if len(lines) < 6:
        raise InputError(f"{path.name}: the export ends within its header; export it again")
    title, camera = lines[0].strip(), _camera(path, lines)
    photographs, at = _photographs(path, lines)
    control, points, marks = _sections(path, lines, at)
    for line, number in enumerate(marks.text("im")):
        if number not in photographs.names:
            raise marks.bad(line, f"image {number} is not among the export's images; export it again")
    tables = {
        "images": photographs.exterior,
        "image_points": Table(
            path.name,
            {
                "image": np.array([photographs.names[number] for number in marks.text("im")], object),
                "point": marks.text("point"),
                "column_px": marks.numbers("x") - 0.5,
                "row_px": marks.numbers("y") - 0.5,
                "sigma_px": np.full(len(marks), _SIGMA_PX),
            },
            marks.files,
            marks.rows,
        ),
    }
    settings: dict[str, Any] = {"title": title, "cameras": {CAMERA: camera}}
    if (path.parent / CONTROL).is_file():
        kept = {name: photographs.exterior.columns[name] for name in ("image", "camera")}
        tables["images"] = Table.of(path.name, kept)
        read = read_columns(path.parent / CONTROL, ("id", "label", "x", "y", "z", "sx", "sy", "sz"))
        tables["control_points"] = control_table(read, "", 1.0)
    else:
        names = {name: points.numbers(axis) for name, axis in zip(XYZ, "xyz", strict=True)}
        tables["object_points"] = Table(path.name, {"point": points.ids("point")} | names, points.files, points.rows)
        found = [name for name, value in camera["interior"].items() if value != 0 and name not in _KEPT]
        camera["unknowns"] = _KEPT | dict.fromkeys(found, "free")
        if 0 < len(control) < _LEAST:
            warnings.warn(
                f"{path.name}: {len(control)} control points are too few for a datum, and are not used; the block is a "
                "free network",
                UserWarning,
                stacklevel=2,
            )
        if len(control) < _LEAST:
            settings["datum"] = {"kind": "inner", "over": "points"}
        else:
            # Where it holds a point it writes a negative number, DBAT zero.
            sigmas = {name: np.maximum(control.numbers(name), 0.0) for name in ("sx", "sy", "sz")}
            columns = control.columns | sigmas | {"id": control.columns["point"]}
            tables["control_points"] = control_table(Table(path.name, columns, control.files, control.rows), "", 1.0)
    if (path.parent / STATIONS).is_file():
        tables["stations"] = _stations(path.parent / STATIONS)
    return BlockTables(settings, tables, path.name)


def _exports(source: Path) -> list[Path]:
    paths = sorted(source.glob("*.txt")) if source.is_dir() else [source]
    return [path for path in paths if path.is_file() and _opens_so(path)]


def _opens_so(path: Path) -> bool:
    """Whether the rows of the header have as many numbers as those of an export."""
    with path.open("rb") as file:
        begin = file.read(_BEGIN).decode("utf-8", "replace").splitlines()
    rows = [line.split() for line in begin[1:4]]
    return len(begin) > 5 and tuple(map(len, rows)) in _HEADERS and all(is_number(cell) for row in rows for cell in row)


def _camera(path: Path, lines: list[str]) -> dict[str, Any]:
    """The [cameras.X] table."""
    if len(lines[1].split()) == 2:
        raise InputError(
            f"{path.name}, row 2: it has no size of the photographs; write width and height in pixels at its end"
        )
    _, _, width, height = _numbers(path, 2, lines[1].split(), 4)
    c, px, py, width_mm, height_mm, *coefficients = _numbers(path, 4, lines[3].split(), 10)
    if min(width, height, width_mm, height_mm) <= 0:
        raise InputError(f"{path.name}: the format of the camera is not positive; export it again")
    sides = width_mm / width, height_mm / height
    if not all(PIXEL_MM[0] <= side <= PIXEL_MM[1] for side in sides):
        raise InputError(f"{path.name}: pixels of {sides[0]:g} x {sides[1]:g} mm cannot be; export it again")
    square = abs(sides[0] / sides[1] - 1) < _SQUARE
    # The affinity makes all x as long as if pixels were square before anything else is applied.
    pixel = sides[0] if square else sides[1]
    b1 = 0.0 if square else 1.0 - sides[0] / pixel
    interior = {
        "c_mm": c,
        "xp_mm": px / (1.0 - b1) - pixel * (width / 2 + 0.5),
        "yp_mm": -(py - pixel * (height / 2 + 0.5)),
    }
    interior |= dict(zip(("k1", "k2", "k3", "p1", "p2"), (0.0 - value for value in coefficients), strict=True))
    return {
        "width_px": int(width), "height_px": int(height), "pixel_mm": pixel,
        "distortion": "brown" if square else "affine_brown", "interior": interior | ({} if square else {"b1": b1}),
    }  # fmt: skip


def _photographs(path: Path, lines: list[str]) -> tuple[_PhotographRows, int]:
    """The photographs, and the line after them."""
    at, names = 5, dict[str, str]()
    outer, rows = [], []
    while at < len(lines) and lines[at].strip():
        words = lines[at].split(maxsplit=1)
        if len(words) != 2 or len(lines) < at + _BLOCK:
            raise InputError(f"{path.name}, row {at + 1}: {quoted(lines[at])} begins no photograph; export it again")
        names[words[0]] = _stem(words[1].strip())
        outer.append(_numbers(path, at + _OUTER + 1, lines[at + _OUTER].split(), 7)[1:])
        rows.append(at + _OUTER + 1)
        at += _BLOCK
    if not names:
        raise InputError(f"{path.name}, row 6: there is no photograph; export it again")
    x, y, z, kappa, phi, omega = np.array(outer).T
    columns: dict[str, np.ndarray] = {
        "image": np.array(list(names.values()), object),
        "camera": np.full(len(names), CAMERA, object),
    }
    columns |= dict(zip((*XYZ, *ANGLES), (x, y, z, omega, phi, kappa), strict=True))
    if len(names) < len(outer):
        raise InputError(f"{path.name}: two photographs have one number; export it again")
    return _PhotographRows(names, Table.of(path.name, columns, np.array(rows, int))), at


def _sections(path: Path, lines: list[str], at: int) -> tuple[Table, Table, Table]:
    """Control points, object points and marks: each as far as the next empty line."""
    found: list[_Lines] = []
    for _ in range(3):
        at, own = at + 1, []
        while at < len(lines) and lines[at].strip():
            own.append((at + 1, lines[at].split()))
            at += 1
        found.append(own)
    control, points, marks = found
    return _table(path, control, _POINT), _table(path, points, _POINT), _table(path, marks, _MARK)


def _table(path: Path, lines: _Lines, columns: tuple[str, ...]) -> Table:
    for row, cells in lines:
        if len(cells) != len(columns):
            raise InputError(f"{path.name}, row {row}: {len(columns)} numbers are expected here; export it again")
    values = {name: np.array([cells[j] for _, cells in lines], object) for j, name in enumerate(columns)}
    return Table.of(path.name, values, np.array([row for row, _ in lines], int))


def _stations(path: Path) -> Table:
    table = read_columns(path, ("image", *XYZ, "sigma"))
    columns = {"image": np.array([_stem(name) for name in table.ids("image")], object)}
    columns |= {name: table.numbers(name) for name in XYZ} | {name: table.numbers("sigma") for name in SIGMA_XYZ}
    return Table(table.file, columns, table.files, table.rows)


def _numbers(path: Path, row: int, cells: list[str], n: int) -> list[float]:
    numbers = [number for cell in cells if (number := finite(cell)) is not None]
    if len(cells) != n or len(numbers) != n:
        raise InputError(f"{path.name}, row {row}: {n} numbers are expected here; export it again")
    return numbers


def _stem(name: str) -> str:
    return Path(name.replace("\\", "/")).stem
