"""GeoJSON and GeoPackage: stations, footprints and object points to a GIS, control points from it.

GeoJSON is in longitude, latitude, height above the ellipsoid of WGS 84; files of 2008 and of QGIS may name another
system in a member "crs". Easting or longitude is first, rings are counter-clockwise. A GeoPackage is an SQLite file of
few tables. Control points are features whose attributes are named as the columns of tables of points. Sources: RFC
7946; The GeoJSON Format Specification (2008), 3; OGC 12-128r18, GeoPackage Encoding Standard 1.3: tables of clause 1.1
and 2.1, geometry of 2.1.3.
"""

import contextlib
import json
import re
import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxphoto.arrays import to_numpy
from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation, image_ray
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.extras.formats.control import point_attributes, read_points
from jaxphoto.extras.formats.files import ControlFormat, Format
from jaxphoto.extras.formats.project import Project
from jaxphoto.extras.formats.texts import angles_deg
from jaxphoto.georeferencing.datum_change import wgs84_places
from jaxphoto.georeferencing.map_frame import map_system
from jaxphoto.io.control_table import Cells
from jaxphoto.io.text_files import read_bytes, read_json
from jaxphoto.io.text_tables import LARGEST
from jaxphoto.procedures.control.surveyed import SurveyedPoints

PACKAGE = "photographs.gpkg"
# Points along each side of the format, whose image on the ground is bent.
_ALONG = 8
# A ray longer than so many flying heights is taken for one to the horizon.
_FARTHEST = 20.0
_APPLICATION, _VERSION = 0x47504B47, 10300  # "GPKG", 1.3.0
# Ids of systems: undefined Cartesian and geographic ones, and WGS 84.
_CARTESIAN, _GEOGRAPHIC, _WGS84 = -1, 0, 4326
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""
_KINDS = {str: "TEXT", float: "DOUBLE", int: "INTEGER"}
_POINT_Z, _POLYGON_Z = 1001, 1003
_MAGIC = b"SQLite format 3\0"
# Byte of the header that says whether changes are logged in a file beside.
_JOURNAL = 18
# Bytes of the envelope of a geometry by its code, and coordinates of a point by its kind.
_ENVELOPES, _POINTS = (0, 32, 48, 48, 64), {1: 2, 1001: 3, 2001: 2, 3001: 3}
_LAYERS = """SELECT c.table_name, g.column_name, c.srs_id FROM gpkg_contents c
JOIN gpkg_geometry_columns g ON g.table_name = c.table_name WHERE c.data_type = 'features'
AND upper(g.geometry_type_name) IN ('POINT', 'GEOMETRY')"""
_SRS = "SELECT organization, organization_coordsys_id FROM gpkg_spatial_ref_sys WHERE srs_id = ?"
_COLLECTION = re.compile(r'"type"\s*:\s*"FeatureCollection"')
_EPSG, _CRS84 = re.compile(r"\bEPSG:(?:[\d.]*:)?(\d{4,6})$", re.IGNORECASE), re.compile(r"\bCRS84h?$")


# Written ------------------------------------------------------------------------------------------------------


class _Features(NamedTuple):
    """One entry an image; positions and rings in the block's frame."""

    positions: np.ndarray
    rings: list[np.ndarray | None]
    """Closed; None for an image of the horizon."""
    attributes: list[dict[str, Any]]


def _features(p: Project) -> _Features:
    names = ("omega_deg", "phi_deg", "kappa_deg")
    angles = angles_deg(p.in_map().exterior).tolist()
    attributes = [
        {"image": p.images[i], "file": p.files[i], "camera": p.image_camera[i]}
        | dict(zip(names, angles[i], strict=True))
        | {"n_image_points": len(rows)}
        for i, rows in enumerate(p.rows_of_images)
    ]
    rings = [None if ring is None else np.vstack([ring, ring[:1]]) for ring in footprints(p)]
    return _Features(np.asarray(p.exterior.position), rings, attributes)


def footprints(p: Project) -> list[Float[np.ndarray, "n 3"] | None]:
    """Return the border of each image on the mean height of its points, counter-clockwise; None at the horizon."""
    xyz = np.asarray(p.xyz)
    mean_height = float(np.mean(xyz[:, 2])) if len(xyz) else 0.0
    rings = []
    for i, rows in enumerate(p.rows_of_images):
        sensor, interior, _ = p.cameras[p.image_camera[i]]
        ground = float(np.mean(xyz[p.point[rows], 2])) if len(rows) else mean_height
        t, half = np.arange(_ALONG) / _ALONG - 0.5, np.full(_ALONG, 0.5)
        sides = [np.stack(side, axis=1) for side in ((t, -half), (half, t), (-t, half), (-half, -t))]
        border = np.concatenate(sides) * [sensor.width_mm, sensor.height_mm]
        exterior = ExteriorOrientation(p.exterior.position[i], p.exterior.camera_from_object[i])
        directions = to_numpy(call_compiled(_directions, interior, exterior, border))
        rings.append(_on_ground(to_numpy(exterior.position), directions, ground))
    return rings


@eqx.filter_jit
def _directions(interior: InteriorOrientation, exterior: ExteriorOrientation, xy: Float[Array, "n 2"]):
    return jax.vmap(lambda one: image_ray(interior, exterior, one)[1])(xy)


def _on_ground(position: np.ndarray, directions: np.ndarray, ground: float) -> np.ndarray | None:
    above = position[2] - ground
    with np.errstate(divide="ignore", invalid="ignore"):
        length = -above / directions[:, 2]
    if not (above > 0 and np.all((length > 0) & (length < _FARTHEST * above))):
        return None
    ring = position + length[:, None] * directions
    x, y = (ring - position)[:, :2].T
    return ring if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0 else ring[::-1]


def write_geojson(p: Project, folder: Path) -> None:
    """Write stations.geojson and footprints.geojson."""
    frame = p.frame
    if frame.kind != "epsg" or frame.code is None:
        raise InputError("GeoJSON is in longitude and latitude, and the block is in a local frame; write a GeoPackage")
    features = _features(p)
    places = lambda local: wgs84_places(frame.code, frame.map.place(frame.map.map(local)))  # type: ignore[arg-type]  # noqa: E731
    points = [{"type": "Point", "coordinates": at} for at in places(features.positions).tolist()]
    polygons = [
        None if ring is None else {"type": "Polygon", "coordinates": [places(ring)[:, :2].tolist()]}
        for ring in features.rings
    ]
    for name, geometries in (("stations", points), ("footprints", polygons)):
        collection = [
            {"type": "Feature", "geometry": geometry, "properties": attributes}
            for geometry, attributes in zip(geometries, features.attributes, strict=True)
        ]
        text = json.dumps({"type": "FeatureCollection", "features": collection}, indent=1)
        (folder / f"{name}.geojson").write_text(text + "\n", encoding="utf-8")


def write_geopackage(p: Project, folder: Path) -> None:
    """Write photographs.gpkg with the layers stations, footprints and object_points, in the map system."""
    features = _features(p)
    on_map = (lambda local: p.frame.map.map(local)) if p.frame.kind == "epsg" else np.asarray
    n_images = np.bincount(p.point, minlength=len(p.points)).tolist()
    points = [{"point": name, "n_images": n} for name, n in zip(p.points, n_images, strict=True)]
    rings = [None if ring is None else on_map(ring) for ring in features.rings]
    srs = _CARTESIAN if p.frame.kind != "epsg" or p.frame.code is None else p.frame.code
    systems: list[tuple[Any, ...]] = [
        (f"Undefined {name} SRS", number, "NONE", number, "undefined")
        for name, number in (("Cartesian", _CARTESIAN), ("geographic", _GEOGRAPHIC))
    ]
    for code in {_WGS84, srs} - {_CARTESIAN}:
        systems.append((map_system(code).name, code, "EPSG", code, map_system(code).to_wkt("WKT1_GDAL")))
    with contextlib.closing(sqlite3.connect(folder / PACKAGE)) as file, file:
        file.executescript(f"PRAGMA application_id = {_APPLICATION}; PRAGMA user_version = {_VERSION}; {_TABLES}")
        file.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", systems)
        _add_layer(file, "stations", "POINT", srs, list(on_map(features.positions)[:, None]), features.attributes)
        _add_layer(file, "footprints", "POLYGON", srs, rings, features.attributes)
        _add_layer(file, "object_points", "POINT", srs, list(on_map(np.asarray(p.xyz))[:, None]), points)


def _add_layer(
    file: sqlite3.Connection,
    name: str,
    kind: str,
    srs: int,
    shapes: Sequence[np.ndarray | None],
    attributes: Sequence[dict[str, Any]],
) -> None:
    """Add a table of points or closed rings, None for no geometry."""
    columns = attributes[0] if attributes else {}
    kinds = "".join(f", {column} {_KINDS[type(value)]}" for column, value in columns.items())
    file.execute(f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {kind}{kinds})")
    there = [shape[:, :2] for shape in shapes if shape is not None]
    xy = np.concatenate(there) if there else None
    bounds = (None,) * 4 if xy is None else (*xy.min(axis=0).tolist(), *xy.max(axis=0).tolist())
    contents = "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id)"
    file.execute(f"{contents} VALUES (?, 'features', ?, ?, ?, ?, ?, ?)", (name, name, *bounds, srs))
    file.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 1, 0)", (name, kind, srs))
    marks = ", ".join("?" * (1 + len(columns)))
    rows = [
        (None if shape is None else _blob(shape, kind, srs), *row.values())
        for shape, row in zip(shapes, attributes, strict=True)
    ]
    file.executemany(f"INSERT INTO {name} ({', '.join(('geom', *columns))}) VALUES ({marks})", rows)


def _blob(shape: np.ndarray, kind: str, srs: int) -> bytes:
    """Header without envelope, little-endian, then ISO well-known binary with Z."""
    head = b"GP" + struct.pack("<BBi", 0, 1, srs)
    point, polygon = struct.pack("<BI", 1, _POINT_Z), struct.pack("<BIII", 1, _POLYGON_Z, 1, len(shape))
    return head + (point if kind == "POINT" else polygon) + np.ascontiguousarray(shape, "<f8").tobytes()


# Control ------------------------------------------------------------------------------------------------------


def _surveyed(file: str, features: Sequence[tuple[Sequence[float], dict[str, Any]]], system: str) -> SurveyedPoints:
    """The points of features, each coordinates and attributes; a height is that of the geometry, else an attribute."""
    keys = list(dict.fromkeys(key for _, attributes in features for key in attributes))
    solid = any(len(coordinates) > 2 for coordinates, _ in features)
    header = [*("xyz" if solid else "xy"), *keys]
    columns = point_attributes(header)
    if columns is None:
        names = f" (there are {few(keys)})" if keys else ""
        raise InputError(f"{file}: no attribute is the name of the points{names}; call it point, name, label or id")
    records = []
    for coordinates, attributes in features:
        place = [*map(repr, coordinates), ""][: len(header) - len(keys)]
        values = [attributes.get(key) for key in keys]
        cells = ["" if v is None else str(int(v) if isinstance(v, bool) else v).strip() for v in values]
        records.append([*place, *cells])
    cells_of = Cells(file, records, list(range(1, len(records) + 1)), "feature")
    return read_points(cells_of, columns, ",", system, False)


def read_geojson(path: Path, text: str) -> SurveyedPoints:
    """Read the points of a collection of features."""
    content = read_json(path)
    features = content.get("features")
    if not isinstance(features, list) or not features:
        raise InputError(f"{path.name}: there are no features; export the layer of the control points")
    points = [_point_feature(path, k, feature) for k, feature in enumerate(features, 1)]
    return _surveyed(path.name, points, _geojson_system(path, content))


def _point_feature(path: Path, k: int, feature: Any) -> tuple[list[float], dict[str, Any]]:
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    place = geometry.get("coordinates") if isinstance(geometry, dict) and geometry.get("type") == "Point" else None
    coordinates = place if isinstance(place, list) else []
    numbers = all(isinstance(v, int | float) and abs(v) <= LARGEST for v in coordinates)
    if not numbers or not 2 <= len(coordinates) <= 4:
        raise InputError(f"{path.name}, feature {k}: the geometry is no point. Export a layer of points")
    attributes = feature.get("properties") or {}
    return [float(v) for v in coordinates[:3]], ({"id": feature["id"]} if "id" in feature else {}) | attributes


def _geojson_system(path: Path, content: dict[str, Any]) -> str:
    if content.get("crs") is None:
        return f"EPSG:{_WGS84}"
    name = str(content["crs"]["properties"]["name"])
    code = _EPSG.search(name)
    if code is None and not _CRS84.search(name):
        raise InputError(f"{path.name}: the system {quoted(name)} is no EPSG code")
    return f"EPSG:{code[1] if code else _WGS84}"


def is_geopackage(path: Path) -> bool:
    """Return True if a file is a database of SQLite."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_MAGIC)) == _MAGIC


def read_geopackage(path: Path, text: str) -> SurveyedPoints:
    """Read the one layer of points with an attribute that names them."""
    content, log = read_bytes(path), path.with_name(path.name + "-wal")
    if log.is_file() and log.stat().st_size:
        raise InputError(f"{path.name} is open in another program, which has not written all of it; close it there")
    try:
        # In memory, as nothing must be written beside a file that may be open elsewhere.
        with contextlib.closing(sqlite3.connect(":memory:")) as file:
            file.deserialize(content[:_JOURNAL] + b"\1\1" + content[_JOURNAL + 2 :])
            file.text_factory = lambda text: text.decode("utf-8", "replace")
            return _read_layer(path, file)
    except (sqlite3.Error, OverflowError, UnicodeDecodeError):
        raise InputError(f"{path.name} is no GeoPackage that can be read; export the layer again") from None


def _read_layer(path: Path, file: sqlite3.Connection) -> SurveyedPoints:
    identifier = lambda name: '"' + str(name).replace('"', '""') + '"'  # noqa: E731
    layers = []
    for name, geometry, srs in file.execute(_LAYERS).fetchall():
        columns = [c[0] for c in file.execute(f"SELECT * FROM {identifier(name)} LIMIT 0").description]
        if point_attributes(["x", "y", *(c for c in columns if c != geometry)]) is not None:
            layers.append((name, geometry, srs, columns))
    if len(layers) != 1:
        raise InputError(f"{path.name} has {len(layers)} layers of points with an attribute point, name, label or id")
    ((name, geometry, srs, columns),) = layers
    if geometry not in columns:
        raise InputError(f"{path.name}: layer {quoted(name)} has no column {quoted(geometry)}; export it again")
    at = columns.index(geometry)
    features = [
        (_coordinates(path, k, row[at]), {c: row[j] for j, c in enumerate(columns) if j != at})
        for k, row in enumerate(file.execute(f"SELECT * FROM {identifier(name)}"), 1)
    ]
    if srs == _CARTESIAN:
        return _surveyed(path.name, features, "local")
    system = file.execute(_SRS, (srs,)).fetchone()
    if system is None or str(system[0]).upper() != "EPSG" or not isinstance(system[1], int):
        raise InputError(f"{path.name}: the layer is in no EPSG system; export it in one")
    return _surveyed(path.name, features, f"EPSG:{system[1]}")


def _coordinates(path: Path, k: int, blob: Any) -> Sequence[float]:
    with contextlib.suppress(struct.error, LookupError, TypeError):
        if blob[:2] == b"GP":
            begin = 8 + _ENVELOPES[(blob[3] >> 1) & 7]
            order = "<" if blob[begin] == 1 else ">"
            many = _POINTS[struct.unpack_from(order + "I", blob, begin + 1)[0]]
            values = struct.unpack_from(f"{order}{many}d", blob, begin + 5)
            if all(abs(v) <= LARGEST for v in values):
                return values
    raise InputError(f"{path.name}, feature {k}: the geometry is no point; export a layer of points")


FORMATS = (
    Format(
        "geojson", "stations and footprints in longitude and latitude", write=write_geojson, endings=(".geojson",),
        lacks=("cameras", "points", "image points"),
    ),
    Format(
        "geopackage", "stations, footprints and points for a GIS", write=write_geopackage, endings=(".gpkg",),
        lacks=("cameras", "image points"),
    ),
)  # fmt: skip
CONTROL = (
    ControlFormat(
        "geo_json", "GeoJSON", lambda _, text: text.lstrip().startswith("{") and _COLLECTION.search(text) is not None,
        read_geojson,
    ),
    ControlFormat("geo_package", "GeoPackage", lambda path, _: is_geopackage(path), read_geopackage),
)  # fmt: skip
