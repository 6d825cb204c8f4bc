"""Control from one file or two: points, and where photographs show them."""

from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError, few
from jaxphoto.io.control_files.bingo import read_geoin
from jaxphoto.io.control_files.bingo import recognises as is_geoin
from jaxphoto.io.control_files.gcp_list import read_gcp_list
from jaxphoto.io.control_files.gcp_list import recognises as is_gcp_list
from jaxphoto.io.control_files.geo_json import read_geo_json
from jaxphoto.io.control_files.geo_json import recognises as is_geo_json
from jaxphoto.io.control_files.geo_package import read_geo_package
from jaxphoto.io.control_files.geo_package import recognises as is_geo_package
from jaxphoto.io.control_files.metashape import read_metashape_markers
from jaxphoto.io.control_files.metashape import recognises as is_metashape
from jaxphoto.io.control_files.tables import read_table
from jaxphoto.io.whole_text import SMALL, read_text
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints

FORMS = ("gcp_list.txt", "markers of Metashape", "GeoJSON", "GeoPackage", "geoin.dat of BINGO", "CSV", "table of Pix4D")
"""What `read_control` reads, in words."""


def is_control_file(path: Path) -> bool:
    """Whether a file says by its content that it is control: any form but a plain table."""
    if is_geo_package(path):
        return True
    try:
        text = read_text(path, SMALL)
    except InputError:
        return False
    lines = [line for line in text.split("\n") if line.strip()]
    return is_metashape(text) or is_geo_json(text) or (bool(lines) and (is_gcp_list(lines) or is_geoin(lines)))


def read_control(control: str | Path, marks: str | Path | None = None) -> GivenControl:
    """The points of the file `control` with the marks that it has, and those of the file `marks`.

    Forms are told apart by content: gcp_list.txt, Metashape's markers as XML, GeoJSON, a GeoPackage, BINGO's geoin.dat,
    tables of points or marks. A file `marks` may be any form that has marks; coordinates in it are not used. Raises
    InputError where either is none.
    """
    own = _read(Path(control))
    if isinstance(own, Marks):
        raise InputError(
            f"{Path(control).name} has marks but no coordinates; give it as the marks, and the points as well"
        )
    points, seen = (own.points, own.marks) if isinstance(own, GivenControl) else (own, Marks.none())
    if marks is not None:
        more = _read(Path(marks))
        if isinstance(more, SurveyedPoints):
            raise InputError(f"{Path(marks).name} has coordinates but no marks; give rows of image, point, x_px, y_px")
        seen = _joined(seen, more.marks if isinstance(more, GivenControl) else more)
    _check_known(points, seen)
    return GivenControl(points, seen)


def _read(path: Path) -> GivenControl | SurveyedPoints | Marks:
    if is_geo_package(path):
        return read_geo_package(path)
    text = read_text(path, SMALL)
    if is_metashape(text):
        return read_metashape_markers(path, text)
    if is_geo_json(text):
        return read_geo_json(path)
    numbered = [(line, row) for row, line in enumerate(text.split("\n"), 1) if line.strip()]
    lines, rows = [line for line, _ in numbered], [row for _, row in numbered]
    if not lines:
        raise InputError(f"{path.name}: the file is empty; give it points or marks")
    if is_gcp_list(lines):
        return read_gcp_list(path, lines, rows)
    if is_geoin(lines):
        return read_geoin(path, lines, rows)
    return read_table(path, lines, rows)


def _joined(one: Marks, other: Marks) -> Marks:
    """Both; what the second says of a point in an image counts."""
    again = set(zip(other.image, other.point, strict=True))
    keep = np.array([key not in again for key in zip(one.image, one.point, strict=True)], bool)
    return Marks.joined(one.take(keep), other)


def _check_known(points: SurveyedPoints, marks: Marks) -> None:
    known = set(points.ids)
    unknown = list(dict.fromkeys(name for name in marks.point if name not in known))
    if unknown and len(unknown) == len(set(marks.point)):
        raise InputError(
            f"{marks.places[0]}: no mark is of a point that {points.file} has ({few(unknown)}; there are "
            f"{few(points.ids)}); use the same names in both"
        )
