"""PhotoModeler's text export, with DBAT's control files beside it or alone.

    title; tolerance, iterations, width, height; standard deviations; c, px, py, width, height (mm), K1 K2 K3 P1 P2
    of every photograph six lines with its number: name; X Y Z kappa phi omega; their sigmas; covariances or nothing;
        its camera; its sigmas
    an empty line, then of each control point, object point and mark in turn, an empty line after each kind:
        id X Y Z and sigmas; the same; photograph id x y and sigmas (pixels, counted as by DBAT, see dbat.py)

K and P are added to a coordinate that is reduced to the principal point, where our Brown model subtracts: all change
sign. px and py count from pixel (0, 0), as DBAT takes them, half a pixel outside the upper left corner; y down. The
angles are those of docs/conventions.md in degrees. Control is read from `ctrlpts-weighted.txt`, camera stations from
`fake-camera-positions.txt`, in the same folder. Orientations and object points, in a frame of their own, are read only
without such control.
Sources: PhotoModeler's help, "Lens Distortion Formulation" and "Decentering lens distortion"; exports that come with
DBAT.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.dbat import CAMERA, control_table
from jaxphoto.extras.formats.files import Format, by_content, read_columns, row_numbers, warn
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.camera_section import PIXEL_MM
from jaxphoto.io.block_folder.table_layout import ANGLES, SIGMA_XYZ, XYZ
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.io.text_tables import Table, is_number

CONTROL, STATIONS = "ctrlpts-weighted.txt", "fake-camera-positions.txt"
# The export's own sigmas are flags (1 manual, 0 automatic); DBAT takes 1 pixel for all.
_SIGMA_PX = 1.0
# Numbers in rows 2 to 4 of the header; the second may lack the size of photographs.
_HEADERS = ((4, 9, 10), (2, 9, 10))
_LINES_PER_PHOTOGRAPH = 6
_POINT, _MARK = ("id", "x", "y", "z", "sx", "sy", "sz"), ("im", "id", "x", "y", "sx", "sy")
_FREE = {"c_mm": "free", "xp_mm": "free", "yp_mm": "free"}
_LEAST_CONTROL = 3
# Relative difference of the sides of square pixels.
_SQUARE = 1e-9


def _is_export(path: Path) -> bool:
    with path.open("rb") as file:
        begin = file.read(2_000).decode("utf-8", "replace").splitlines()
    rows = [line.split() for line in begin[1:4]]
    return len(begin) > 5 and tuple(map(len, rows)) in _HEADERS and all(is_number(cell) for row in rows for cell in row)


def read(path: Path) -> BlockTables:
    """Read the block of an export and the files beside it.

    Without these it starts at the orientations and points of the export, with its control if that has three points and
    as a free network otherwise; the camera is free in c, xp, yp and the coefficients that are not zero.
    """
    lines = read_legacy_text(path).split("\n")
    if len(lines) < 6:
        raise InputError(f"{path.name}: the export ends within its header. Export it again")
    camera = _camera(path, lines)
    name_of, images, at = _photographs(path, lines)
    control, points, marks = _sections(path, lines, at)
    for line, number in enumerate(marks.text("im")):
        if number not in name_of:
            raise marks.bad(line, f"image {number} is not among the export's images. Export it again")
    columns = {
        "image": np.array([name_of[number] for number in marks.text("im")], object),
        "point": marks.text("id"),
        "column_px": marks.numbers("x") - 0.5,
        "row_px": marks.numbers("y") - 0.5,
        "sigma_px": np.full(len(marks), _SIGMA_PX),
    }
    tables = {"images": images, "image_points": Table(path.name, columns, marks.files, marks.rows)}
    settings: dict[str, Any] = {"title": lines[0].strip(), "cameras": {CAMERA: camera}}
    if (path.parent / CONTROL).is_file():
        tables["images"] = Table.of(path.name, {name: images.columns[name] for name in ("image", "camera")})
        control = read_columns(path.parent / CONTROL, ("id", "label", "x", "y", "z", "sx", "sy", "sz"))
        tables["control_points"] = control_table(control, "", 1.0)
    else:
        xyz = {name: points.numbers(axis) for name, axis in zip(XYZ, "xyz", strict=True)}
        tables["object_points"] = Table(path.name, {"point": points.ids("id")} | xyz, points.files, points.rows)
        estimated = [name for name, value in camera["interior"].items() if value != 0]
        camera["unknowns"] = _FREE | dict.fromkeys(estimated, "free")
        if len(control) < _LEAST_CONTROL:
            settings["datum"] = {"kind": "inner", "over": "points"}
            if len(control):
                warn(f"{path.name}: {len(control)} control points are too few for a datum; the block is a free network")
        else:
            # A fixed coordinate has a negative sigma here, zero in DBAT.
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
    """The [cameras.X] table."""
    if len(lines[1].split()) == 2:
        raise InputError(f"{path.name}, row 2: it has no size of the photographs; write width, height at its end")
    _, _, width, height = row_numbers(path, 2, lines[1].split(), 4)
    c, px, py, width_mm, height_mm, *coefficients = row_numbers(path, 4, lines[3].split(), 10)
    if min(width, height, width_mm, height_mm) <= 0:
        raise InputError(f"{path.name}: the format of the camera is not positive. Export it again")
    sides = width_mm / width, height_mm / height
    if not all(PIXEL_MM[0] <= side <= PIXEL_MM[1] for side in sides):
        raise InputError(f"{path.name}: pixels of {sides[0]:g} x {sides[1]:g} mm cannot be. Export it again")
    square = abs(sides[0] / sides[1] - 1) < _SQUARE
    # The affinity makes pixels square before anything else is applied.
    pixel = sides[0] if square else sides[1]
    b1 = 0.0 if square else 1.0 - sides[0] / pixel
    xp, yp = px / (1.0 - b1) - pixel * (width / 2 + 0.5), -(py - pixel * (height / 2 + 0.5))
    interior = {"c_mm": c, "xp_mm": xp, "yp_mm": yp}
    interior |= dict(zip(("k1", "k2", "k3", "p1", "p2"), (0.0 - value for value in coefficients), strict=True))
    return {
        "width_px": int(width), "height_px": int(height), "pixel_mm": pixel,
        "distortion": "brown" if square else "affine_brown", "interior": interior | ({} if square else {"b1": b1}),
    }  # fmt: skip


def _photographs(path: Path, lines: list[str]) -> tuple[dict[str, str], Table, int]:
    """Names of photographs by number, images.csv, and the line after them."""
    at, names = 5, dict[str, str]()
    poses, rows = [], []
    while at < len(lines) and lines[at].strip():
        words = lines[at].split(maxsplit=1)
        if len(words) != 2 or len(lines) < at + _LINES_PER_PHOTOGRAPH:
            raise InputError(f"{path.name}, row {at + 1}: {quoted(lines[at])} begins no photograph. Export it again")
        names[words[0]] = _stem(words[1].strip())
        poses.append(row_numbers(path, at + 2, lines[at + 1].split(), 7)[1:])
        rows.append(at + 2)
        at += _LINES_PER_PHOTOGRAPH
    if not names:
        raise InputError(f"{path.name}, row 6: there is no photograph. Export it again")
    if len(names) < len(poses):
        raise InputError(f"{path.name}: two photographs have one number. Export it again")
    x, y, z, kappa, phi, omega = np.array(poses).T
    columns = {"image": np.array(list(names.values()), object), "camera": np.full(len(names), CAMERA, object)}
    columns |= dict(zip((*XYZ, *ANGLES), (x, y, z, omega, phi, kappa), strict=True))
    return names, Table.of(path.name, columns, np.array(rows, int)), at


def _sections(path: Path, lines: list[str], at: int) -> list[Table]:
    """Control points, object points and marks, each up to the next empty line."""
    tables = []
    for columns in (_POINT, _POINT, _MARK):
        at, cells, rows = at + 1, [], []
        while at < len(lines) and lines[at].strip():
            cells.append(lines[at].split())
            at += 1
            rows.append(at)
            if len(cells[-1]) != len(columns):
                raise InputError(f"{path.name}, row {at}: {len(columns)} numbers are expected here. Export it again")
        values = {name: np.array([row[j] for row in cells], object) for j, name in enumerate(columns)}
        tables.append(Table.of(path.name, values, np.array(rows, int)))
    return tables


def _stem(name: str) -> str:
    return Path(name.replace("\\", "/")).stem


FORMATS = (Format("photomodeler", "export of PhotoModeler", by_content("*.txt", _is_export), read),)
