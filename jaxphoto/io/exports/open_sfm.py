"""Adjusted photographs -> a reconstruction of OpenSfM, as WebODM has it, too.

Image coordinates are from the middle of the format, y down, over its longer side; a shot's rotation (axis times angle)
and translation take the world to axes x right, y down, z ahead. The world of a block on WGS 84 is OpenSfM's own: the
east-north-up frame at reference_lla.
Source: OpenSfM documentation, "Geometric Models" and "Reconstruction file format"; opensfm/io.py, opensfm/geo.py.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from jaxphoto.camera import Equidistant, OpenCv, OpenCvFisheye, Perspective, Sensor
from jaxphoto.io.cameras.camera_file import CameraModel
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, ExportCamera, downwards, translations
from jaxphoto.io.exports.gcp_list import write_gcp_list

PLANE = CameraModel(OpenCv, ("k4", "k5", "k6", "b2"), Perspective())
FISHEYE = CameraModel(OpenCvFisheye, ("p1", "p2", "s1", "s2", "b2"), Equidistant())
"""Its cameras `brown` and `fisheye_opencv`."""
_COLOUR = [0.0, 0.0, 0.0]


def write_open_sfm(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write reconstruction.json, camera_models.json, tracks.csv and, on WGS 84, reference_lla.json into `folder`; of
    control on a map also gcp_list.txt."""
    p = photographs
    rotations = downwards(p.exterior)
    turns, moved = (
        scipy.spatial.transform.Rotation.from_matrix(rotations).as_rotvec(),
        translations(rotations, p.exterior),
    )
    cameras = {name: _camera(camera) for name, camera in p.cameras.items()}
    shots = {
        file: {"rotation": turns[i].tolist(), "translation": moved[i].tolist(), "camera": p.image_camera[i]}
        for i, file in enumerate(p.files)
    }
    points = {name: {"color": _COLOUR, "coordinates": at} for name, at in zip(p.points, p.xyz.tolist(), strict=True)}
    reconstruction: dict[str, Any] = {"cameras": cameras, "shots": shots, "points": points}
    if p.place is not None:
        longitude, latitude, height = p.place
        reconstruction["reference_lla"] = {"latitude": latitude, "longitude": longitude, "altitude": height}
        _write(folder / "reference_lla.json", reconstruction["reference_lla"])
    _write(folder / "reconstruction.json", [reconstruction])
    _write(folder / "camera_models.json", cameras)
    (folder / "tracks.csv").write_text(_tracks(p), encoding="utf-8")
    write_gcp_list(p, folder)


def normalised(sensor: Sensor, column_row: np.ndarray) -> np.ndarray:
    """Normalised image coordinates of pixels (of conventions.md)."""
    return (column_row - np.array([sensor.width_px, sensor.height_px]) / 2) / max(sensor.width_px, sensor.height_px)


def _camera(camera: ExportCamera) -> dict[str, Any]:
    sensor, interior = camera
    d, longer_mm = interior.distortion, max(sensor.width_mm, sensor.height_mm)
    focal = float(interior.c) / longer_mm
    fisheye = isinstance(d, OpenCvFisheye)
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return {
        "projection_type": "fisheye_opencv" if fisheye else "brown",
        "width": sensor.width_px,
        "height": sensor.height_px,
        "focal_x": focal * (1 + float(getattr(d, "b1", 0.0))),
        "focal_y": focal,
        "c_x": float(interior.x_p) / longer_mm,
        "c_y": -float(interior.y_p) / longer_mm,
        **{name: float(getattr(d, name)) for name in names},
    }


def _tracks(p: AdjustedPhotographs) -> str:
    """Image, track, feature, x, y and colour of every image point: the first version of the file, without a header."""
    colour = "\t".join(str(int(c)) for c in _COLOUR)
    lines = []
    for i, rows in enumerate(p.rows_of_images):
        xy = normalised(p.cameras[p.image_camera[i]].sensor, p.column_row[rows]).tolist()
        for feature, ((x, y), point) in enumerate(zip(xy, p.point[rows].tolist(), strict=True)):
            lines.append(f"{p.files[i]}\t{p.points[point]}\t{feature}\t{x!r}\t{y!r}\t{colour}\n")
    return "".join(lines)


def _write(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
