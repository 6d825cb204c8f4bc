"""Camera files of OpenCV, ROS and mrcal. Their centre of the upper left pixel is (0, 0), ours (0.5, 0.5).

    OpenCV    YAML, XML or JSON of cv2.FileStorage; the skew element is ignored, as in OpenCV; files of cv2.fisheye
              contain `fisheye_model: 1` and have four coefficients
    ROS       camera_info: the same keys and a distortion_model (read only)
    mrcal     .cameramodel, a Python literal with lensmodel (LENSMODEL_PINHOLE, LENSMODEL_OPENCV4 to 12), intrinsics
              (fx, fy, cx, cy, coefficients of OpenCV), imagersize (read only)

Sources: OpenCV documentation, calib3d; ROS sensor_msgs/CameraInfo; mrcal documentation, "Camera model file formats" and
"Lens models".
"""

import ast
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.camera import InteriorOrientation, OpenCvFisheye, Sensor
from jaxphoto.errors import quoted
from jaxphoto.extras.formats.files import CameraFormat
from jaxphoto.extras.formats.project import (
    FISHEYE_TERMS,
    OPENCV,
    OPENCV_FISHEYE,
    OPENCV_ORDER,
    CameraModel,
    in_pixels,
    pixels_of,
)
from jaxphoto.io.camera_files import CameraFile, CameraReader, CameraSource, joined_notes

_COUNTS = (4, 5, 8, 12, 14)
_ROS_MODELS = ("plumb_bob", "rational_polynomial", "equidistant")
# Number of coefficients of each lens model; coefficients after k6 belong to a thin prism.
_MRCAL = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}


def _camera_file(
    source: CameraSource, size: Any, focal: Any, centre: Any, coefficients: Any, model: CameraModel, note: str = ""
) -> CameraFile:
    """Build a camera from size, focal lengths, principal point and coefficients in pixels, in OpenCV's order."""
    terms = FISHEYE_TERMS if model is OPENCV_FISHEYE else OPENCV_ORDER
    if np.any(np.array(coefficients[len(terms) :]) != 0):
        raise source.error("terms of a thin prism or a tilted sensor are not supported; calibrate without them")
    sensor, assumed = source.sensor(*size)
    named = dict(zip(terms, map(float, coefficients), strict=False))
    (fx, fy), (column, row) = focal, centre
    interior = in_pixels(source, sensor, fx, fy, (column + 0.5, row + 0.5), model, **named)
    return CameraFile(source.path.stem, sensor, interior, None, joined_notes(note, assumed))


def _recognise(path: Path, text: str) -> bool:
    start = text.lstrip()
    return not _recognise_mrcal(path, text) and (
        start.startswith("%YAML") or "<opencv_storage" in start[:500] or "camera_matrix" in text
    )


def read_opencv(source: CameraSource) -> CameraFile:
    """Read a camera file of OpenCV or ROS."""
    import cv2

    text = source.text()
    if not text.lstrip().startswith(("%YAML", "<?xml", "{")):
        text = "%YAML:1.0\n---\n" + text.lstrip().removeprefix("---")
    storage = cv2.FileStorage()
    try:
        if not storage.open(text, cv2.FileStorage_READ | cv2.FileStorage_MEMORY):
            raise cv2.error("not open")
        return _camera(source, storage)
    except cv2.error:
        raise source.error("OpenCV cannot read it: it is truncated or changed; write it again") from None
    finally:
        storage.release()


def _camera(source: CameraSource, storage: Any) -> CameraFile:
    kind = storage.getNode("distortion_model")
    if not kind.empty() and kind.string() not in _ROS_MODELS:
        models = ", ".join(_ROS_MODELS)
        raise source.error(f"distortion_model {quoted(kind.string())} is not supported; use one of {models}")
    fisheye = _number(storage.getNode("fisheye_model")) not in (None, 0.0) or kind.string() == _ROS_MODELS[-1]
    matrix = _matrix(source, storage, "camera_matrix", 9)
    coefficients = _matrix(source, storage, "distortion_coefficients")
    n, counts = len(coefficients), (4,) if fisheye else _COUNTS
    if n not in counts:
        raise source.error(f"{n} distortion_coefficients; OpenCV's model has {' or '.join(map(str, counts))}")
    size = [_number(storage.getNode(key)) for key in ("image_width", "image_height")]
    if None in size and source.size_px is None:
        raise source.error("image_width or image_height is missing; add both, or give the size of the image")
    rms = _number(storage.getNode("avg_reprojection_error"))
    return _camera_file(
        source, source.size_px if None in size else size, matrix[[0, 4]].tolist(), matrix[[2, 5]].tolist(),
        coefficients, OPENCV_FISHEYE if fisheye else OPENCV,
        f"avg_reprojection_error {rms:.4g} px" if rms is not None else "",
    )  # fmt: skip


def _number(node: Any) -> float | None:
    return float(node.real()) if not node.empty() and (node.isReal() or node.isInt()) else None


def _matrix(source: CameraSource, storage: Any, key: str, many: int | None = None) -> np.ndarray:
    """Return the elements of a matrix in row-major order."""
    node = storage.getNode(key)
    if node.empty():
        raise source.error(f"{key} is missing; add it, as OpenCV's calibration writes it")
    # Read element by element: FileNode.mat() terminates the process if one is missing.
    data = node.getNode("data") if node.isMap() else node
    values = [_number(data.at(k)) for k in range(data.size())] if data.isSeq() else []
    if (
        None in values
        or not values
        or not np.isfinite(np.array(values, float)).all()
        or many not in (None, len(values))
    ):
        raise source.error(f"{key} is not a matrix of {many or 'finite'} numbers in data; export it again")
    return np.array(values, float)


def write_opencv(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera as YAML, XML or JSON; the suffix of `path` determines the format."""
    import cv2

    fx, fy, column, row = pixels_of(interior, sensor)
    terms = FISHEYE_TERMS if isinstance(interior.distortion, OpenCvFisheye) else OPENCV_ORDER
    values = [float(getattr(interior.distortion, name)) for name in terms]
    storage = cv2.FileStorage(path.name, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("image_width", sensor.width_px)
    storage.write("image_height", sensor.height_px)
    if len(values) == len(FISHEYE_TERMS):
        storage.write("fisheye_model", 1)
    storage.write("camera_matrix", np.array([[fx, 0, column - 0.5], [0, fy, row - 0.5], [0, 0, 1.0]]))
    storage.write("distortion_coefficients", np.array(values if any(values[5:]) else values[:5])[:, None])
    path.write_text(storage.releaseAndGetString(), encoding="utf-8")


# mrcal --------------------------------------------------------------------------------------------------------


def _recognise_mrcal(path: Path, text: str) -> bool:
    return re.search(r"['\"]?lens_?model['\"]?\s*:\s*['\"]LENSMODEL_", text) is not None


def read_mrcal(source: CameraSource) -> CameraFile:
    """Read a mrcal .cameramodel file."""
    values = ast.literal_eval(source.text())
    model = values.get("lensmodel", values.get("lens_model"))
    if not isinstance(model, str) or model not in _MRCAL:
        raise source.error(f"lens model {quoted(model)} is not supported; use one of {', '.join(_MRCAL)}")
    lists = []
    for key, count in (("intrinsics", 4 + _MRCAL[model]), ("imagersize", 2)):
        numbers = values.get(key)
        if not isinstance(numbers, list | tuple) or len(numbers) != count:
            raise source.error(f"{key} of {model} is {quoted(numbers)}, not {count} numbers; export it again")
        lists.append([source.number(f"{key} of {model}", v) for v in numbers])
    intrinsics, size = lists
    return _camera_file(source, size, intrinsics[:2], intrinsics[2:4], intrinsics[4:], OPENCV)


CAMERAS = (
    CameraFormat(
        "opencv", CameraReader(_recognise, read_opencv), write_opencv, OPENCV, OPENCV_FISHEYE,
        (".yml", ".yaml", ".json"), "# {}",
    ),
    CameraFormat("mrcal", CameraReader(_recognise_mrcal, read_mrcal)),
)  # fmt: skip
