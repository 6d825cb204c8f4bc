"""`gcp_list.txt` of OpenDroneMap and WebODM: a line that names the system, then a mark in each row.

    EPSG:32633
    geo_x geo_y geo_z im_x im_y image_name [gcp_name] [extras]

geo_x is the easting or longitude, whatever the order of the system's axes. Pixels are counted from the centre of the
upper-left one, as OpenSfM does which adjusts them. Rows without a name are of the same point where their coordinates
are the same. A height that is nan is not known.
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
_LEAST = 6
FIRST_PX = 0.5
"""Column and row, as here, of the centre of the upper-left pixel, which is (0, 0) there."""


def recognises(lines: list[str]) -> bool:
    """Whether the first line names a system and the next has a mark."""
    cells = lines[1].split() if len(lines) > 1 else []
    numbers = len(cells) >= _LEAST and all(map(is_number, cells[:5]))
    return bool(SYSTEM.match(lines[0].strip())) and (numbers or len(lines) == 1)


def read_gcp_list(path: Path, lines: list[str], rows: list[int]) -> GivenControl:
    """Points, all of them control, and marks. Raises InputError for a row that is none."""
    cells = Cells(path.name, [line.split() for line in lines[1:]], rows[1:])
    points = SurveyRows(path.name)
    marks = []
    for k, row in enumerate(cells.records):
        if len(row) < _LEAST:
            raise cells.bad(
                k, f"{len(row)} cells; a row has geo_x, geo_y, geo_z, im_x, im_y and image_name, so complete it"
            )
        if row[0].startswith("#"):
            continue
        xyz = [cells.number(k, 0, "geo_x"), cells.number(k, 1, "geo_y"), cells.height(k, 2)]
        name = row[6] if len(row) > _LEAST else points.named_by(xyz)
        points.add(name, xyz, cells.place(k), "give it one position in all rows, or another name")
        column_row = [cells.number(k, 3, "im_x") + FIRST_PX, cells.number(k, 4, "im_y") + FIRST_PX]
        marks.append((row[5], name, column_row, np.nan, cells.place(k)))
    if not marks:
        raise cells.none(f"there is no mark after {quoted(lines[0].strip())}; add rows")
    return GivenControl(points.surveyed(lines[0].strip()), read_marks(marks))
