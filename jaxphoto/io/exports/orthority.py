"""Adjusted photographs -> parameters of orthority, in map coordinates: int_param.yaml, ext_param.csv, ext_param.prj.

cx and cy are from the middle of the format, y down, over its longer side; coefficients are OpenCV's; angles are
docs/conventions.md's, in degrees.
Source: orthority documentation, "Orthority interior parameters" and "CSV exterior parameters"; orthority/camera.py.
"""

import csv
import json
from pathlib import Path

import numpy as np

from jaxphoto.camera import AbstractDistortion, Equidistant, OpenCv, OpenCvFisheye, Perspective
from jaxphoto.errors import InputError
from jaxphoto.io.cameras.camera_file import CameraModel
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, ExportCamera
from jaxphoto.io.exports.angles_text import angles_deg
from jaxphoto.io.exports.image_points import write_image_points
from jaxphoto.io.exports.map_photographs import in_map

PLANE = CameraModel(OpenCv, ("b2",), Perspective())
FISHEYE = CameraModel(OpenCvFisheye, ("p1", "p2", "s1", "s2", "b2"), Equidistant())
_BROWN = ("k1", "k2", "p1", "p2", "k3")
_RATIONAL = ("k4", "k5", "k6")


def write_orthority(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write the three files into `folder`, none of a system where the block is in a local frame, and image_points.csv
    beside them.

    Raises InputError for a block in a geographic system, where orthority counts metres.
    """
    p, on_map = photographs, in_map(photographs)
    if on_map.geographic:
        raise InputError(
            f"orthority counts metres, and the block is in {on_map.system}, in degrees; adjust it in a map system"
        )
    cameras = "".join(_camera(name, camera) for name, camera in p.cameras.items())
    (folder / "int_param.yaml").write_text(cameras, encoding="utf-8")
    values = np.hstack([np.asarray(on_map.exterior.position), angles_deg(on_map.exterior)])
    with (folder / "ext_param.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["filename", "x", "y", "z", "omega", "phi", "kappa", "camera"])
        for name, row, camera in zip(p.files, values.tolist(), p.image_camera, strict=True):
            table.writerow([name, *map(repr, row), camera])
    if on_map.system:
        (folder / "ext_param.prj").write_text(on_map.system + "\n", encoding="utf-8")
    write_image_points(p, folder)


def _camera(name: str, camera: ExportCamera) -> str:
    sensor, interior = camera
    d, c = interior.distortion, float(interior.c)
    longer_mm = max(sensor.width_mm, sensor.height_mm)
    kind, names = _model(d)
    focal = (c * (1 + float(getattr(d, "b1", 0.0))), c)
    values = {
        "type": kind,
        "im_size": f"[{sensor.width_px}, {sensor.height_px}]",
        "focal_len": f"[{', '.join(map(_number, focal))}]",
        "sensor_size": f"[{_number(sensor.width_mm)}, {_number(sensor.height_mm)}]",
        "cx": _number(float(interior.x_p) / longer_mm),
        "cy": _number(-float(interior.y_p) / longer_mm),
        **{k: _number(float(getattr(d, k))) for k in names},
    }
    return f"{json.dumps(name)}:\n" + "".join(f"  {key}: {text}\n" for key, text in values.items())


def _model(distortion: AbstractDistortion) -> tuple[str, tuple[str, ...]]:
    """The type of its camera, and the coefficients of that."""
    if isinstance(distortion, OpenCvFisheye):
        return "fisheye", ("k1", "k2", "k3", "k4")
    rational = any(float(getattr(distortion, k)) for k in _RATIONAL)
    return ("opencv", (*_BROWN, *_RATIONAL)) if rational else ("brown", _BROWN)


def _number(value: float) -> str:
    """A number that YAML 1.1 takes for one: with a point before the exponent."""
    digits, e, exponent = repr(float(value)).partition("e")
    return digits + ("" if "." in digits else ".0") + e + exponent
