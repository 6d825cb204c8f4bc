"""Tables of exposures as other programs write them, in the columns of jaxphoto's own.

    Pix4D         imagename,latitude,longitude,altitude[,accuracy horizontal,accuracy vertical] and
                  omega,phi,kappa or yaw,pitch,roll
    Metashape     #Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll[,X_acc ...], #CoordinateSystem: WKT above it
    --to opk      imageName X Y Z Omega Phi Kappa, a comment says the system
    OpenDroneMap  geo.txt: the system alone in the first line, then name x y z [yaw pitch roll [accuracy in plan, in
                  height]]; x is the easting or longitude, angles that are all 0 are not known
    POSPac        exterior orientation as text (`jaxphoto.io.exposures.pospac`)

Cells are separated by tabs, semicolons, commas or blanks, words of a header are in any case and order. Yaw, pitch and
roll are of a camera that looks down with the top of its picture to the north at zero, and count from true north, as
omega, phi, kappa do from that of the grid.
Sources: Pix4D support, articles 202558539 and 202558969; OpenDroneMap documentation, "Image Geolocation Files", and its
`compute_opk`; Agisoft Metashape User Manual, "Reference pane".
"""

import re
from collections.abc import Container
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.io.control_files.gcp_list import SYSTEM
from jaxphoto.io.control_files.rows import Cells
from jaxphoto.io.control_files.table_header import PLACE, Columns, columns_of, in_degrees
from jaxphoto.io.control_files.tables import separator_of, split_row, with_points
from jaxphoto.io.exposures.pospac import read_pospac
from jaxphoto.io.text_tables import Table, each_row, is_number
from jaxphoto.io.whole_text import LARGE, read_text
from jaxphoto.procedures.control.surveyed import ControlSystem, system_of

MAP, GEOGRAPHIC = ("X_m", "Y_m", "Z_m"), ("longitude_deg", "latitude_deg", "height_m")
"""Columns of positions on a map, and of geographic ones."""
_SIGMA = {"sigma_x": "sigma_X_m", "sigma_y": "sigma_Y_m", "sigma_z": "sigma_Z_m"}
_ANGLES = ("omega", "phi", "kappa", "roll", "pitch", "yaw")
_WORDS = {
    "image": ("image", "imagename", "image name", "label", "photo", "photograph", "filename", "file name", "name"),
    **PLACE,
    **{name: (name,) for name in _ANGLES},
    **{f"sigma_{name}": (f"sigma {name}", f"{name} acc", f"accuracy {name}") for name in _ANGLES},
    "fix": ("fix",),
    "enabled": ("enable", "enabled"),
}
_OF_ODM = ("image", "x", "y", "z", "yaw", "pitch", "roll", "sigma_plan", "sigma_z")
_LEAST_ODM = 3
_EPSG = re.compile(r"\b(EPSG::?\s*\d{4,6}(?:\s*\+\s*\d{4,6})?)", re.IGNORECASE)
_WKT = re.compile(r"#\s*CoordinateSystem:\s*(\S.*)$", re.IGNORECASE)
_GON = re.compile(r"\b(gons?|grads?|gradians?)\b", re.IGNORECASE)
# As --to opk says it.
_ELLIPSOID = "heights above the ellipsoid"
# Lines among which a header or the system may be a comment.
_HEAD = 20
_OFF = ("0", "false", "no")


class OtherTable(NamedTuple):
    """A table in jaxphoto's columns."""

    table: Table
    system: ControlSystem | None
    """Of its positions, as the file says."""
    true_north: bool
    """Whether its yaw counts from true north wherever the positions are."""
    ellipsoid: bool = False
    """Whether the file says that its heights are above the ellipsoid."""


def read_other_table(path: Path, without: Container[int] = ()) -> OtherTable | None:
    """The table in a file but for the rows `without`; None where neither its first line nor a comment names columns.

    Raises InputError for rows that are too short, angles in gon, and a system that nobody can tell; and as
    `read_pospac`.
    """
    lines = enumerate(read_text(path, LARGE).split("\n"), 1)
    numbered = [(row, line) for row, line in lines if line.strip() and row not in without]
    content = [(row, line) for row, line in numbered if not line.lstrip().startswith("#")]
    if not content:
        return None
    if SYSTEM.match(content[0][1].strip()):
        return _of_open_drone_map(path.name, content)
    whole = Cells(path.name, [[line] for _, line in content], [row for row, _ in content])
    if (exported := read_pospac(whole)) is not None:
        own, columns, known = exported
        return OtherTable(_table(own, columns, known, False), known, False, ellipsoid=True)
    comments = [line.strip() for _, line in numbered[:_HEAD] if line.lstrip().startswith("#")]
    separator = separator_of(content[0][1])
    records = each_row(lambda row, line: split_row(path.name, line, row, separator), content)
    cells = Cells(path.name, records, [row for row, _ in content])
    said_in = [line.lstrip("# ").split(None if separator == " " else separator) for line in comments]
    for k, header in enumerate((cells.records[0], *said_in)):
        columns = columns_of(header, _WORDS)
        own = cells._replace(records=cells.records[k == 0 :], rows=cells.rows[k == 0 :])
        if {"image", "x", "y"} <= set(columns) and (k == 0 or len(header) <= len(cells.records[0])):
            break
    else:
        return None
    if "z" not in columns:
        raise InputError(f"{path.name}: its header names no heights (Z, altitude or height); add them")
    if any(name in columns for name in _ANGLES) and _GON.search(" ".join([*comments, *header])):
        raise InputError(f"{path.name}: its angles are in gon or grad; give degrees")
    words = [found[1] for line in comments for of in (_WKT, _EPSG) if (found := of.search(line))]
    system = _known(path.name, words[0]) if words else None
    own_yaw = "yaw" in columns and header[columns["yaw"]].lower() == "yaw_deg"
    own = with_points(own, separator, columns["image"])
    ellipsoid = any(_ELLIPSOID in line for line in comments)
    return OtherTable(_table(own, columns, system, in_degrees(header, columns)), system, not own_yaw, ellipsoid)


def _of_open_drone_map(file: str, content: list[tuple[int, str]]) -> OtherTable:
    """geo.txt, whose columns have no names."""
    cells = Cells(file, [line.split() for _, line in content[1:]], [row for row, _ in content[1:]])
    sound = [len(row) >= _LEAST_ODM and all(map(is_number, row[1 : len(_OF_ODM)])) for row in cells.records]
    cells.check(
        sound, lambda k: "after the name stand x, y, z, and yaw, pitch, roll and accuracies or nothing; correct it"
    )
    for row in cells.records:
        if len(row) > 6 and all(float(cell) == 0 for cell in row[4:7]):
            row[4:7] = ["", "", ""]
    width = max(map(len, cells.records), default=0)
    # Angles are three, accuracies two.
    columns = {name: k for k, name in enumerate(_OF_ODM[: 9 if width >= 9 else 7 if width >= 7 else 4])}
    system = _known(file, content[0][1].strip())
    return OtherTable(_table(cells, columns, system, False), system, True)


def _known(file: str, words: str) -> ControlSystem:
    """The system that `words` name, with its EPSG code."""
    system = system_of(words, file)
    if system.code is None or system.crs is None or system.crs.is_geocentric:
        raise InputError(
            f"{file}: its system ({system.name}) is none of a map with an EPSG code; write EPSG:25832, say"
        )
    return system


def _table(cells: Cells, columns: Columns, system: ControlSystem | None, degrees: bool) -> Table:
    """The rows in jaxphoto's columns; those that Metashape has switched off are left out."""
    place = GEOGRAPHIC if degrees and system is None else MAP
    named = {"image": "image", "fix": "fix", **dict(zip("xyz", place, strict=True)), **_SIGMA}
    named |= {key: f"{key}_deg" for name in _ANGLES for key in (name, f"sigma_{name}")}
    wanted = {named[name]: k for name, k in columns.items() if name in named}
    if "sigma_plan" in columns:
        wanted |= dict.fromkeys(("sigma_X_m", "sigma_Y_m"), columns["sigma_plan"])
    elif "sigma_x" in columns and "sigma_y" not in columns:
        wanted |= {name: columns["sigma_x"] for name in _SIGMA.values() if name not in wanted}
    for of in (_ANGLES[:3], _ANGLES[3:]):
        if not all(name in columns for name in of):
            wanted = {name: k for name, k in wanted.items() if name.removeprefix("sigma_")[:-4] not in of}
    kept, rows = [], []
    least = max(columns[name] for name in ("image", "x", "y"))
    cells.check(
        [len(row) > least for row in cells.records],
        lambda k: f"{len(cells.records[k])} cells are too few for the columns; complete the row",
    )
    for k, row in enumerate(cells.records):
        if "enabled" not in columns or len(row) <= columns["enabled"] or row[columns["enabled"]].lower() not in _OFF:
            kept.append(row)
            rows.append(cells.rows[k])
    values = {}
    for name, at in wanted.items():
        values[name] = np.empty(len(kept), object)
        values[name][:] = [row[at] if at < len(row) else "" for row in kept]
    return Table.of(cells.file, values, np.array(rows, int))
