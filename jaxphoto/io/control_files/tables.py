"""Tables of points, or of marks, as CSV or separated by semicolons, tabs or blanks: ours, Metashape's and Pix4D's.

A comment may name the system: "# EPSG:25832", "# EPSG:25832+7837" with heights, "#CoordinateSystem: ..." with WKT.
Roles are control and check; "enable" 0 of Metashape means check, too. Pixels are counted so that the centre of the
upper-left one is (0.5, 0.5): Pix4D says no more than that the origin is the upper left of the image.
"""

import csv
import re
from collections import Counter
from pathlib import Path

import numpy as np

from jaxphoto.errors import RowError, counted, quoted
from jaxphoto.io.control_files.rows import Cells, Mark, SurveyRows, read_marks
from jaxphoto.io.control_files.table_header import (
    Columns,
    columns_without_header,
    in_degrees,
    mark_columns,
    point_columns,
)
from jaxphoto.io.text_tables import LONGEST_LINE, MOST_COLUMNS
from jaxphoto.procedures.control.surveyed import Marks, SurveyedPoints

_EPSG = re.compile(r"#.*\bEPSG:\s*(\d{4,6}(?:\+\d{4,6})?)\s*$", re.IGNORECASE)
_WKT = re.compile(r"#\s*CoordinateSystem:\s*(\S.*)$")
_ROLES = {
    "": False, "control": False, "gcp": False, "3d gcp": False, "2d gcp": False,
    "check": True, "cp": True, "check point": True, "checkpoint": True,
}  # fmt: skip
# Lines among which a header or the system may be a comment.
_HEAD = 20
_OFF = ("0", "false", "no")


def read_table(path: Path, lines: list[str], rows: list[int]) -> SurveyedPoints | Marks:
    """The points or the marks of a table; `lines` are all that are not empty, comments among them.

    Raises InputError for a table that is neither, and for cells that are wrong.
    """
    said = [match[1].strip() for line in lines[:_HEAD] for of in (_EPSG, _WKT) if (match := of.match(line.strip()))]
    content = [(line, row) for line, row in zip(lines, rows, strict=True) if not line.lstrip().startswith("#")]
    comments = [line for line in lines[:_HEAD] if line.lstrip().startswith("#")]
    separator = separator_of(content[0][0] if content else "")
    cells = Cells(
        path.name, [split_row(path.name, line, row, separator) for line, row in content], [r for _, r in content]
    )
    said_in = [line.strip().lstrip("#").strip().split(None if separator == " " else separator) for line in comments]
    width = len(cells.records[0]) if cells.records else 0
    for header in (*cells.records[:1], *(words for words in said_in if len(words) <= MOST_COLUMNS)):
        is_row = bool(cells.records) and header is cells.records[0]
        own = cells._replace(records=cells.records[is_row:], rows=cells.rows[is_row:])
        marks, points = mark_columns(header), point_columns(header)
        # A comment whose columns the rows have not is a sentence.
        if marks and (is_row or max(marks[name] for name in ("image", "point", "x", "y")) < width):
            return _marks(own, marks, separator)
        if points and (is_row or max(points[name] for name in ("point", "x", "y")) < width):
            return read_points(own, points, separator, "".join(said[:1]), bool(in_degrees(header, points)))
    records = with_points(cells, separator).records
    found = columns_without_header(records) if records else None
    if found is None:
        usual = Counter(map(len, records)).most_common(1)[0][0] if records else 0
        odd = [k for k, r in enumerate(records) if len(r) != usual]
        if 2 * len(odd) < len(records) and columns_without_header([r for r in records if len(r) == usual]):
            raise cells.bad(
                odd[0], f"{counted(len(records[odd[0]]), 'cell')}, where most rows have {usual}; complete it"
            )
        first = f" (it begins with {quoted(' '.join(cells.records[0]))})" if cells.records else ""
        raise cells.none(
            f"this is no file of control{first}: give points (point, X_m, Y_m, Z_m), marks (image, point, x_px, y_px), "
            "a gcp_list.txt, markers of Metashape as XML, points as GeoJSON or a GeoPackage"
        )
    kind, columns = found
    if kind == "marks":
        return _marks(cells, columns, separator)
    return read_points(cells, columns, separator, "".join(said[:1]), False)._replace(own_axes=True)


def read_points(cells: Cells, columns: Columns, separator: str, system: str, degrees: bool) -> SurveyedPoints:
    """Rows of points, whose columns are known; `degrees`: the header says longitude and latitude.

    Raises InputError for cells that are wrong, and where there is no row.
    """
    cells, points = with_points(cells, separator, columns["point"]), SurveyRows(cells.file)
    for k, row in enumerate(cells.records):
        if len(row) <= max(columns["point"], columns["x"], columns["y"]):
            raise cells.bad(k, f"{len(row)} cells are too few for the header; complete the row")
        xyz = [cells.number(k, columns["x"], "X"), cells.number(k, columns["y"], "Y"), np.nan]
        if "z" in columns and len(row) > columns["z"]:
            xyz[2] = cells.height(k, columns["z"])
        sigma = [cells.sigma(k, columns.get(f"sigma_{axis}"), f"sigma of {axis}") for axis in "xyz"]
        plan = cells.sigma(k, columns.get("sigma_plan"), "sigma in plan")
        sigma = [plan if np.isnan(v) and axis < 2 else v for axis, v in enumerate(sigma)]
        if "sigma_x" in columns and "sigma_y" not in columns:
            sigma = [sigma[0] if np.isnan(v) else v for v in sigma]
        name = row[columns["point"]]
        points.add(name, xyz, cells.place(k), sigma=sigma, check=_is_check(cells, k, columns), once=True)
    found = points.surveyed(system)
    if degrees and not (np.abs(found.coordinates[:, 0]) <= 360).all():
        raise cells.none("the header says longitude and latitude, but the numbers are no degrees; correct the header")
    return found


def _is_check(cells: Cells, k: int, columns: Columns) -> bool:
    row = cells.records[k]
    cell = lambda name: row[columns[name]].lower() if name in columns and len(row) > columns[name] else ""  # noqa: E731
    if cell("role") not in _ROLES:
        raise cells.bad(k, f"the role {quoted(cell('role'))} is unknown; write control or check")
    return _ROLES[cell("role")] or cell("enabled") in _OFF


def _marks(cells: Cells, columns: Columns, separator: str) -> Marks:
    cells = with_points(cells, separator, columns["image"], columns["point"])
    found: list[Mark] = []
    for k, row in enumerate(cells.records):
        if len(row) <= max(v for name, v in columns.items() if name != "sigma"):
            raise cells.bad(k, f"{len(row)} cells are too few for the header; complete the row")
        column_row = [cells.number(k, columns["x"], "x"), cells.number(k, columns["y"], "y")]
        sigma = cells.sigma(k, columns.get("sigma"), "the sigma of the mark")
        found.append((row[columns["image"]], row[columns["point"]], column_row, sigma, cells.place(k)))
    if not found:
        raise cells.none("there is no mark; add rows")
    return read_marks(found)


def separator_of(line: str) -> str:
    """What separates the cells of a row: a tab, a semicolon, a comma, else blanks."""
    return next((s for s in ("\t", ";", ",") if s in line), " ")


def split_row(file: str, line: str, row: int, separator: str) -> list[str]:
    """The cells of a row. Raises InputError for one that is too long, and for quotation marks that do not pair."""
    if len(line) > LONGEST_LINE:
        raise RowError(
            f"{file}, row {row}: the row has {len(line)} characters, at most {LONGEST_LINE}; correct it", [row]
        )
    if separator == " ":
        cells = line.split()
    else:
        try:
            (cells,) = csv.reader([line], delimiter=separator, skipinitialspace=True, strict=True)
        except csv.Error:
            raise RowError(f"{file}, row {row}: the quotation marks do not pair; close or remove them", [row]) from None
    if len(cells) > MOST_COLUMNS:
        raise RowError(f"{file}, row {row}: the row has {len(cells)} cells, at most {MOST_COLUMNS}; correct it", [row])
    return [cell.strip() for cell in cells]


def with_points(cells: Cells, separator: str, *text: int) -> Cells:
    """With points for decimal commas, which a separator other than a comma allows; not in the columns `text`."""
    if separator == ",":
        return cells
    records = [[c if k in text else c.replace(",", ".") for k, c in enumerate(row)] for row in cells.records]
    return cells._replace(records=records)
