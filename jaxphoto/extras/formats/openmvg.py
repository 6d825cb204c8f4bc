"""OpenMVG: sfm_data.json with structure.

    views           key: file, width, height, id_intrinsic, id_pose
    intrinsics      key: kind, width, height, focal_length, principal_point, and a list of coefficients
    extrinsics      key of a pose: rotation, center; x_camera = R (x_world - center)
    structure       key of a point: X, observations (key of a view: x in pixels)

Axes are x right, y down, z ahead; the centre of the upper left pixel is (0, 0). Objects are wrapped as by cereal: the
first of a kind has its name with its number, and each object a number of its own.
Source: OpenMVG documentation, "sfm: Structure from Motion"; openMVG/sfm/sfm_data_io_cereal.cpp, sfm_view_io.hpp,
openMVG/cameras/Camera_*_io.hpp.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.camera_models import (
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
from jaxphoto.extras.formats.project import Project, numbered, pose
from jaxphoto.io.camera_files import CameraSource
from jaxphoto.io.text_files import has_words
from jaxphoto.io.toml import Section

FILE = "sfm_data.json"
_LISTS = ("views", "intrinsics", "extrinsics", "structure")
_FIRST_PX = 0.5
# The bit of a kind's number where its name follows, and the number of an object of the declared kind.
_NEW, _AS_DECLARED = 0x80000000, 0x40000000
_KINDS: dict[str, tuple[CameraModel, str, tuple[str, ...]]] = {
    "pinhole": (OPENCV, "", ()),
    "pinhole_radial_k1": (OPENCV, "disto_k1", ("k1",)),
    "pinhole_radial_k3": (OPENCV, "disto_k3", ("k1", "k2", "k3")),
    "pinhole_brown_t2": (OPENCV, "disto_t2", BROWN_TERMS),
    "fisheye": (OPENCV_FISHEYE, "fisheye", FISHEYE_TERMS),
}


def _is_scene(path: Path) -> bool:
    return path.name == FILE or (path.suffix == ".json" and has_words(path, '"sfm_data_version"'))


def read(path: Path) -> Project:
    """Read a scene; cameras are free in c, xp, yp and the coefficients of their kind."""
    content = read_json(path)
    views, intrinsics, poses, points = (_by_key(path, content, name) for name in _LISTS)
    kinds = {_kind_number(v): v["polymorphic_name"] for v in intrinsics.values() if "polymorphic_name" in v}
    cameras = {key: _camera(path, key, value, kinds) for key, value in intrinsics.items()}
    files: list[str] = []
    camera_of: list[str] = []
    pose_of: list[str] = []
    place: dict[str, int] = {}
    for key, value in views.items():
        view = Section(path.name, f"view {key}", _data(value))
        camera, pose_key = str(view.values.get("id_intrinsic")), str(view.values.get("id_pose"))
        if pose_key in poses and camera in cameras:
            place[key] = len(files)
            folder = view.text("local_path", "").strip("/\\")
            files.append(f"{folder}/{view.text('filename')}" if folder else view.text("filename"))
            camera_of.append(camera)
            pose_of.append(pose_key)
    if not files:
        raise InputError(
            f"{path} has {len(views)} views and none with a pose; give the file that the reconstruction wrote: "
            f"openMVG_main_ConvertSfM_DataFormat binary -i sfm_data.bin -o {FILE} -V -I -E -S"
        )
    rotations, centres = (
        number_rows(
            [poses[k].get(name) for k in pose_of], shape,
            lambda k, name=name: f"{path.name}, extrinsics {pose_of[k]}, {name}",  # type: ignore[misc]
        )
        for name, shape in (("rotation", (3, 3)), ("center", (3,)))
    )  # fmt: skip
    ids = list(points)
    rows = [
        (place[str(one["key"])], k, one["value"]["x"])
        for k, value in enumerate(points.values())
        for one in value["observations"]
        if str(one["key"]) in place
    ]
    return Project(
        path.resolve().parent.name,
        cameras,
        (),
        files,
        camera_of,
        pose(rotations, centres),
        ids,
        number_rows([q.get("X") for q in points.values()], (3,), lambda k: f"{path.name}, structure {ids[k]}, X"),
        np.array([row[0] for row in rows], int),
        np.array([row[1] for row in rows], int),
        number_rows([row[2] for row in rows], (2,), lambda k: f"{path.name}, structure {ids[rows[k][1]]}, x")
        + _FIRST_PX,
        file=path.name,
    )


def _by_key(path: Path, content: dict[str, Any], name: str) -> dict[str, dict[str, Any]]:
    values: dict[str, dict[str, Any]] = {}
    for item in content[name]:
        key, value = str(item["key"]), item["value"]
        if key in values:
            raise InputError(f"{path.name}, {name}: {key} is there twice; keep one of the two")
        values[key] = value
    return values


def _data(value: dict[str, Any]) -> dict[str, Any]:
    """The values of an object and of its base class."""
    data = value["ptr_wrapper"]["data"]
    return {**data.get("value0", {}), **data}


def _kind_number(value: dict[str, Any]) -> int | None:
    number = value.get("polymorphic_id")
    return number & ~_NEW if isinstance(number, int) else None


def _camera(path: Path, key: str, value: dict[str, Any], kinds: dict[int | None, Any]) -> ProjectCamera:
    section = Section(path.name, f"intrinsics {key}", _data(value))
    kind = value.get("polymorphic_name", kinds.get(_kind_number(value)))
    if kind not in _KINDS:
        raise section.error("polymorphic_name", f"{quoted(kind)} is not known here; known are {', '.join(_KINDS)}")
    model, name, coefficients = _KINDS[kind]
    source = CameraSource(path)
    sensor, _ = source.sensor(section.count("width"), section.count("height"))
    column, row = (section.vector("principal_point", 2) + _FIRST_PX).tolist()
    terms = dict(zip(coefficients, section.vector(name, len(coefficients)) if name else (), strict=True))
    f = section.positive("focal_length")
    interior = in_pixels(source, sensor, f, f, (column, row), model, **terms)
    return ProjectCamera(sensor, interior, ("c_mm", "xp_mm", "yp_mm", *coefficients))


def write(p: Project, folder: Path) -> None:
    """Write sfm_data.json; points with numeric ids keep them, others are counted from 1."""
    camera_of = {name: k for k, name in enumerate(p.cameras)}
    cameras = [_written(camera) for camera in p.cameras.values()]
    kinds = {kind: k for k, kind in enumerate(dict.fromkeys(kind for kind, _ in cameras), 1)}
    intrinsics, views, named = [], [], set[str]()
    for k, (kind, values) in enumerate(cameras):
        name = {} if kind in named else {"polymorphic_name": kind}
        number = kinds[kind] | (_NEW if name else 0)
        named.add(kind)
        intrinsics.append(_item(k, {"polymorphic_id": number, **name, **_wrapped(len(p.files) + k, values)}))
    for i, file in enumerate(p.files):
        local_path, _, name_of_file = file.rpartition("/")
        sensor = p.cameras[p.image_camera[i]].sensor
        view = {
            "local_path": local_path, "filename": name_of_file, "width": sensor.width_px, "height": sensor.height_px,
            "id_view": i, "id_intrinsic": camera_of[p.image_camera[i]], "id_pose": i,
        }  # fmt: skip
        views.append(_item(i, {"polymorphic_id": _AS_DECLARED, **_wrapped(i, view)}))
    rotations, centres = p.world_to_camera.tolist(), np.asarray(p.exterior.position).tolist()
    poses = [_item(i, {"rotation": r, "center": c}) for i, (r, c) in enumerate(zip(rotations, centres, strict=True))]
    images, places, structure = p.image.tolist(), (p.column_row - _FIRST_PX).tolist(), []
    xyz = np.asarray(p.xyz).tolist()
    for number, at, rows in zip(numbered(p.points).values(), xyz, p.rows_of_points, strict=True):
        if seen := [_item(images[k], {"id_feat": k, "x": places[k]}) for k in rows.tolist()]:
            structure.append(_item(number, {"X": at, "observations": seen}))
    content = {
        "sfm_data_version": "0.3", "root_path": "", "views": views, "intrinsics": intrinsics, "extrinsics": poses,
        "structure": structure, "control_points": [],
    }  # fmt: skip
    # One line a list: indents of every number take minutes.
    lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
    (folder / FILE).write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def _written(camera: ProjectCamera) -> tuple[str, dict[str, Any]]:
    """The first kind that holds a camera, and its values."""
    sensor, interior, _ = camera
    d = interior.distortion
    needed = {name for name in d.coefficients if float(getattr(d, name)) != 0}
    kind = next(k for k, (m, _, names) in _KINDS.items() if m.distortion is type(d) and needed <= set(names))
    f, _, column, row = pixels_of(interior, sensor)
    values = {
        "width": sensor.width_px, "height": sensor.height_px, "focal_length": f,
        "principal_point": [column - _FIRST_PX, row - _FIRST_PX],
    }  # fmt: skip
    _, key, names = _KINDS[kind]
    return kind, values | ({key: list(camera.terms(names).values())} if key else {})


def _item(key: int, value: dict[str, Any]) -> dict[str, Any]:
    return {"key": key, "value": value}


def _wrapped(number: int, data: dict[str, Any]) -> dict[str, Any]:
    """The object `number` of the file behind a pointer."""
    return {"ptr_wrapper": {"id": _NEW | (number + 1), "data": data}}


FORMATS = (
    Format(
        "openmvg", "sfm_data.json of OpenMVG, with structure", by_content(FILE, _is_scene), read, write=write,
        plane=OPENCV.only(*BROWN_TERMS), fisheye=OPENCV_FISHEYE.only(*FISHEYE_TERMS), endings=(".json",),
    ),
)  # fmt: skip
