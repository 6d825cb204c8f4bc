"""Control of BINGO's geoin.dat: rows that begin with CONT are control, those with CHCK check points.

    CONT point X Y Z ...

Rows that begin with other words, cameras among them, are passed over. No row names the system.
Source: a program that reads these files (S. Turek's bundle block adjustment for GRASS, 2014); BINGO's manual is not
public.
"""

import re
from pathlib import Path

from jaxphoto.io.control_files.rows import Cells, SurveyRows
from jaxphoto.io.text_tables import is_number
from jaxphoto.procedures.control.surveyed import SurveyedPoints

_CHECK = {"CONT": False, "CHCK": True}
_RECORD = re.compile("[A-Z]{4}")


def recognises(lines: list[str]) -> bool:
    """Whether these are records of such a file, each with its word of four capitals, and points among them."""
    rows = [row for line in lines if (row := line.split(maxsplit=5)) and row[0][0] not in "*#"]
    points = (row for row in rows if row[0] in _CHECK and len(row) >= 5)
    records = all(_RECORD.fullmatch(row[0]) or row[0] == "C" for row in rows)
    return records and any(all(map(is_number, row[2:5])) for row in points)


def read_geoin(path: Path, lines: list[str], rows: list[int]) -> SurveyedPoints:
    """The points. Raises InputError for a row that is none, and for a point that stands there twice."""
    own = [(line.split(), row) for line, row in zip(lines, rows, strict=True) if line.split()[0] in _CHECK]
    cells, points = Cells(path.name, [row for row, _ in own], [row for _, row in own]), SurveyRows(path.name)
    for k, row in enumerate(cells.records):
        if len(row) < 5:
            raise cells.bad(k, f"{len(row)} cells; a row has {row[0]}, the point, X, Y and Z, so complete it")
        xyz = [cells.number(k, 2, "X"), cells.number(k, 3, "Y"), cells.height(k, 4)]
        points.add(row[1], xyz, cells.place(k), check=_CHECK[row[0]], once=True)
    return points.surveyed()
