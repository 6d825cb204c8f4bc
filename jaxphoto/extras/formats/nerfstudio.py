"""transforms.json of nerfstudio and instant-ngp, with image points beside it.

    camera_model, w, h, fl_x, fl_y, cx, cy, k1 ...      at the top, or with each of
    frames          file_path, transform_matrix: 4 x 4, from x right, y up, z backwards of the camera to the world

Pixels are ours. `applied_transform` and `applied_scale` are in the matrices already. Of OpenCV's terms k4 is a further
radial one, which is not read.
Source: nerfstudio documentation, "Data conventions"; nerfstudio/cameras/camera_utils.py.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.camera_models import (
    BROWN,
    BROWN_TERMS,
    FISHEYE_TERMS,
    OPENCV,
    OPENCV_FISHEYE,
    CameraModel,
    ProjectCamera,
    in_pixels,
    pixels_of,
)
from jaxphoto.extras.formats.files import Format, by_content, number_rows, read_json
from jaxphoto.extras.formats.points_beside import points_beside, write_image_points
from jaxphoto.extras.formats.project import Project
from jaxphoto.extras.formats.texts import oriented_project
from jaxphoto.io.camera_files import CameraSource
from jaxphoto.io.text_files import has_words
from jaxphoto.io.toml import Section

FILE = "transforms.json"
_KINDS: dict[str, tuple[CameraModel, tuple[str, ...]]] = {
    "OPENCV": (OPENCV, BROWN_TERMS),
    "PINHOLE": (OPENCV, ()),
    "SIMPLE_PINHOLE": (OPENCV, ()),
    "OPENCV_FISHEYE": (OPENCV_FISHEYE, FISHEYE_TERMS),
}
_TERMS = (*BROWN_TERMS, "k4")
_OF_CAMERA = ("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", *_TERMS, "camera_angle_x", "is_fisheye")


def _is_transforms(path: Path) -> bool:
    return path.name == FILE or (path.suffix == ".json" and has_words(path, '"frames"', '"transform_matrix"'))


def read(path: Path) -> Project:
    """Read frames; those of the same values have one camera, free in c, xp, yp and coefficients that are not zero."""
    content = read_json(path)
    frames = content["frames"]
    files = [Section(path.name, f"frames.{k}", frame).text("file_path") for k, frame in enumerate(frames)]
    shared = {key: content[key] for key in _OF_CAMERA if key in content}
    values = [shared | {key: frame[key] for key in _OF_CAMERA if key in frame} for frame in frames]
    first = {json.dumps(camera): k for k, camera in reversed(list(enumerate(values)))}
    names = {text: str(number) for number, text in enumerate(reversed(first))}
    cameras = {names[text]: _camera(path, f"frames.{k}", values[k]) for text, k in first.items()}
    camera_of = [names[json.dumps(camera)] for camera in values]
    matrices = [frame.get("transform_matrix") for frame in frames]
    poses = number_rows(matrices, (4, 4), lambda k: f"{path.name}, frame {quoted(files[k])}, transform_matrix")
    shown = points_beside(path, files, [cameras[name] for name in camera_of])
    exterior = ExteriorOrientation(poses[:, :3, 3], np.swapaxes(poses[:, :3, :3], 1, 2))  # type: ignore[arg-type]
    return oriented_project(path, cameras, files, camera_of, exterior, shown)


def _camera(path: Path, place: str, values: dict[str, Any]) -> ProjectCamera:
    section, source = Section(path.name, place, values), CameraSource(path)
    # instant-ngp names no kind.
    kind = section.text("camera_model", "OPENCV_FISHEYE" if values.get("is_fisheye") is True else "OPENCV")
    if kind not in _KINDS:
        raise section.error("camera_model", f"{quoted(kind)} is not known here; known are {', '.join(_KINDS)}")
    model, coefficients = _KINDS[kind]
    for name in _TERMS:
        if name not in coefficients and section.number(name, 0.0) != 0:
            raise section.error(name, f"cameras of kind {kind} have no such term here; calibrate without it")
    if not ("w" in section and "h" in section):
        raise InputError(f"{path.name} does not say how large its photographs are. Add w and h (pixels)")
    width, height = section.number("w"), section.number("h")
    sensor, _ = source.sensor(width, height)
    if "fl_x" not in section and "camera_angle_x" in section:
        fx = float(width / 2 / np.tan(section.positive("camera_angle_x") / 2))
    else:
        fx = section.positive("fl_x")
    fy, centre = section.number("fl_y", fx), (section.number("cx", width / 2), section.number("cy", height / 2))
    terms = {name: section.number(name, 0.0) for name in coefficients}
    return ProjectCamera.estimated(sensor, in_pixels(source, sensor, fx, fy, centre, model, **terms))


def write(p: Project, folder: Path) -> None:
    """Write transforms.json, cameras at the top if there is one, else with every frame; and image_points.csv."""
    cameras = {name: _written(camera) for name, camera in p.cameras.items()}
    kinds = {camera.pop("camera_model") for camera in cameras.values()}
    if len(kinds) != 1:
        raise InputError("transforms.json is of cameras of one kind, and the block has fisheyes beside others")
    shared = next(iter(cameras.values())) if len(cameras) == 1 else {}
    frames = []
    for i, file in enumerate(p.files):
        matrix = np.eye(4)
        matrix[:3] = np.column_stack([np.asarray(p.exterior.camera_from_object[i]).T, p.exterior.position[i]])
        camera = {} if shared else cameras[p.image_camera[i]]
        frames.append({"file_path": file, **camera, "transform_matrix": matrix.tolist()})
    content = {"camera_model": kinds.pop(), **shared, "frames": frames}
    (folder / FILE).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    write_image_points(p, folder)


def _written(camera: ProjectCamera) -> dict[str, Any]:
    fx, fy, column, row = pixels_of(camera.interior, camera.sensor)
    fisheye = type(camera.interior.distortion) is OPENCV_FISHEYE.distortion
    return {
        "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV", "fl_x": fx, "fl_y": fy, "cx": column, "cy": row,
        "w": camera.sensor.width_px, "h": camera.sensor.height_px,
        **camera.terms(FISHEYE_TERMS if fisheye else BROWN_TERMS),
    }  # fmt: skip


FORMATS = (
    Format(
        "nerfstudio", "transforms.json of nerfstudio", by_content(FILE, _is_transforms), read, write=write, plane=BROWN,
        fisheye=OPENCV_FISHEYE, endings=(".json", ".csv"), lacks=("points",),
    ),
)  # fmt: skip
