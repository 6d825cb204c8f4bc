"""Adjusted photographs -> sfm_data.json of OpenMVG, with structure, as `jaxphoto.io.reconstructions.open_mvg` reads it.

Objects are wrapped as cereal wraps them: the first of a kind tells its name with its number, and each object has a
number of its own. Source: openMVG/sfm/sfm_data_io_cereal.cpp, sfm_view_io.hpp, openMVG/cameras/Camera_*_io.hpp.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.camera import Equidistant, OpenCv, OpenCvFisheye, Perspective
from jaxphoto.io.cameras.camera_file import CameraModel, from_centre_px
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, ExportCamera, downwards, numbered
from jaxphoto.io.reconstructions.open_mvg import FILE, FIRST_PX, KINDS, NEW

PLANE = CameraModel(OpenCv, ("k4", "k5", "k6", "b1", "b2"), Perspective())
FISHEYE = CameraModel(OpenCvFisheye, ("p1", "p2", "s1", "s2", "b1", "b2"), Equidistant())
_VERSION = "0.3"
# The number of an object of the very kind that was declared.
_AS_DECLARED = 0x40000000


def write_open_mvg(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write sfm_data.json into `folder`; points whose ids are numbers keep them, others are counted from 1."""
    p = photographs
    camera_of = {name: k for k, name in enumerate(p.cameras)}
    cameras = [_camera(camera) for camera in p.cameras.values()]
    kinds = {kind: k for k, kind in enumerate(dict.fromkeys(kind for kind, _ in cameras), 1)}
    told: set[str] = set()
    intrinsics, views = [], []
    for k, (kind, values) in enumerate(cameras):
        named = {} if kind in told else {"polymorphic_name": kind}
        number = kinds[kind] | (NEW if named else 0)
        told.add(kind)
        intrinsics.append(_item(k, {"polymorphic_id": number, **named, **_wrapped(len(p.images) + k, values)}))
    for i, file in enumerate(p.files):
        folder_of, _, name = file.rpartition("/")
        sensor = p.cameras[p.image_camera[i]].sensor
        view = {
            "local_path": folder_of, "filename": name, "width": sensor.width_px, "height": sensor.height_px,
            "id_view": i, "id_intrinsic": camera_of[p.image_camera[i]], "id_pose": i,
        }  # fmt: skip
        views.append(_item(i, {"polymorphic_id": _AS_DECLARED, **_wrapped(i, view)}))
    rotations, centres = downwards(p.exterior).tolist(), np.asarray(p.exterior.position).tolist()
    poses = [_item(i, {"rotation": r, "center": c}) for i, (r, c) in enumerate(zip(rotations, centres, strict=True))]
    content = {
        "sfm_data_version": _VERSION, "root_path": "", "views": views, "intrinsics": intrinsics, "extrinsics": poses,
        "structure": _structure(p), "control_points": [],
    }  # fmt: skip
    # Lists in a line each: with an indent of its own for every number a million image points take minutes.
    lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
    (folder / FILE).write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def _camera(camera: ExportCamera) -> tuple[str, dict[str, Any]]:
    """The kind of a camera, the first that holds its distortion, and its values."""
    sensor, interior = camera
    d = interior.distortion
    not_zero = {name for name in d.coefficients if float(getattr(d, name)) != 0}
    of_kind = [k for k, known in KINDS.items() if known[0].distortion is type(d) and not_zero <= set(known[2])]
    _, where, names = KINDS[of_kind[0]]
    f, _, column, row = from_centre_px(interior, sensor)
    values = {
        "width": sensor.width_px, "height": sensor.height_px, "focal_length": f,
        "principal_point": [column - FIRST_PX, row - FIRST_PX],
    }  # fmt: skip
    return of_kind[0], values | ({where: [float(getattr(d, name)) for name in names]} if where else {})


def _structure(p: AdjustedPhotographs) -> list[dict[str, Any]]:
    """The points that photographs show; a feature has the number of the image point."""
    images, places, found = p.image.tolist(), (p.column_row - FIRST_PX).tolist(), []
    for number, xyz, rows in zip(numbered(p.points).values(), p.xyz.tolist(), p.rows_of_points, strict=True):
        seen = [_item(images[k], {"id_feat": k, "x": places[k]}) for k in rows.tolist()]
        if seen:
            found.append(_item(number, {"X": xyz, "observations": seen}))
    return found


def _item(key: int, value: dict[str, Any]) -> dict[str, Any]:
    return {"key": key, "value": value}


def _wrapped(number: int, data: dict[str, Any]) -> dict[str, Any]:
    """An object, the `number`-th of the file, that a pointer leads to."""
    return {"ptr_wrapper": {"id": NEW | (number + 1), "data": data}}
