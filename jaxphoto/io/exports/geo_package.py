"""Adjusted photographs -> a GeoPackage with the layers stations, footprints and object_points, in the map system.

A GeoPackage is an SQLite file of few tables, and these features are points and polygons; the libraries that write it
bring the whole of GDAL for it once more.
Source: OGC 12-128r18, GeoPackage Encoding Standard 1.3: tables of clause 1.1 and 2.1, geometry of 2.1.3.
"""

import contextlib
import sqlite3
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.block import Frame
from jaxphoto.georeferencing.map_frame import map_system
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs
from jaxphoto.io.exports.map_features import map_features

FILE = "photographs.gpkg"
# "GPKG", and version 1.3.0.
_APPLICATION, _VERSION = 0x47504B47, 10300
# The systems that every file has: undefined Cartesian and geographic ones, and WGS 84.
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


def write_geo_package(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write photographs.gpkg into `folder`; a photograph of the horizon has no footprint."""
    p, told = photographs, map_features(photographs)
    on_map = (lambda local: p.frame.map.map(local)) if p.frame.kind == "epsg" else np.asarray
    n_images = np.bincount(p.point, minlength=len(p.points)).tolist()
    points = [{"point": name, "n_images": n} for name, n in zip(p.points, n_images, strict=True)]
    rings = [None if ring is None else on_map(ring) for ring in told.rings]
    with contextlib.closing(sqlite3.connect(folder / FILE)) as file, file:
        file.executescript(f"PRAGMA application_id = {_APPLICATION}; PRAGMA user_version = {_VERSION}; {_TABLES}")
        srs = _add_systems(file, p.frame)
        _add_layer(file, "stations", "POINT", srs, [at[None] for at in on_map(told.positions)], told.attributes)
        _add_layer(file, "footprints", "POLYGON", srs, rings, told.attributes)
        _add_layer(file, "object_points", "POINT", srs, [at[None] for at in on_map(p.xyz)], points)


def _add_systems(file: sqlite3.Connection, frame: Frame) -> int:
    """The table of systems; returns the id of the block's."""
    rows = [
        ("Undefined Cartesian SRS", _CARTESIAN, "NONE", _CARTESIAN, "undefined"),
        ("Undefined geographic SRS", _GEOGRAPHIC, "NONE", _GEOGRAPHIC, "undefined"),
    ]
    own = _CARTESIAN if frame.kind != "epsg" or frame.code is None else frame.code
    for code in dict.fromkeys((_WGS84, own)):
        if code > 0:
            system = map_system(code)
            rows.append((system.name, code, "EPSG", code, system.to_wkt("WKT1_GDAL")))
    file.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", rows)
    return own


def _add_layer(
    file: sqlite3.Connection,
    name: str,
    kind: str,
    srs: int,
    shapes: Sequence[np.ndarray | None],
    attributes: Sequence[dict[str, Any]],
) -> None:
    """A table of features: a point or one closed ring each, None for no geometry."""
    columns = attributes[0] if attributes else {}
    kinds = "".join(f", {column} {_KINDS[type(value)]}" for column, value in columns.items())
    file.execute(f"CREATE TABLE {name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom {kind}{kinds})")
    there = [shape for shape in shapes if shape is not None]
    corners = np.concatenate(there)[:, :2] if there else None
    bounds = (None,) * 4 if corners is None else (*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist())
    contents = "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id)"
    file.execute(f"{contents} VALUES (?, 'features', ?, ?, ?, ?, ?, ?)", (name, name, *bounds, srs))
    file.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 1, 0)", (name, kind, srs))
    marks = ", ".join("?" * (1 + len(columns)))
    rows = [
        (None if shape is None else _geometry(shape, kind, srs), *row.values())
        for shape, row in zip(shapes, attributes, strict=True)
    ]
    file.executemany(f"INSERT INTO {name} ({', '.join(('geom', *columns))}) VALUES ({marks})", rows)


def _geometry(shape: np.ndarray, kind: str, srs: int) -> bytes:
    """The blob of a point or ring: header without envelope, little-endian, then ISO well-known binary with Z."""
    coordinates = np.ascontiguousarray(shape, "<f8").tobytes()
    head = b"GP" + struct.pack("<BBi", 0, 1, srs)
    if kind == "POINT":
        return head + struct.pack("<BI", 1, _POINT_Z) + coordinates
    return head + struct.pack("<BIII", 1, _POLYGON_Z, 1, len(shape)) + coordinates
