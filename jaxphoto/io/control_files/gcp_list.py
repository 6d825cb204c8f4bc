"""`gcp_list.txt` of OpenDroneMap and WebODM: a line that names the system, then a mark in each row.

    EPSG:32633
    geo_x geo_y geo_z im_x im_y image_name [gcp_name] [extras]

geo_x is the easting or longitude, whatever the order of the system's axes. Pixels are counted from the centre of the
upper-left one, as OpenSfM does which adjusts them. Rows without a name are of the same point where their coordinates
are the same. A height that is nan is not known. A list that is still to be marked, as POSM GCPi of WebODM takes it, has
no pictures: rows of gcp_name geo_x geo_y geo_z, or of geo_x geo_y geo_z [gcp_name]. Lines of # are comments.
Source: OpenDroneMap documentation, "Ground Control Points"; OpenSfM documentation, "Ground Control Points".
"""

import re
from pathlib import Path

import numpy as np

from jaxphoto.errors import quoted
from jaxphoto.io.control_files.rows import Cells, SurveyRows, read_marks
from jaxphoto.io.text_tables import is_number
from jaxphoto.procedures.control.surveyed import GivenControl

SYSTEM = re.compile(r"EPSG:\d|\+proj=|WGS84\s+UTM\s", re.IGNORECASE)
"""How the first line of a file of OpenDroneMap begins."""
_LEAST, _NAMED = 6, 4
FIRST_PX = 0.5
"""Column and row, as here, of the centre of the upper-left pixel, which is (0, 0) there."""


def recognises(lines: list[str]) -> bool:
    """Whether the first line names a system and the next has a mark, or a point."""
    told = [line for line in lines if not line.lstrip().startswith("#")]
    if not told or not SYSTEM.match(told[0].strip()):
        return False
    cells = told[1].split() if len(told) > 1 else []
    return len(told) == 1 or (len(cells) >= _LEAST and all(map(is_number, cells[:5]))) or _point(cells) is not None


def _point(cells: list[str]) -> tuple[str, int] | None:
    """The name, if there is one, and the first coordinate of a row that is a point alone; None where it is none."""
    # A number with decimals is no name: names may stand last, and be numbers too.
    if len(cells) == _NAMED and all(map(is_number, cells[1:])) and not (is_number(cells[0]) and "." in cells[0]):
        return cells[0], 1
    if len(cells) in (_NAMED - 1, _NAMED) and all(map(is_number, cells[:3])):
        return "".join(cells[3:]), 0
    return None


def read_gcp_list(path: Path, lines: list[str], rows: list[int]) -> GivenControl:
    """Points, all of them control, and marks. Raises InputError for a row that is none."""
    told = [(line, row) for line, row in zip(lines, rows, strict=True) if not line.lstrip().startswith("#")]
    system = told[0][0].strip()
    cells = Cells(path.name, [line.split() for line, _ in told[1:]], [row for _, row in told[1:]])
    points = SurveyRows(path.name)
    marks = []
    marked = bool(cells.records) and _point(cells.records[0]) is None
    for k, row in enumerate(cells.records):
        alone = None if marked else _point(row)
        if alone is None and len(row) < _LEAST:
            raise cells.bad(
                k, f"{len(row)} cells; a row has geo_x, geo_y, geo_z, im_x, im_y and image_name, so complete it"
            )
        name, first = alone or (row[6] if len(row) > _LEAST else "", 0)
        xyz = [cells.number(k, first, "geo_x"), cells.number(k, first + 1, "geo_y"), cells.height(k, first + 2)]
        name = name or points.named_by(xyz)
        points.add(name, xyz, cells.place(k), "give it one position in all rows, or another name")
        if alone is None:
            column_row = [cells.number(k, 3, "im_x") + FIRST_PX, cells.number(k, 4, "im_y") + FIRST_PX]
            marks.append((row[5], name, column_row, np.nan, cells.place(k)))
    if not cells.records:
        raise cells.none(f"there is no mark after {quoted(system)}; add rows")
    return GivenControl(points.surveyed(system), read_marks(marks))
