"""What columns of control tables mean, whoever wrote them: the words of their headers, units and case aside.

    ours         point, X_m, Y_m, Z_m, sigma_X_m, sigma_Y_m, sigma_Z_m, role       image, point, x_px, y_px, sigma_px
    Metashape    #Label, X/Easting, Y/Northing, Z/Altitude, Accuracy_X_(m), ... , Enable
    Pix4D        Label, Latitude, Longitude, Altitude, Accuracy Horz, Accuracy Vert
    Pix4D, none  label, coordinate 1, coordinate 2, z [, horizontal, vertical]     image, label, x, y [, accuracy]

Source: Agisoft Metashape User Manual, "Reference pane"; Pix4D documentation, "Tie points import format".
"""

import re
from collections.abc import Sequence

from jaxphoto.io.text_tables import is_number

PLACE = {
    "x": ("x", "easting", "east", "e", "longitude", "lon", "long"),
    "y": ("y", "northing", "north", "n", "latitude", "lat"),
    "z": ("z", "altitude", "height", "elevation", "h"),
    "sigma_x": ("sigma x", "accuracy x", "x accuracy", "x acc", "sigma", "accuracy"),
    "sigma_y": ("sigma y", "accuracy y", "y accuracy", "y acc"),
    "sigma_z": (
        "sigma z", "sigma vertical", "accuracy z", "z accuracy", "z acc", "accuracy vert", "accuracy vertical",
        "vertical accuracy",
    ),
    "sigma_plan": (
        "sigma plan", "sigma xy", "sigma horizontal", "accuracy xy", "accuracy x/y", "accuracy horz",
        "accuracy horizontal", "horizontal accuracy",
    ),
}  # fmt: skip
"""The words of coordinates and their standard deviations."""
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
# What features are called that are images, such as camera stations.
_OF_IMAGES = {"image", "image name", "filename"}
_PICTURE = re.compile(r"\.(jpe?g|tiff?|png|dng)$", re.IGNORECASE)
_UNIT = re.compile(r"\s*[\[(][^\])]*[\])]|\s+m$|\s+deg$")

# Characters of a word that means a column.
_LONGEST = 60

Columns = dict[str, int]
"""The place of each column by what it means."""


def point_columns(header: Sequence[str]) -> Columns | None:
    """Of a table of points; None where these are not the words of one."""
    found = columns_of(header, _POINT)
    return found if {"point", "x", "y"} <= set(found) and "image" not in columns_of(header, _MARK) else None


def feature_columns(header: Sequence[str]) -> Columns | None:
    """Of attributes of points that have a geometry: a photograph among them shows the point, and measures nothing."""
    found = columns_of(header, _POINT)
    return found if {"point", "x", "y"} <= set(found) and not _OF_IMAGES & set(map(str.lower, header)) else None


def mark_columns(header: Sequence[str]) -> Columns | None:
    """Of a table of marks."""
    found = columns_of(header, _MARK)
    return found if {"image", "point", "x", "y"} <= set(found) else None


def columns_without_header(records: Sequence[Sequence[str]]) -> tuple[str, Columns] | None:
    """Whether rows without a header, as Pix4D writes them, are "points" or "marks", and the columns; None for neither.

    The first cell of a mark is the name of a picture. More than half of the rows decide, so that what is wrong in the
    others is named; a first row without any number is a header that nobody knows.
    """
    width = {len(r) for r in records}
    if not any(map(is_number, records[0][1:])):
        return None
    marks = sum(bool(_PICTURE.search(r[0])) and all(map(is_number, r[2:])) for r in records)
    if width <= {4, 5} and 2 * marks > len(records):
        return "marks", dict(zip(("image", "point", "x", "y", "sigma"), range(max(width)), strict=False))
    points = sum(all(map(is_number, r[1:])) for r in records)
    if width <= {4, 6} and len(width) == 1 and 2 * points > len(records):
        names = ("point", "x", "y", "z", "sigma_plan", "sigma_z")
        return "points", dict(zip(names, range(max(width)), strict=False))
    return None


def in_degrees(header: Sequence[str], columns: Columns) -> bool:
    """Whether the header calls the first two coordinates longitude and latitude."""
    return {"longitude", "lon", "long", "latitude", "lat"} & set(_words(header[columns["x"]])) != set()


def columns_of(header: Sequence[str], known: dict[str, tuple[str, ...]]) -> Columns:
    """The first column whose words mean each; a column means one thing only."""
    words = [_words(cell) for cell in header]
    found: Columns = {}
    for meaning, names in known.items():
        for name in names:
            place = [k for k, own in enumerate(words) if name in own and k not in found.values()]
            if place:
                found[meaning] = place[0]
                break
    return found


def _words(cell: str) -> list[str]:
    """A cell of a header as a whole, without its unit, and its words on both sides of a stroke."""
    if len(cell) > _LONGEST:
        return []
    text = re.sub(r"[\s_]+", " ", cell.strip().lstrip("#").strip().lower())
    text = _UNIT.sub("", text).strip()
    return [text, *(text.split("/") if "accuracy" not in text else ())]
