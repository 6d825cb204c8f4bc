"""transforms.json of nerfstudio and instant-ngp, with image points beside it -> the tables of a free network.

    camera_model, w, h, fl_x, fl_y, cx, cy, k1 ...      at the top, or with each of
    frames          file_path, transform_matrix: 4 x 4, from x right, y up, z backwards of the camera to the world

Pixels as `jaxphoto.io.exports.nerfstudio`. `applied_transform` and `applied_scale` are in the matrices already.
Source: nerfstudio documentation, "Data conventions"; nerfstudio/cameras/camera_utils.py.
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
from jaxphoto.io.reconstructions.points_beside import PhotographCamera, network_beside, points_beside
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, estimated
from jaxphoto.io.toml import Section
from jaxphoto.io.whole_text import LARGE, has_words

FILE = "transforms.json"
_PLANE = ("k1", "k2", "k3", "p1", "p2")
# Of each kind of camera: what it is here, and which coefficients it has.
_KINDS: dict[str, tuple[CameraModel, tuple[str, ...]]] = {
    # Its k4 is a further radial term, as OpenCV's rational model has it: no coefficient of `_PLANE`.
    "OPENCV": (PLANE, _PLANE),
    "PINHOLE": (PLANE, ()),
    "SIMPLE_PINHOLE": (PLANE, ()),
    "OPENCV_FISHEYE": (FISHEYE, ("k1", "k2", "k3", "k4")),
}
_OF_CAMERA = ("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", *_PLANE, "k4", "camera_angle_x", "is_fisheye")


def recognises(source: Path) -> bool:
    """Whether `source` is transforms.json, by whatever name, or a folder that has it."""
    named = (source / FILE).is_file() or (source.name == FILE and source.is_file())
    return named or (source.suffix == ".json" and has_words(source, '"frames"', '"transform_matrix"'))


def read_nerfstudio(source: Path) -> BlockTables:
    """The free-network self-calibration of a transforms.json with image points beside it, from its values.

    Frames of the same values have one camera, free in c_mm, xp_mm, yp_mm and the coefficients that are not zero. A
    pixel counts for a micrometre. Further as `free_network`.

    Raises InputError for files that are damaged, kinds of cameras that are not known, and where there are no image
    points.
    """
    path = source if source.is_file() else source / FILE
    content = read_any_json(path, LARGE)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{path} has no list of frames; give transforms.json of nerfstudio in full")
    shared = {key: content[key] for key in _OF_CAMERA if key in content}
    files = [Section(path.name, f"frames.{k}", frame).text("file_path") for k, frame in enumerate(frames)]
    own = [shared | {key: frame[key] for key in _OF_CAMERA if key in frame} for frame in frames]
    kinds = {str(values): (k, values) for k, values in reversed(list(enumerate(own)))}
    names = {text: str(number) for number, text in enumerate(reversed(kinds))}
    cameras = {names[text]: _camera(path, f"frames.{k}", values) for text, (k, values) in kinds.items()}
    camera_of = [names[str(values)] for values in own]
    poses = number_rows(
        [frame.get("transform_matrix") for frame in frames],
        (4, 4),
        lambda k: f"{path.name}, frame {quoted(files[k])}, transform_matrix",
    )
    shown = points_beside(path, files, [PhotographCamera(*cameras[name][:2]) for name in camera_of])
    if not len(shown.image):
        raise InputError(
            f"{path.name} has no image points, and none are beside it; write image_points.csv into its folder, or "
            "convert the COLMAP model that it was made of"
        )
    rotations = np.swapaxes(poses[:, :3, :3], 1, 2)
    return network_beside(path, cameras, files, camera_of, rotations, poses[:, :3, 3], shown)


def _camera(path: Path, place: str, values: dict[str, Any]) -> TiedCamera:
    given, source = Section(path.name, place, values), CameraSource(path)
    # instant-ngp names no kind.
    kind = given.text("camera_model", "OPENCV_FISHEYE" if given.values.get("is_fisheye") is True else "OPENCV")
    if kind not in _KINDS:
        raise given.error("camera_model", f"{quoted(kind)} is not known here; known are {', '.join(_KINDS)}")
    model, coefficients = _KINDS[kind]
    for name in (*_PLANE, "k4"):
        if name not in coefficients and given.number(name, 0.0) != 0:
            raise given.error(name, f"cameras of kind {kind} have no such term here; calibrate without it")
    if not ("w" in given and "h" in given):
        raise InputError(
            f"{path.name} does not say how large its photographs are; add w and h (pixels) to it, and write "
            "image_points.csv into its folder, or convert the COLMAP model that it was made of"
        )
    width, height = given.number("w"), given.number("h")
    sensor, _ = source.sensor(width, height)
    if "fl_x" not in given and "camera_angle_x" in given:
        fx = width / 2 / np.tan(given.positive("camera_angle_x") / 2)
    else:
        fx = given.positive("fl_x")
    fy, centre = given.number("fl_y", float(fx)), (given.number("cx", width / 2), given.number("cy", height / 2))
    terms = {name: given.number(name, 0.0) for name in coefficients}
    interior = in_pixels(source, sensor, float(fx), fy, centre, model, **terms)
    return TiedCamera(sensor, interior, estimated(interior))
