"""sfm_data.json of OpenMVG -> the tables of a free network.

    views           key: file, width, height, id_intrinsic, id_pose
    intrinsics      key: kind, width, height, focal_length, principal_point, and a list of coefficients
    extrinsics      key of a pose: rotation, center; x_camera = R (x_world - center)
    structure       key of a point: X, observations (key of a view: x in pixels)

Axes are x right, y down, z ahead. `pinhole_radial_k1` and `_k3` have k1 and k1 to k3, `pinhole_brown_t2` k1, k2, k3,
p1, p2 of OpenCV and `fisheye` k1 to k4 of OpenCV's. The centre of the upper left pixel is at (0, 0), as its features
have it.
Source: OpenMVG documentation, "sfm: Structure from Motion"; openMVG/cameras, openMVG/sfm/sfm_data_io_cereal.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.cameras.camera_file import CameraModel, CameraSource, in_pixels
from jaxphoto.io.cameras.open_cv import FISHEYE, PLANE
from jaxphoto.io.json_file import read_any_json
from jaxphoto.io.reconstructions.numbers import number_rows
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, TiedPhotographs, free_network
from jaxphoto.io.toml import Section
from jaxphoto.io.whole_text import LARGE, has_words

FILE = "sfm_data.json"
_KEYS = ("views", "intrinsics", "extrinsics", "structure")
FIRST_PX = 0.5
"""Column and row, as here, of the centre of the upper left pixel, which is (0, 0) there."""
NEW = 0x80000000
"""The bit of a kind's number where the kind is met for the first time, and its name is told, too."""
KINDS: dict[str, tuple[CameraModel, str, tuple[str, ...]]] = {
    "pinhole": (PLANE, "", ()),
    "pinhole_radial_k1": (PLANE, "disto_k1", ("k1",)),
    "pinhole_radial_k3": (PLANE, "disto_k3", ("k1", "k2", "k3")),
    "pinhole_brown_t2": (PLANE, "disto_t2", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": (FISHEYE, "fisheye", ("k1", "k2", "k3", "k4")),
}
"""Of each kind of camera: what it is here, where its coefficients stand, and which they are."""


def recognises(source: Path) -> bool:
    """Whether `source` is sfm_data.json, by whatever name, or a folder that has it."""
    named = (source / FILE).is_file() or (source.name == FILE and source.is_file())
    return named or (source.suffix == ".json" and has_words(source, '"sfm_data_version"'))


def read_open_mvg(source: Path) -> BlockTables:
    """The free-network self-calibration of an OpenMVG scene, from its values.

    Cameras are free in c_mm, xp_mm, yp_mm and the coefficients of their kind. A pixel counts for a micrometre. A point
    has OpenMVG's number as id. Views without a pose are left out. Further as `free_network`.

    Raises InputError for files that are damaged or do not fit together, and for kinds of cameras that are not known.
    """
    path = source if source.is_file() else source / FILE
    content = read_any_json(path, LARGE)
    if not isinstance(content, dict) or not all(isinstance(content.get(key), list) for key in _KEYS):
        raise InputError(f"{path} has not the lists {', '.join(_KEYS)}; give sfm_data.json of OpenMVG in full")
    poses = _by_key(path, content, "extrinsics")
    intrinsics = _by_key(path, content, "intrinsics")
    kinds = {_number_of_kind(v): v["polymorphic_name"] for v in intrinsics.values() if "polymorphic_name" in v}
    cameras = {key: _camera(path, key, value, kinds) for key, value in intrinsics.items()}
    files: list[str] = []
    camera_of: list[str] = []
    pose_of: list[str] = []
    place: dict[str, int] = {}
    for key, value in _by_key(path, content, "views").items():
        view = Section(path.name, f"view {key}", _data(value))
        camera, pose = str(view.values.get("id_intrinsic")), str(view.values.get("id_pose"))
        if pose not in poses or camera not in cameras:
            continue
        place[key] = len(files)
        folder = view.text("local_path", "").strip("/\\")
        files.append(f"{folder}/{view.text('filename')}" if folder else view.text("filename"))
        camera_of.append(camera)
        pose_of.append(pose)
    if not files:
        raise InputError(
            f"{path} has {len(content['views'])} views and none with a pose; give the file that the reconstruction "
            f"wrote: openMVG_main_ConvertSfM_DataFormat binary -i sfm_data.bin -o {FILE} -V -I -E -S"
        )
    of_pose = lambda name, shape: number_rows(  # noqa: E731
        [poses[pose].get(name) for pose in pose_of], shape, lambda k: f"{path.name}, extrinsics {pose_of[k]}, {name}"
    )
    points = _by_key(path, content, "structure")
    ids = list(points)
    rows = [
        (place[str(one.get("key"))], k, one["value"].get("x") if isinstance(one.get("value"), dict) else None)
        for k, value in enumerate(points.values())
        for one in _list(path, f"structure {ids[k]}", value.get("observations"))
        if str(one.get("key")) in place
    ]
    return free_network(
        TiedPhotographs(
            path.name,
            "OpenMVG",
            path.resolve().parent.name,
            cameras,
            files,
            camera_of,
            of_pose("rotation", (3, 3)),
            of_pose("center", (3,)),
            ids,
            number_rows([p.get("X") for p in points.values()], (3,), lambda k: f"{path.name}, structure {ids[k]}, X"),
            np.array([row[0] for row in rows], int),
            np.array([row[1] for row in rows], int),
            number_rows([row[2] for row in rows], (2,), lambda k: f"{path.name}, structure {ids[rows[k][1]]}, x")
            + FIRST_PX,
        )
    )


def _by_key(path: Path, content: dict[str, Any], name: str) -> dict[str, dict[str, Any]]:
    """The values of a list of keys and values."""
    found = {}
    for item in _list(path, name, content[name]):
        key, value = item.get("key"), item.get("value")
        if isinstance(key, bool) or not isinstance(key, int) or not isinstance(value, dict):
            raise InputError(f"{path.name}, {name}: an item has no key that is a number, or no value; export it anew")
        if str(key) in found:
            raise InputError(f"{path.name}, {name}: {key} is there twice; keep one of the two")
        found[str(key)] = value
    return found


def _list(path: Path, name: str, items: Any) -> list[dict[str, Any]]:
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise InputError(f"{path.name}, {name}: this is no list of keys and values; export the file anew")
    return items


def _data(value: dict[str, Any]) -> dict[str, Any]:
    """What an object that cereal wrote has, with what it has of its base class."""
    pointer = value.get("ptr_wrapper")
    data = pointer.get("data") if isinstance(pointer, dict) else None
    if not isinstance(data, dict):
        return {}
    base = data.get("value0")
    return {**base, **data} if isinstance(base, dict) else data


def _number_of_kind(value: dict[str, Any]) -> int | None:
    number = value.get("polymorphic_id")
    return number & ~NEW if isinstance(number, int) else None


def _camera(path: Path, key: str, value: dict[str, Any], kinds: dict[int | None, Any]) -> TiedCamera:
    given = Section(path.name, f"intrinsics {key}", _data(value))
    kind = value.get("polymorphic_name", kinds.get(_number_of_kind(value)))
    if not isinstance(kind, str) or kind not in KINDS:
        raise given.error("polymorphic_name", f"{quoted(kind)} is not known here; known are {', '.join(KINDS)}")
    model, name, coefficients = KINDS[kind]
    source = CameraSource(path)
    sensor, _ = source.sensor(given.count("width"), given.count("height"))
    column, row = given.vector("principal_point", 2) + FIRST_PX
    values = dict(zip(coefficients, given.vector(name, len(coefficients)) if name else (), strict=True))
    f = given.positive("focal_length")
    interior = in_pixels(source, sensor, f, f, (float(column), float(row)), model, **values)
    return TiedCamera(sensor, interior, ("c_mm", "xp_mm", "yp_mm", *coefficients))
