"""Adjusted photographs -> transforms.json of nerfstudio, which instant-ngp and others read, too.

`transform_matrix` takes the camera's axes, x right, y up, z backwards, as ours, to the world, that of the block. The
centre of the upper left pixel is (0.5, 0.5), as ours.
Source: nerfstudio documentation, "Data conventions"; nerfstudio/cameras/camera_utils.py.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.camera import Equidistant, OpenCv, OpenCvFisheye, Perspective
from jaxphoto.errors import InputError
from jaxphoto.io.cameras.camera_file import CameraModel, from_centre_px
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, ExportCamera
from jaxphoto.io.exports.image_points import write_image_points

FILE = "transforms.json"
PLANE = CameraModel(OpenCv, ("k4", "k5", "k6", "b2"), Perspective())
FISHEYE = CameraModel(OpenCvFisheye, ("p1", "p2", "s1", "s2", "b2"), Equidistant())


def write_nerfstudio(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write transforms.json into `folder`: cameras at the top where there is one, else with every frame; and
    image_points.csv beside it.

    Raises InputError for perspective cameras and fisheyes in one block.
    """
    p = photographs
    cameras = {name: _camera(camera) for name, camera in p.cameras.items()}
    kinds = {camera.pop("camera_model") for camera in cameras.values()}
    if len(kinds) != 1:
        raise InputError("transforms.json is of cameras of one kind, and the block has fisheyes beside others")
    shared = next(iter(cameras.values())) if len(cameras) == 1 else {}
    frames = []
    for i, file in enumerate(p.files):
        pose = np.column_stack([np.asarray(p.exterior.camera_from_object[i]).T, np.asarray(p.exterior.position[i])])
        matrix = [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
        own = {} if shared else cameras[p.image_camera[i]]
        frames.append({"file_path": file, **own, "transform_matrix": matrix})
    content = {"camera_model": kinds.pop(), **shared, "frames": frames}
    (folder / FILE).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    write_image_points(p, folder)


def _camera(camera: ExportCamera) -> dict[str, Any]:
    sensor, interior = camera
    fx, fy, column, row = from_centre_px(interior, sensor)
    d = interior.distortion
    fisheye = isinstance(d, OpenCvFisheye)
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3", "p1", "p2")
    return {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV",
        "fl_x": fx, "fl_y": fy, "cx": column, "cy": row, "w": sensor.width_px, "h": sensor.height_px,
        **{name: float(getattr(d, name)) for name in names},
    }  # fmt: skip
