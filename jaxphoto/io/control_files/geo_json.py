"""Control points as GeoJSON.

    {"type": "FeatureCollection", "features": [{"geometry": {"type": "Point", "coordinates": [x, y, z]},
                                                "properties": {"name": ..., "role": ...}}]}

Longitude, latitude, height above the ellipsoid of WGS 84; or the system of a member "crs", which the format of 2008 had
and QGIS writes yet. Easting or longitude is first. Source: RFC 7946; The GeoJSON Format Specification (2008), 3.
"""

import re
from pathlib import Path
from typing import Any

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.control_files.features import PointFeature, surveyed_features
from jaxphoto.io.json_file import read_json
from jaxphoto.io.text_tables import LARGEST
from jaxphoto.procedures.control.surveyed import SurveyedPoints

_KIND = re.compile(r'"type"\s*:\s*"FeatureCollection"')
_EPSG, _CRS84 = re.compile(r"\bEPSG:(?:[\d.]*:)?(\d{4,6})$", re.IGNORECASE), re.compile(r"\bCRS84h?$")
_WGS84 = "EPSG:4326"


def recognises(text: str) -> bool:
    """Whether `text` is a collection of features."""
    return text.lstrip().startswith("{") and _KIND.search(text) is not None


def read_geo_json(path: Path) -> SurveyedPoints:
    """The points of a file. Raises InputError for geometries that are no points, and what `surveyed_features` does."""
    content = read_json(path)
    features = content.get("features")
    if not isinstance(features, list) or not features:
        raise InputError(f"{path.name}: there are no features; export the layer of the control points")
    return surveyed_features(
        path.name, [_feature(path, k, one) for k, one in enumerate(features, 1)], _system(path, content)
    )


def _feature(path: Path, k: int, feature: Any) -> PointFeature:
    own = feature if isinstance(feature, dict) else {}
    geometry, properties = own.get("geometry"), own.get("properties")
    place = geometry.get("coordinates") if isinstance(geometry, dict) and geometry.get("type") == "Point" else None
    numbers = isinstance(place, list) and 2 <= len(place) <= 4 and all(map(_is_number, place))
    if not numbers:
        raise InputError(
            f"{path.name}, feature {k}: the geometry is no point of finite coordinates; export a layer of points"
        )
    attributes = properties if isinstance(properties, dict) else {}
    if "id" in own and "id" not in attributes:
        attributes = {**attributes, "id": own["id"]}
    return PointFeature([float(v) for v in place[:3]], attributes)  # type: ignore[index]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _system(path: Path, content: dict[str, Any]) -> str:
    if content.get("crs") is None:
        return _WGS84
    crs = content["crs"]
    named = crs.get("properties") if isinstance(crs, dict) else None
    name = str(named.get("name")) if isinstance(named, dict) else ""
    if _CRS84.search(name):
        return _WGS84
    code = _EPSG.search(name)
    if code is None:
        raise InputError(
            f"{path.name}: the system {quoted(name)} is no EPSG code; export the layer in longitude and latitude or "
            "in an EPSG system"
        )
    return f"EPSG:{code[1]}"
