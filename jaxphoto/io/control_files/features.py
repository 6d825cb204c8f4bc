"""Points of geographic information systems as control: a geometry and attributes each, which are called as columns of
tables are."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxphoto.errors import InputError, few
from jaxphoto.io.control_files.rows import Cells
from jaxphoto.io.control_files.table_header import feature_columns
from jaxphoto.io.control_files.tables import read_points
from jaxphoto.procedures.control.surveyed import SurveyedPoints

_XYZ = ("x", "y", "z")


class PointFeature(NamedTuple):
    """A point with two coordinates or three, easting or longitude first, and its attributes."""

    coordinates: Sequence[float]
    attributes: Mapping[str, Any]


def names_points(attributes: Sequence[str]) -> bool:
    """Whether one of the attributes of features is the name of a point, and none that of an image."""
    return feature_columns([*_XYZ, *attributes]) is not None


def surveyed_features(file: str, features: Sequence[PointFeature], system: str) -> SurveyedPoints:
    """The points of a file in the system that `system` names.

    A height is that of the geometry, else an attribute. Raises InputError where no attribute is the name of the points,
    and what a table with these columns raises.
    """
    if not features:
        raise InputError(f"{file}: there are no points in it; export them again")
    keys = list(dict.fromkeys(key for feature in features for key in feature.attributes))
    solid = any(len(feature.coordinates) > 2 for feature in features)
    header = [*_XYZ[: 3 if solid else 2], *keys]
    columns = feature_columns(header)
    if columns is None:
        found = f" (there are {few(keys)})" if keys else ""
        raise InputError(f"{file}: no attribute is the name of the points{found}; call it point, name, label or id")
    records = []
    for feature in features:
        place = [*map(repr, feature.coordinates), ""] if solid else list(map(repr, feature.coordinates))
        records.append([*place[: len(header) - len(keys)], *(_cell(feature.attributes.get(key)) for key in keys)])
    cells = Cells(file, records, list(range(1, len(records) + 1)), "feature")
    return read_points(cells, columns, ",", system, False)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return str(int(value)) if isinstance(value, bool) else str(value).strip()
