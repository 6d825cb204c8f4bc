"""Camera files of OpenCV: YAML, XML or JSON of cv2.FileStorage, as its calibration sample writes them.

OpenCV's centre of the upper left pixel is (0, 0), ours (0.5, 0.5). It ignores what stands at the place of a skew. Files
of cv2.fisheye say `fisheye_model: 1` and have four coefficients.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxphoto.camera import Equidistant, InteriorOrientation, OpenCv, OpenCvFisheye, Perspective, Sensor
from jaxphoto.errors import quoted
from jaxphoto.io.cameras.camera_file import (
    CameraFile,
    CameraModel,
    CameraSource,
    from_centre_px,
    in_pixels,
    joined_notes,
)

if TYPE_CHECKING:
    import cv2

ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Its coefficients, as its files list them."""
_COUNTS = (4, 5, 8, 12, 14)
_FISHEYE_ORDER = ("k1", "k2", "k3", "k4")
# What ROS calls them (sensor_msgs/CameraInfo).
_ROS_PLANES, _ROS_FISHEYE = ("plumb_bob", "rational_polynomial"), "equidistant"
# Its parser came to the end of the stack at some 20,000 levels (OpenCV 5.0); files have five.
_NESTING = re.compile(r"[\[{]|<(?![/?!])|[\]}]|</|/>")
_DEEPEST, _SIGNS = 100, 1_000
PLANE = CameraModel(OpenCv, ("b2",), Perspective())
FISHEYE = CameraModel(OpenCvFisheye, ("p1", "p2", "s1", "s2", "b2"), Equidistant())
"""What its cameras are here."""
MODELS = {f"OPENCV{n}": PLANE.only("b1", *ORDER[:n]) for n in (4, 5, 8)} | {"FISHEYE": FISHEYE}
"""Its models by the number of coefficients."""
ROS_MODELS = dict(zip((*_ROS_PLANES, _ROS_FISHEYE), (MODELS["OPENCV5"], MODELS["OPENCV8"], FISHEYE), strict=True))
"""What ROS calls those that it has."""


def recognises(path: Path, text: str) -> bool:
    """Whether `text` is of cv2.FileStorage, or names what such a file holds."""
    start = text.lstrip()
    return start.startswith("%YAML") or "<opencv_storage" in start[:500] or "camera_matrix" in text


def read_open_cv(source: CameraSource) -> CameraFile:
    """camera_matrix, distortion_coefficients, image_width, image_height and avg_reprojection_error of a file.

    Files of ROS (camera_info) hold the same, and a distortion_model. Raises InputError for a file that is cut off, for
    missing keys, and terms of thin prisms or tilt.
    """
    with _opened(source) as storage:
        return _camera(source, storage)


@contextmanager
def _opened(source: CameraSource) -> Iterator[cv2.FileStorage]:
    """A file as OpenCV reads it. Raises InputError where it cannot, or finds something else than it is asked for."""
    import cv2

    text = source.text()
    if _is_deep(text):
        raise source.error("lists or keys are nested more deeply than in any file of OpenCV; write it anew")
    if not text.lstrip().startswith(("%YAML", "<?xml", "{")):
        text = "%YAML:1.0\n---\n" + text.lstrip().removeprefix("---")
    storage = cv2.FileStorage()
    try:
        is_open = storage.open(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY)
    except cv2.error:
        is_open = False
    if not is_open:
        raise source.error("OpenCV cannot read it; it is cut off or was changed, so write it anew")
    try:
        yield storage
    except cv2.error:
        # Such as a list where names and values are expected.
        raise source.error("OpenCV finds no camera in it; write it anew") from None
    finally:
        storage.release()


def write_open_cv(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera that is a `PLANE` or `FISHEYE`; the suffix of `path` says in which of the three ways.

    Raises OSError where it cannot be written, of which OpenCV itself would say nothing.
    """
    import cv2

    fx, fy, column, row = from_centre_px(interior, sensor)
    d = interior.distortion
    fisheye = isinstance(d, OpenCvFisheye)
    values = [float(getattr(d, k)) for k in (_FISHEYE_ORDER if fisheye else ORDER)]
    coefficients = np.array(values if any(values[5:]) else values[:5])
    storage = cv2.FileStorage(path.name, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("image_width", sensor.width_px)
    storage.write("image_height", sensor.height_px)
    if fisheye:
        storage.write("fisheye_model", 1)
    storage.write("camera_matrix", np.array([[fx, 0.0, column - 0.5], [0.0, fy, row - 0.5], [0.0, 0.0, 1.0]]))
    storage.write("distortion_coefficients", coefficients[:, None])
    path.write_text(storage.releaseAndGetString(), encoding="utf-8")


def write_ros(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera that is a `PLANE` or `FISHEYE` as a camera_info file of ROS, whose image is not rectified."""
    fx, fy, column, row = from_centre_px(interior, sensor)
    d = interior.distortion
    fisheye = isinstance(d, OpenCvFisheye)
    values = [float(getattr(d, k)) for k in (_FISHEYE_ORDER if fisheye else ORDER)]
    rational = not fisheye and any(values[5:])
    model = _ROS_FISHEYE if fisheye else _ROS_PLANES[rational]
    matrix = [fx, 0.0, column - 0.5, 0.0, fy, row - 0.5, 0.0, 0.0, 1.0]
    projection = [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]
    lines = [f"image_width: {sensor.width_px}", f"image_height: {sensor.height_px}", f"camera_name: {json.dumps(name)}"]
    lines += [*_ros_matrix("camera_matrix", 3, 3, matrix), f"distortion_model: {model}"]
    lines += _ros_matrix("distortion_coefficients", 1, n := 4 if fisheye else 8 if rational else 5, values[:n])
    lines += _ros_matrix("rectification_matrix", 3, 3, np.eye(3).ravel().tolist())
    lines += _ros_matrix("projection_matrix", 3, 4, projection)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _ros_matrix(name: str, rows: int, columns: int, values: list[float]) -> list[str]:
    data = ", ".join(map(repr, values))
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{data}]"]


def _is_deep(text: str) -> bool:
    """Whether OpenCV's parser might end the process: it calls itself for everything that is in something else."""
    depth = 0
    for sign in _NESTING.finditer(text):
        depth = max(depth + (1 if sign[0] in ("[", "{", "<") else -1), 0)
        if depth > _DEEPEST:
            return True
    # A list within a list begins by a dash, a name within a name by a colon, or both are told by how far a line begins
    # from the left.
    return any(
        line.count("-") + line.count(":") > _SIGNS or len(line) - len(line.lstrip()) > _SIGNS
        for line in text.split("\n")
    )


def _camera(source: CameraSource, storage: cv2.FileStorage) -> CameraFile:
    kind = storage.getNode("distortion_model")
    if not kind.empty() and kind.string() not in ROS_MODELS:
        known = ", ".join(ROS_MODELS)
        raise source.error(f"the distortion_model {quoted(kind.string())} is not known here; known are {known}")
    fisheye = _number(storage, "fisheye_model") not in (None, 0.0) or kind.string() == _ROS_FISHEYE
    matrix = _matrix(source, storage, "camera_matrix")
    if matrix.shape != (3, 3):
        raise source.error(f"camera_matrix is {' x '.join(map(str, matrix.shape))}; it has to be 3 x 3")
    coefficients = _matrix(source, storage, "distortion_coefficients").ravel()
    if fisheye and len(coefficients) != len(_FISHEYE_ORDER):
        raise source.error(f"there are {len(coefficients)} distortion_coefficients; OpenCV's fisheye model has 4")
    if len(coefficients) not in _COUNTS:
        counts = ", ".join(map(str, _COUNTS))
        raise source.error(f"there are {len(coefficients)} distortion_coefficients; OpenCV has one of {counts}")
    if np.any(coefficients[len(ORDER) :] != 0):
        raise source.error("its terms of a thin prism or a tilted sensor are not known here; calibrate without them")
    sensor, assumed = source.sensor(*_size(source, storage))
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    named = dict(zip(_FISHEYE_ORDER if fisheye else ORDER, coefficients.tolist(), strict=False))
    model = FISHEYE if fisheye else PLANE
    interior = in_pixels(source, sensor, fx, fy, (cx + 0.5, cy + 0.5), model, **named)
    rms = _number(storage, "avg_reprojection_error")
    quality = f"avg_reprojection_error {rms:.4g} px" if rms is not None else ""
    return CameraFile(source.path.stem, sensor, interior, None, joined_notes(quality, assumed))


def _size(source: CameraSource, storage: cv2.FileStorage) -> tuple[float, float]:
    size = [_number(storage, key) for key in ("image_width", "image_height")]
    if None in size:
        if source.size_px is None:
            raise source.error("image_width or image_height is missing; add both, or give the size of the image")
        size = list(map(float, source.size_px))
    return size[0], size[1]  # type: ignore[return-value]


def _number(parent: cv2.FileStorage | cv2.FileNode, key: str) -> float | None:
    return _value(parent.getNode(key))


def _value(node: cv2.FileNode) -> float | None:
    return float(node.real()) if not node.empty() and (node.isReal() or node.isInt()) else None


def _values(node: cv2.FileNode) -> list[float | None]:
    """The numbers of a list, with None for what is no number; none where it is no list."""
    return [_value(node.at(k)) for k in range(node.size())] if node.isSeq() else []


def _matrix(source: CameraSource, storage: cv2.FileStorage, key: str) -> np.ndarray:
    node = storage.getNode(key)
    if node.empty():
        raise source.error(f"{key} is missing; add it, as OpenCV's calibration writes it")
    # Its parts one by one: FileNode.mat() ends the whole process where one of them is missing.
    rows, columns = (_number(node, side) if node.isMap() else None for side in ("rows", "cols"))
    data = node.getNode("data") if node.isMap() else node
    values = _values(data)
    if rows is None and node.isMap() and len(sizes := _values(node.getNode("sizes"))) == 1:
        # A list of one dimension, as OpenCV 5 writes it.
        rows, columns = 1.0, sizes[0]
    if not rows or not columns or rows % 1 or columns % 1 or None in values or not rows * columns == len(values) > 0:
        raise source.error(f"{key} is no matrix with rows, cols and as many numbers in data; write it anew with OpenCV")
    matrix = np.array(values, float).reshape(-1, max(int(columns), 1))
    if not np.isfinite(matrix).all():
        raise source.error(f"{key} is no matrix of finite numbers; calibrate again")
    return matrix
