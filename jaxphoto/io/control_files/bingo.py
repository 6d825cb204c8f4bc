"""Control of BINGO's geoin.dat: rows that begin with CONT are control, those with CHCK check points.

    CONT point X Y Z ...

Rows that begin with other words, cameras among them, are passed over. No row names the system.
Source: a program that reads these files (S. Turek's bundle block adjustment for GRASS, 2014); BINGO's manual is not
public.
"""

from pathlib import Path

from jaxphoto.io.control_files.rows import Cells, SurveyRows
from jaxphoto.io.text_tables import is_number
from jaxphoto.procedures.control.surveyed import SurveyedPoints

_CHECK = {"CONT": False, "CHCK": True}


def recognises(lines: list[str]) -> bool:
    """Whether a row is a point of such a file."""
    rows = (line.split(maxsplit=5) for line in lines if line.lstrip().startswith(tuple(_CHECK)))
    return any(len(row) >= 5 and row[0] in _CHECK and all(map(is_number, row[2:5])) for row in rows)


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
