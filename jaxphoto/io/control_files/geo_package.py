"""Control points in a GeoPackage: the one layer of points with an attribute that names them.

Source: OGC 12-128r18, GeoPackage Encoding Standard 1.3: tables of clause 1.1 and 2.1, geometry of 2.1.3.
"""

import contextlib
import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxphoto.errors import InputError, few, quoted
from jaxphoto.io.control_files.features import PointFeature, names_points, surveyed_features
from jaxphoto.io.text_tables import LARGEST
from jaxphoto.io.whole_text import LARGE, read_whole
from jaxphoto.procedures.control.surveyed import SurveyedPoints

_MAGIC = b"SQLite format 3\0"
# Where the header says how changes are logged: in files beside it, which memory has not, or not.
_JOURNAL = 18
# Bytes of the envelope of a geometry by its code, and coordinates of a point by its kind: plain, Z, M, Z and M.
_ENVELOPES = (0, 32, 48, 48, 64)
_POINTS = {1: 2, 1001: 3, 2001: 2, 3001: 3}
_LAYERS = """SELECT c.table_name, g.column_name, c.srs_id FROM gpkg_contents c
JOIN gpkg_geometry_columns g ON g.table_name = c.table_name WHERE c.data_type = 'features'
AND upper(g.geometry_type_name) IN ('POINT', 'GEOMETRY')"""
_SYSTEM = "SELECT organization, organization_coordsys_id FROM gpkg_spatial_ref_sys WHERE srs_id = ?"
# The undefined Cartesian system that every file has.
_CARTESIAN = -1


def recognises(path: Path) -> bool:
    """Whether a file is a database of SQLite, as a GeoPackage is."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read_geo_package(path: Path) -> SurveyedPoints:
    """The points of a file.

    Raises InputError for a file that is damaged or no GeoPackage, for no layer or several of points with names, for
    geometries that are no points, and what `surveyed_features` raises.
    """
    content, log = read_whole(path, LARGE), path.with_name(path.name + "-wal")
    if log.is_file() and log.stat().st_size:
        raise InputError(f"{path.name} is open in another program, which has not written all of it; close it there")
    try:
        # In memory: nothing is written beside a file that another program may have open.
        with contextlib.closing(sqlite3.connect(":memory:")) as file:
            file.deserialize(content[:_JOURNAL] + b"\1\1" + content[_JOURNAL + 2 :])
            file.text_factory = lambda text: text.decode("utf-8", "replace")
            return _read(path, file)
    # Names of columns and messages of a damaged file are not always text.
    except (sqlite3.Error, OverflowError, UnicodeDecodeError):
        raise InputError(f"{path.name} is no GeoPackage that can be read; export the layer anew") from None


def _read(path: Path, file: sqlite3.Connection) -> SurveyedPoints:
    layers = [(*layer, _columns(file, layer[0])) for layer in file.execute(_LAYERS)]
    named = [layer for layer in layers if names_points([name for name in layer[3] if name != layer[1]])]
    if len(named) != 1:
        told = f" ({few([quoted(layer[0]) for layer in named or layers])})" if layers else ""
        raise InputError(
            f"{path.name} has {len(named)} layers of points with an attribute point, name, label or id{told}; export "
            "the control points alone"
        )
    name, geometry, srs, columns = named[0]
    if geometry not in columns:
        raise InputError(
            f"{path.name}: layer {quoted(name)} has no column {quoted(geometry)}, where its geometries are said to be; "
            "export it anew"
        )
    place, kept = columns.index(geometry), [k for k, column in enumerate(columns) if column != geometry]
    features = [
        PointFeature(_point(path, k, row[place]), {columns[j]: row[j] for j in kept})
        for k, row in enumerate(file.execute(f"SELECT * FROM {_identifier(name)}"), 1)
    ]
    return surveyed_features(path.name, features, _system(path, file, srs))


def _columns(file: sqlite3.Connection, table: str) -> list[str]:
    return [column[0] for column in file.execute(f"SELECT * FROM {_identifier(table)} LIMIT 0").description]


def _identifier(name: str) -> str:
    return '"' + str(name).replace('"', '""') + '"'


def _system(path: Path, file: sqlite3.Connection, srs: Any) -> str:
    if srs == _CARTESIAN:
        return "local"
    found = file.execute(_SYSTEM, (srs,)).fetchone()
    if found is None or str(found[0]).upper() != "EPSG" or not isinstance(found[1], int):
        raise InputError(f"{path.name}: the layer is in no EPSG system; export it in one")
    return f"EPSG:{found[1]}"


def _point(path: Path, k: int, blob: Any) -> Sequence[float]:
    """Two coordinates or three of a geometry: its header, then well-known binary."""
    with contextlib.suppress(struct.error, LookupError, TypeError):
        if blob[:2] == b"GP":
            begin = 8 + _ENVELOPES[(blob[3] >> 1) & 7]
            order = "<" if blob[begin] == 1 else ">"
            many = _POINTS[struct.unpack_from(order + "I", blob, begin + 1)[0]] if len(blob) > begin + 4 else 0
            values = struct.unpack_from(f"{order}{many}d", blob, begin + 5)
            if many and all(abs(v) <= LARGEST for v in values):
                return values
    raise InputError(f"{path.name}, feature {k}: the geometry is no point; export a layer of points")
