"""PhotoModeler's text export, optionally with DBAT's control files in the same folder.

    title; tolerance, iterations, width, height; standard deviations; c, px, py, width, height (mm), K1 K2 K3 P1 P2
    for each photograph six lines: number name; X Y Z kappa phi omega; standard deviations; covariances or nothing;
        camera; standard deviations of the camera
    an empty line, then three tables, each ended by an empty line:
        control points (id X Y Z and sigmas); object points (the same);
        marks (photograph id x y and sigmas; pixels counted as in DBAT, see dbat.py)

K and P are added to coordinates reduced to the principal point; our Brown model subtracts them, so all change sign. px
and py are relative to DBAT's pixel (0, 0), half a pixel outside the upper left corner; y points down. Angles are
defined in docs/conventions.md, in degrees. Control points are read from `ctrlpts-weighted.txt`, camera stations from
`fake-camera-positions.txt`, in the same folder. The orientations and object points of the export are in an arbitrary
frame; they are read only if these control files do not exist.

Sources: PhotoModeler's help, "Lens Distortion Formulation" and "Decentering lens distortion"; exports distributed with
DBAT.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.dbat import CAMERA, control_table
from jaxphoto.extras.formats.files import Format, beginning, by_content, read_columns, row_numbers, warn
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import ANGLES, SIGMA_XYZ, XYZ
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.io.text_tables import Table, is_number

CONTROL_FILE, STATIONS = "ctrlpts-weighted.txt", "fake-camera-positions.txt"
# Assumed standard deviation of image points (px), as in DBAT: the sigmas of the export are flags (1 manual, 0
# automatic).
_SIGMA_PX = 1.0
# Number of values in rows 2 to 4 of the header; row 2 may lack the size of the photographs.
_HEADERS = ((4, 9, 10), (2, 9, 10))
_LINES_PER_PHOTOGRAPH = 6
_POINT, _MARK = ("id", "x", "y", "z", "sx", "sy", "sz"), ("im", "id", "x", "y", "sx", "sy")
_FREE = ("c_mm", "xp_mm", "yp_mm")
_LEAST_CONTROL = 3
# Maximum relative difference of the sides of a pixel treated as square.
_SQUARE = 1e-9


def _is_export(path: Path) -> bool:
    begin = [line.split() for line in beginning(path, 2_000)]
    numeric = all(is_number(cell) for row in begin[1:4] for cell in row)
    return len(begin) > 5 and tuple(map(len, begin[1:4])) in _HEADERS and numeric


def read(path: Path) -> BlockTables:
    """Read the block of an export and of DBAT's control files in the same folder.

    Without control files the initial values are the orientations and points of the export. Its control points define
    the datum if there are at least three, otherwise the network is free. The camera has free c, xp, yp and nonzero
    coefficients.
    """
    lines = read_legacy_text(path).split("\n")
    if len(lines) < 6:
        raise InputError(f"{path.name}: the file ends within its header. Export it again")
    camera, at, names = _camera(path, lines), 5, dict[str, str]()
    poses, rows = [], []
    while at < len(lines) and lines[at].strip():
        words = lines[at].split(maxsplit=1)
        if len(words) != 2 or len(lines) < at + _LINES_PER_PHOTOGRAPH:
            raise InputError(
                f"{path.name}, row {at + 1}: {quoted(lines[at])} does not start a photograph. Export it again"
            )
        names[words[0]] = _stem(words[1].strip())
        poses.append(row_numbers(path, at + 2, lines[at + 1].split(), 7)[1:])
        rows.append(at + 2)
        at += _LINES_PER_PHOTOGRAPH
    images = {"image": np.array(list(names.values()), object), "camera": np.full(len(names), CAMERA, object)}
    x, y, z, kappa, phi, omega = np.array(poses).T
    outer = dict(zip((*XYZ, *ANGLES), (x, y, z, omega, phi, kappa), strict=True))
    control, points, marks = _sections(path, lines, at)
    numbers, stems = list(names), np.array(list(names.values()), object)
    shown = stems[marks.find("im", numbers, lambda number: f"image {number} is not among the export's images")]
    columns = {"image": shown, "point": marks.text("id"), "sigma_px": np.full(len(marks), _SIGMA_PX)}
    columns |= {"column_px": marks.numbers("x") - 0.5, "row_px": marks.numbers("y") - 0.5}
    tables = {"image_points": Table(path.name, columns, marks.files, marks.rows)}
    settings: dict[str, Any] = {"title": lines[0].strip(), "cameras": {CAMERA: camera}}
    if (path.parent / CONTROL_FILE).is_file():
        tables["images"] = Table.of(path.name, images)
        control = read_columns(path.parent / CONTROL_FILE, ("id", "label", "x", "y", "z", "sx", "sy", "sz"))
        tables["control_points"] = control_table(control, "", 1.0)
    else:
        tables["images"] = Table.of(path.name, images | outer, np.array(rows, int))
        xyz = {name: points.numbers(axis) for name, axis in zip(XYZ, "xyz", strict=True)}
        tables["object_points"] = Table(path.name, {"point": points.ids("id")} | xyz, points.files, points.rows)
        estimated = [name for name, value in camera["interior"].items() if value != 0]
        camera["unknowns"] = dict.fromkeys([*_FREE, *estimated], "free")
        if len(control) < _LEAST_CONTROL:
            settings["datum"] = {"kind": "inner", "over": "points"}
            if len(control):
                warn(f"{path.name}: {len(control)} control points are too few for a datum; the block is a free network")
        else:
            # Negative sigmas mark fixed coordinates in PhotoModeler, zeros in DBAT.
            sigmas = {name: np.maximum(control.numbers(name), 0.0) for name in ("sx", "sy", "sz")}
            fixed = Table(path.name, control.columns | sigmas, control.files, control.rows)
            tables["control_points"] = control_table(fixed, "", 1.0)
    if (path.parent / STATIONS).is_file():
        table = read_columns(path.parent / STATIONS, ("image", *XYZ, "sigma"))
        stations = {"image": np.array([_stem(name) for name in table.ids("image")], object)}
        stations |= {name: table.numbers(name) for name in XYZ}
        stations |= {name: table.numbers("sigma") for name in SIGMA_XYZ}
        tables["stations"] = Table(table.file, stations, table.files, table.rows)
    return BlockTables(settings, tables, path.name)


def _camera(path: Path, lines: list[str]) -> dict[str, Any]:
    """Return the [cameras.X] table of the camera."""
    if len(lines[1].split()) == 2:
        raise InputError(f"{path.name}, row 2: no size of the photographs; write width, height at its end")
    _, _, width, height = row_numbers(path, 2, lines[1].split(), 4)
    c, px, py, width_mm, height_mm, *coefficients = row_numbers(path, 4, lines[3].split(), 10)
    if min(width, height, width_mm, height_mm) <= 0:
        raise InputError(f"{path.name}: the format of the camera is not positive. Export it again")
    sides = width_mm / width, height_mm / height
    square = abs(sides[0] / sides[1] - 1) < _SQUARE
    # Affinity is applied first: it makes the pixels square.
    pixel = sides[0] if square else sides[1]
    b1 = 0.0 if square else 1.0 - sides[0] / pixel
    xp, yp = px / (1.0 - b1) - pixel * (width / 2 + 0.5), -(py - pixel * (height / 2 + 0.5))
    interior = {"c_mm": c, "xp_mm": xp, "yp_mm": yp}
    interior |= dict(zip(("k1", "k2", "k3", "p1", "p2"), (0.0 - value for value in coefficients), strict=True))
    return {
        "width_px": int(width), "height_px": int(height), "pixel_mm": pixel,
        "distortion": "brown" if square else "affine_brown", "interior": interior | ({} if square else {"b1": b1}),
    }  # fmt: skip


def _sections(path: Path, lines: list[str], at: int) -> list[Table]:
    """Read control points, object points and marks; an empty line ends each table."""
    tables = []
    for columns in (_POINT, _POINT, _MARK):
        at, cells, rows = at + 1, [], []
        while at < len(lines) and lines[at].strip():
            cells.append(lines[at].split())
            at += 1
            rows.append(at)
            if len(cells[-1]) != len(columns):
                raise InputError(f"{path.name}, row {at}: expected {len(columns)} numbers. Export it again")
        values = {name: np.array([row[j] for row in cells], object) for j, name in enumerate(columns)}
        tables.append(Table.of(path.name, values, np.array(rows, int)))
    return tables


def _stem(name: str) -> str:
    return Path(name.replace("\\", "/")).stem


FORMATS = (Format("photomodeler", "export of PhotoModeler", by_content("*.txt", _is_export), read),)
