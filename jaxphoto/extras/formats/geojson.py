"""GeoJSON of camera positions and object points, for a GIS: longitude, latitude and ellipsoidal height on WGS 84.

Source: RFC 7946.
"""

import json
from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.extras.formats.files import Format
from jaxphoto.extras.formats.project import Project
from jaxphoto.georeferencing.datum_change import wgs84_places


def write(p: Project, folder: Path) -> None:
    """Write stations.geojson and object_points.geojson."""
    frame = p.frame
    if frame.kind != "epsg" or frame.code is None:
        raise InputError("GeoJSON needs a map system, but the block is in a local frame; write opk")
    angles = np.rad2deg(np.asarray(p.in_map().exterior.omega_phi_kappa)).tolist()
    stations = [
        {"image": image, "file": file, "camera": camera, "omega_deg": omega, "phi_deg": phi, "kappa_deg": kappa}
        for image, file, camera, (omega, phi, kappa) in zip(p.images, p.files, p.image_camera, angles, strict=True)
    ]
    n_images = np.bincount(p.point, minlength=len(p.points)).tolist()
    points = [{"point": name, "n_images": n} for name, n in zip(p.points, n_images, strict=True)]
    for name, xyz, attributes in (("stations", p.exterior.position, stations), ("object_points", p.xyz, points)):
        places = wgs84_places(frame.code, frame.map.place(frame.map.map(np.asarray(xyz)))).tolist()
        features = [
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": place}, "properties": values}
            for place, values in zip(places, attributes, strict=True)
        ]
        text = json.dumps({"type": "FeatureCollection", "features": features}, indent=1)
        (folder / f"{name}.geojson").write_text(text + "\n", encoding="utf-8")


FORMATS = (
    Format(
        "geojson", "camera positions and points in longitude and latitude", write=write, endings=(".geojson",),
        lacks=("cameras", "image points"),
    ),
)  # fmt: skip
