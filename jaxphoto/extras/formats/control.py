"""Control points and image marks: tables, and gcp_list.txt of OpenDroneMap.

    tables        points (point, X_m, Y_m, Z_m, sigma_X_m ..., role) or marks (image, point, x_px, y_px, sigma_px) of
                  jaxphoto, Metashape and Pix4D, separated by commas, semicolons, tabs or blanks. A comment may name the
                  system: "# EPSG:25832+7837", "#CoordinateSystem: ..." with WKT. Without a header, as in Pix4D: label,
                  coordinates in the axis order of the system, z [, horizontal and vertical accuracy], or image,
                  label, x, y [, accuracy]. Pixel coordinates are the same as ours.
    gcp_list.txt  a line with the coordinate system (WGS84, WGS84 UTM 32N, EPSG:25832, a PROJ string), then geo_x geo_y
                  geo_z im_x im_y image_name [gcp_name] [extras]; geo_x is easting or longitude; pixel (0, 0) is at the
                  centre of the upper left pixel. A list without marks has rows of gcp_name geo_x geo_y geo_z, or of
                  geo_x geo_y geo_z [gcp_name].

Source: OpenDroneMap and OpenSfM documentation, "Ground Control Points".
"""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError, counted, quoted
from jaxphoto.extras.formats.files import ControlFormat, numbered_lines
from jaxphoto.io.control_table import (
    PLACE,
    SYSTEM,
    Cells,
    Columns,
    columns_of,
    in_degrees,
    separator_of,
    split_row,
    with_points,
)
from jaxphoto.io.text_tables import is_number
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints, system_of

# Our column and row of the centre of the upper left pixel, (0, 0) in gcp_list.txt.
_FIRST_PX = 0.5
_POINT = {
    "point": ("label", "point", "gcp", "gcp label", "gcp name", "point name", "marker", "name", "point id", "id"),
    **PLACE,
    "role": ("role", "type"),
    "enabled": ("enable", "enabled"),
}
_MARK = {
    "image": ("image", "image name", "photo", "photograph", "camera", "filename", "file name", "file"),
    "point": _POINT["point"],
    "x": ("x px", "x", "px", "column px", "column", "im x", "pixel x", "pixelx", "u", "image u"),
    "y": ("y px", "y", "py", "row px", "row", "im y", "pixel y", "pixely", "v", "image v"),
    "sigma": ("sigma px", "sigma", "accuracy px", "accuracy"),
}
_PICTURE = re.compile(r"\.(jpe?g|tiff?|png|dng)$", re.IGNORECASE)
_EPSG = re.compile(r"#.*\bEPSG:\s*(\d{4,6}(?:\+\d{4,6})?)\s*$", re.IGNORECASE)
_WKT = re.compile(r"#\s*CoordinateSystem:\s*(\S.*)$")
_ROLES = {
    "": False, "control": False, "gcp": False, "3d gcp": False, "2d gcp": False,
    "check": True, "cp": True, "check point": True, "checkpoint": True,
}  # fmt: skip
_HEAD_LINES = 20


Mark = tuple[str, str, list[float], float, str]
"""Image, point, (column, row) in pixels, sigma in pixels, source location for messages."""


class SurveyRows:
    """Surveyed points in file order."""

    def __init__(self, file: str) -> None:
        self.file = file
        self._rows: dict[str, tuple[list[float], list[float], bool, str]] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def add(
        self, name: str, xyz: list[float], place: str, sigma: Sequence[float] = (np.nan,) * 3, check: bool = False
    ) -> None:
        """Add a point. Raise InputError for a name that is empty, or has other coordinates above."""
        if not name:
            raise InputError(f"{place}: the point is empty; give its name or delete the row")
        row = (xyz, list(sigma), check, place)
        first = self._rows.setdefault(name, row)
        if not np.array_equal(np.array(first[0]), np.array(xyz), equal_nan=True):
            raise InputError(f"{place}: point {quoted(name)} is also in {first[3]} with other coordinates; keep one")

    def surveyed(self, system: str = "") -> SurveyedPoints:
        """Return all points. Raise InputError if there is none."""
        if not self._rows:
            raise InputError(f"{self.file}: no point has coordinates; add some")
        xyz, sigma, check, place = zip(*self._rows.values(), strict=True)
        points = np.array(xyz, float).reshape(-1, 3), np.array(sigma, float).reshape(-1, 3), np.array(check, bool)
        return SurveyedPoints(self.file, tuple(self._rows), *points, place, system)


def read_marks(rows: Sequence[Mark]) -> Marks:
    """Collect marks. Raise InputError for empty names, and for a point marked twice in an image."""
    seen: dict[tuple[str, str], str] = {}
    for image, point, _, _, place in rows:
        if not (image and point):
            raise InputError(f"{place}: the image or point is empty; give its name or delete the row")
        first = seen.setdefault((image, point), place)
        if first is not place:
            raise InputError(f"{place}: {quoted(point)} in {quoted(image)} is also marked in {first}; keep one of them")
    images, points, at, sigma, places = zip(*rows, strict=True) if rows else ((),) * 5
    return Marks(images, points, np.array(at, float).reshape(-1, 2), np.array(sigma, float), places)


# Tables -------------------------------------------------------------------------------------------------------


def read_table(path: Path, text: str) -> SurveyedPoints | Marks:
    """Read the points or marks of a table."""
    rows = numbered_lines(text)
    comments = [line.strip() for _, line in rows[:_HEAD_LINES] if line.lstrip().startswith("#")]
    content = [(row, line) for row, line in rows if not line.lstrip().startswith("#")]
    systems = [match[1].strip() for line in comments for of in (_EPSG, _WKT) if (match := of.match(line))]
    if content and SYSTEM.match(content[0][1].strip()):
        systems = [content.pop(0)[1].strip()]
    system = "".join(systems[:1])
    separator = separator_of(content[0][1] if content else "")
    cells = Cells(
        path.name, [split_row(path.name, line, row, separator) for row, line in content], [r for r, _ in content]
    )
    if not cells.records:
        raise cells.none("the file is empty; give it points or marks")
    width = len(cells.records[0])
    in_comments = [line.lstrip("#").strip().split(None if separator == " " else separator) for line in comments]
    for k, header in enumerate([cells.records[0], *in_comments]):
        below = cells._replace(records=cells.records[k == 0 :], rows=cells.rows[k == 0 :])
        marks, points = columns_of(header, _MARK), columns_of(header, _POINT)
        # Treat a comment as a header only if the rows have all its columns.
        if _has(marks, ("image", "point", "x", "y"), width if k else len(header)):
            return _marks(below, marks, separator)
        if "image" not in marks and _has(points, ("point", "x", "y"), width if k else len(header)):
            return read_points(below, points, separator, system, in_degrees(header, points))
    records = with_points(cells, separator).records
    kind, columns = _without_header(records)
    if kind == "marks":
        return _marks(cells, columns, separator)
    if kind == "points":
        return read_points(cells, columns, separator, system, False)._replace(own_axes=True)
    usual = Counter(map(len, records)).most_common(1)[0][0]
    odd = [k for k, r in enumerate(records) if len(r) != usual]
    if 2 * len(odd) < len(records) and _without_header([r for r in records if len(r) == usual])[0]:
        raise cells.bad(odd[0], f"{counted(len(records[odd[0]]), 'cell')}, but most rows have {usual}; complete it")
    first, second = cells.records[0], cells.records[min(1, len(cells.records) - 1)]
    wrong = "is neither a header nor a point nor a mark"
    if not any(map(is_number, first)) and any(map(is_number, second)):
        wrong = "is a header without the columns of points or marks"
    raise cells.bad(
        0,
        f"{quoted(' '.join(first))} {wrong}; write the header point, X_m, Y_m, Z_m or image, point, x_px, y_px, or "
        "give a gcp_list.txt or markers of Metashape",
    )


def _has(columns: Columns, names: tuple[str, ...], width: int) -> bool:
    return all(columns.get(name, width) < width for name in names)


def _without_header(records: Sequence[Sequence[str]]) -> tuple[str, Columns]:
    """Classify rows without a header as "points", "marks" or "" (neither) by majority; return the columns, too."""
    width = {len(r) for r in records}
    if not any(map(is_number, records[0][1:])):
        return "", {}
    marks = sum(bool(_PICTURE.search(r[0])) and all(map(is_number, r[2:])) for r in records)
    if width <= {4, 5} and 2 * marks > len(records):
        return "marks", dict(zip(("image", "point", "x", "y", "sigma"), range(max(width)), strict=False))
    points = sum(all(map(is_number, r[1:])) for r in records)
    if width <= {4, 6} and len(width) == 1 and 2 * points > len(records):
        names = ("point", "x", "y", "z", "sigma_plan", "sigma_z")
        return "points", dict(zip(names, range(max(width)), strict=False))
    return "", {}


def read_points(cells: Cells, columns: Columns, separator: str, system: str, degrees: bool) -> SurveyedPoints:
    """Read points from rows with known columns. `degrees`: True if the header names longitude and latitude."""
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
        role, enabled = (
            row[columns[name]].lower() if columns.get(name, len(row)) < len(row) else "" for name in ("role", "enabled")
        )
        if role not in _ROLES:
            raise cells.bad(k, f"unknown role {quoted(role)}; write control or check")
        check = _ROLES[role] or enabled in ("0", "false", "no")
        points.add(row[columns["point"]], xyz, cells.place(k), sigma, check)
    surveyed = points.surveyed(system)
    if degrees and not (np.abs(surveyed.coordinates[:, 0]) <= 360).all():
        raise cells.none(
            "the header contains longitude and latitude, but the numbers are not degrees; correct the header"
        )
    return surveyed


def _marks(cells: Cells, columns: Columns, separator: str) -> Marks:
    cells = with_points(cells, separator, columns["image"], columns["point"])
    marks: list[Mark] = []
    for k, row in enumerate(cells.records):
        if len(row) <= max(v for name, v in columns.items() if name != "sigma"):
            raise cells.bad(k, f"{len(row)} cells are too few for the header; complete the row")
        column_row = [cells.number(k, columns["x"], "x"), cells.number(k, columns["y"], "y")]
        sigma = cells.sigma(k, columns.get("sigma"), "the sigma of the mark")
        marks.append((row[columns["image"]], row[columns["point"]], column_row, sigma, cells.place(k)))
    if not marks:
        raise cells.none("no marks; add rows")
    return read_marks(marks)


# gcp_list.txt -------------------------------------------------------------------------------------------------


def _gcp_lines(text: str) -> list[tuple[int, str]]:
    return [(row, line) for row, line in numbered_lines(text) if not line.lstrip().startswith("#")]


def _is_gcp_list(path: Path, text: str) -> bool:
    lines = [line.strip() for _, line in _gcp_lines(text)]
    cells = lines[1].split() if len(lines) > 1 else []
    if not lines or not SYSTEM.match(lines[0]):
        # Lists without a system, or with an unknown one, are recognised by the names of photographs.
        rows = [line.split() for line in lines[:2]]
        return any(_is_marked(row) and bool(_PICTURE.search(row[5])) for row in rows)
    return len(lines) == 1 or _is_marked(cells) or _unmarked(cells) is not None


def _is_marked(cells: list[str]) -> bool:
    return len(cells) >= 6 and all(map(is_number, cells[:5]))


def _unmarked(cells: list[str]) -> tuple[str, int] | None:
    """Return name ("" if none) and index of the first coordinate of a row without a mark; None for other rows."""
    # Decimal numbers are coordinates. Names may be integers, and may be in the last column.
    if len(cells) == 4 and all(map(is_number, cells[1:])) and not (is_number(cells[0]) and "." in cells[0]):
        return cells[0], 1
    if len(cells) in (3, 4) and all(map(is_number, cells[:3])):
        return "".join(cells[3:]), 0
    return None


def read_gcp_list(path: Path, text: str) -> GivenControl:
    """Read control points and marks. Raise InputError for a first line that is not a coordinate system."""
    lines, system = _gcp_lines(text), ""
    if not _is_marked(lines[0][1].split()):
        first, system = lines.pop(0)
        system_of(system, f"{path.name}, row {first}")
    cells = Cells(path.name, [line.split() for _, line in lines], [row for row, _ in lines])
    if not cells.records:
        raise cells.none(f"no marks after {quoted(system.strip())}; add rows")
    points, marks, names = SurveyRows(path.name), list[Mark](), dict[str, str]()
    marked = _unmarked(cells.records[0]) is None
    for k, row in enumerate(cells.records):
        unmarked = None if marked else _unmarked(row)
        if unmarked is None and len(row) < 6:
            raise cells.bad(k, f"{len(row)} cells; write geo_x, geo_y, geo_z, im_x, im_y, image_name")
        name, first = unmarked or (row[6] if len(row) > 6 else "", 0)
        xyz = [cells.number(k, first, "geo_x"), cells.number(k, first + 1, "geo_y"), cells.height(k, first + 2)]
        # Points without names are called P1, P2 ..., one per position.
        name = name or names.setdefault(repr(xyz), f"P{len(names) + 1}")
        points.add(name, xyz, cells.place(k))
        if unmarked is None:
            column_row = [cells.number(k, 3, "im_x") + _FIRST_PX, cells.number(k, 4, "im_y") + _FIRST_PX]
            marks.append((row[5], name, column_row, np.nan, cells.place(k)))
    return GivenControl(points.surveyed(system.strip()), read_marks(marks))


CONTROL = (ControlFormat("gcp_list", "gcp_list.txt", _is_gcp_list, read_gcp_list),)
TABLES = ControlFormat("tables", "CSV, table of Metashape or Pix4D", lambda path, text: True, read_table)
"""Format of all text files that no other control format recognises."""
