"""Adjusted photographs -> GeoJSON of stations and footprints, in longitude and latitude of WGS 84.

Source: RFC 7946: positions are longitude, latitude, height above the ellipsoid; rings counter-clockwise.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.block import Frame
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.datum_change import wgs84_places
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs
from jaxphoto.io.exports.map_features import map_features


def write_geo_json(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write stations.geojson and footprints.geojson into `folder`; a photograph of the horizon has no footprint.

    Raises InputError for a block in a frame of its own, which lies nowhere on the earth.
    """
    frame = photographs.frame
    if frame.kind != "epsg":
        raise InputError("GeoJSON is in longitude and latitude, and the block is in a local frame; write a GeoPackage")
    told = map_features(photographs)
    stations = [
        _feature({"type": "Point", "coordinates": at}, attributes)
        for at, attributes in zip(_places(frame, told.positions).tolist(), told.attributes, strict=True)
    ]
    rings = [None if ring is None else _places(frame, ring)[:, :2].tolist() for ring in told.rings]
    polygons = [None if ring is None else {"type": "Polygon", "coordinates": [ring]} for ring in rings]
    footprints = [_feature(polygon, a) for polygon, a in zip(polygons, told.attributes, strict=True)]
    for name, collection in (("stations", stations), ("footprints", footprints)):
        text = json.dumps({"type": "FeatureCollection", "features": collection}, indent=1)
        (folder / f"{name}.geojson").write_text(text + "\n", encoding="utf-8")


def _feature(geometry: dict[str, Any] | None, attributes: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": attributes}


def _places(frame: Frame, local: np.ndarray) -> np.ndarray:
    """Longitude, latitude (degrees) and ellipsoidal height (m) on WGS 84, as PROJ knows the way from the datum."""
    assert frame.code is not None
    return wgs84_places(frame.code, frame.map.place(frame.map.map(local)))
