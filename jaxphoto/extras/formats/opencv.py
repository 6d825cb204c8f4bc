"""Camera files of OpenCV, ROS, Kalibr and mrcal. OpenCV's centre of the upper left pixel is (0, 0), ours (0.5, 0.5).

    OpenCV    YAML, XML or JSON of cv2.FileStorage; the skew element is ignored, as in OpenCV; files of cv2.fisheye
              contain `fisheye_model: 1` and have four coefficients
    ROS       camera_info: the same keys and a distortion_model
    Kalibr    camchain.yaml: cam0, cam1 ... with intrinsics (fu, fv, pu, pv), distortion_coeffs (radtan: k1, k2, p1, p2;
              equidistant: k1 to k4), resolution
    mrcal     .cameramodel: a Python literal with lensmodel (LENSMODEL_PINHOLE, LENSMODEL_OPENCV4 to 12), intrinsics
              (fx, fy, cx, cy, coefficients of OpenCV), imagersize

Sources: OpenCV documentation, calib3d; ROS sensor_msgs/CameraInfo; Kalibr's wiki, "YAML formats"; mrcal documentation,
"Camera model file formats" and "Lens models".
"""

import ast
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.camera import InteriorOrientation, OpenCvFisheye, Sensor
from jaxphoto.errors import quoted
from jaxphoto.extras.formats.camera_models import (
    FISHEYE_TERMS,
    OPENCV,
    OPENCV_FISHEYE,
    OPENCV_ORDER,
    CameraModel,
    in_pixels,
    pixels_of,
)
from jaxphoto.extras.formats.files import CameraFormat
from jaxphoto.io.camera_files import CameraFile, CameraReader, CameraSource, joined_notes

_COUNTS = (4, 5, 8, 12, 14)
MODELS = {f"OPENCV{n}": OPENCV.only("b1", *OPENCV_ORDER[:n]) for n in (4, 5, 8)} | {"FISHEYE": OPENCV_FISHEYE}
_ROS_FISHEYE = "equidistant"
ROS_MODELS = {
    "plumb_bob": MODELS["OPENCV5"], "rational_polynomial": MODELS["OPENCV8"], _ROS_FISHEYE: OPENCV_FISHEYE
}  # fmt: skip
_KALIBR: dict[str, tuple[CameraModel, tuple[str, ...]]] = {
    "radtan": (OPENCV, ("k1", "k2", "p1", "p2")),
    "equidistant": (OPENCV_FISHEYE, FISHEYE_TERMS),
    "none": (OPENCV, ()),
}
# Number of coefficients of each lens model; coefficients after k6 belong to a thin prism.
_MRCAL = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}
MRCAL_MODELS = {name: OPENCV.only("b1", *OPENCV_ORDER[:n]) for name, n in _MRCAL.items() if n <= len(OPENCV_ORDER)}


def _recognise(path: Path, text: str) -> bool:
    start = text.lstrip()
    other = _recognise_kalibr(path, text) or _recognise_mrcal(path, text)
    return not other and (start.startswith("%YAML") or "<opencv_storage" in start[:500] or "camera_matrix" in text)


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
    if not kind.empty() and kind.string() not in ROS_MODELS:
        models = ", ".join(ROS_MODELS)
        raise source.error(f"distortion_model {quoted(kind.string())} is not supported; use one of {models}")
    fisheye = _number(storage.getNode("fisheye_model")) not in (None, 0.0) or kind.string() == _ROS_FISHEYE
    matrix = _matrix(source, storage, "camera_matrix")
    if matrix.shape != (3, 3):
        raise source.error(f"camera_matrix is {' x '.join(map(str, matrix.shape))}, not 3 x 3; export it again")
    coefficients = _matrix(source, storage, "distortion_coefficients").ravel()
    n = len(coefficients)
    if fisheye and n != len(FISHEYE_TERMS):
        raise source.error(f"{n} distortion_coefficients, but OpenCV's fisheye model has 4; give 4")
    if n not in _COUNTS:
        raise source.error(f"{n} distortion_coefficients, but OpenCV uses one of {', '.join(map(str, _COUNTS))}")
    _check_plane(source, coefficients)
    size = [_number(storage.getNode(key)) for key in ("image_width", "image_height")]
    if None in size and source.size_px is None:
        raise source.error("image_width or image_height is missing; add both, or give the size of the image")
    sensor, assumed = source.sensor(*(source.size_px if None in size else size))  # type: ignore[misc,arg-type]
    (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
    terms = dict(zip(FISHEYE_TERMS if fisheye else OPENCV_ORDER, coefficients.tolist(), strict=False))
    model = OPENCV_FISHEYE if fisheye else OPENCV
    interior = in_pixels(source, sensor, fx, fy, (cx + 0.5, cy + 0.5), model, **terms)
    rms = _number(storage.getNode("avg_reprojection_error"))
    quality = f"avg_reprojection_error {rms:.4g} px" if rms is not None else ""
    return CameraFile(source.path.stem, sensor, interior, None, joined_notes(quality, assumed))


def _check_plane(source: CameraSource, coefficients: np.ndarray) -> None:
    if np.any(coefficients[len(OPENCV_ORDER) :] != 0):
        raise source.error("terms of a thin prism or a tilted sensor are not supported; calibrate without them")


def _number(node: Any) -> float | None:
    return float(node.real()) if not node.empty() and (node.isReal() or node.isInt()) else None


def _numbers(node: Any) -> list[float | None]:
    return [_number(node.at(k)) for k in range(node.size())] if node.isSeq() else []


def _matrix(source: CameraSource, storage: Any, key: str) -> np.ndarray:
    node = storage.getNode(key)
    if node.empty():
        raise source.error(f"{key} is missing; add it, as OpenCV's calibration writes it")
    # Read element by element: FileNode.mat() terminates the process if one is missing.
    rows, columns = (_number(node.getNode(side)) if node.isMap() else None for side in ("rows", "cols"))
    values = _numbers(node.getNode("data") if node.isMap() else node)
    if rows is None and node.isMap() and len(sizes := _numbers(node.getNode("sizes"))) == 1:
        # One-dimensional list, as written by OpenCV 5.
        rows, columns = 1.0, sizes[0]
    if not rows or not columns or rows % 1 or columns % 1 or None in values or not rows * columns == len(values) > 0:
        raise source.error(f"{key} is not a matrix of rows x cols numbers in data; export it again")
    matrix = np.array(values, float).reshape(-1, max(int(columns), 1))
    if not np.isfinite(matrix).all():
        raise source.error(f"{key} is not a matrix of finite numbers; calibrate again")
    return matrix


def _parts(sensor: Sensor, interior: InteriorOrientation) -> tuple[bool, list[float], list[float]]:
    """Return (is_fisheye, camera matrix in row-major order, distortion coefficients required by OpenCV)."""
    fx, fy, column, row = pixels_of(interior, sensor)
    fisheye = isinstance(interior.distortion, OpenCvFisheye)
    values = [float(getattr(interior.distortion, k)) for k in (FISHEYE_TERMS if fisheye else OPENCV_ORDER)]
    matrix = [fx, 0.0, column - 0.5, 0.0, fy, row - 0.5, 0.0, 0.0, 1.0]
    return fisheye, matrix, values if any(values[5:]) else values[:5]


def write_opencv(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera as YAML, XML or JSON; the suffix of `path` determines the format."""
    import cv2

    fisheye, matrix, values = _parts(sensor, interior)
    storage = cv2.FileStorage(path.name, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    storage.write("image_width", sensor.width_px)
    storage.write("image_height", sensor.height_px)
    if fisheye:
        storage.write("fisheye_model", 1)
    storage.write("camera_matrix", np.array(matrix).reshape(3, 3))
    storage.write("distortion_coefficients", np.array(values)[:, None])
    path.write_text(storage.releaseAndGetString(), encoding="utf-8")


def write_ros(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a ROS camera_info file for unrectified images."""
    fisheye, matrix, values = _parts(sensor, interior)
    model = _ROS_FISHEYE if fisheye else list(ROS_MODELS)[len(values) > 5]
    matrices = {
        "camera_matrix": (3, 3, matrix),
        "distortion_coefficients": (1, len(values), values),
        "rectification_matrix": (3, 3, np.eye(3).ravel().tolist()),
        "projection_matrix": (3, 4, [*matrix[:3], 0.0, *matrix[3:6], 0.0, *matrix[6:], 0.0]),
    }
    text = f"image_width: {sensor.width_px}\nimage_height: {sensor.height_px}\ncamera_name: {json.dumps(name)}\n"
    for key, (rows, columns, data) in matrices.items():
        text += f"{key}:\n  rows: {rows}\n  cols: {columns}\n  data: [{', '.join(map(repr, data))}]\n"
        if key == "camera_matrix":
            text += f"distortion_model: {model}\n"
    path.write_text(text, encoding="utf-8")


# Kalibr -------------------------------------------------------------------------------------------------------


def _recognise_kalibr(path: Path, text: str) -> bool:
    return "distortion_coeffs" in text and "camera_model" in text


def yaml_cameras(source: CameraSource) -> dict[str, dict[str, Any]]:
    """Return the mappings in a YAML file by name."""
    import yaml

    try:
        content = yaml.safe_load(source.text())
    except yaml.YAMLError as error:
        raise source.error(f"damaged YAML ({error.__class__.__name__}). Export it again") from None
    return {key: value for key, value in content.items() if isinstance(key, str) and isinstance(value, dict)}


def read_kalibr(source: CameraSource) -> CameraFile:
    """Read one camera of a Kalibr camera chain."""
    chain = yaml_cameras(source)
    name = source.chosen(list(chain))
    camera = chain[name]
    kind, distortion = camera.get("camera_model"), camera.get("distortion_model")
    if kind != "pinhole":
        raise source.error(f"{name} is a {quoted(kind)}, not pinhole; calibrate as pinhole")
    if not isinstance(distortion, str) or distortion not in _KALIBR:
        raise source.error(f"unknown distortion {quoted(distortion)} of {name}; use one of {', '.join(_KALIBR)}")
    model, order = _KALIBR[distortion]
    fu, fv, pu, pv = _list(source, camera, "intrinsics", 4, name)
    sensor, assumed = source.sensor(*_list(source, camera, "resolution", 2, name))
    terms = dict(zip(order, _list(source, camera, "distortion_coeffs", len(order), name), strict=True)) if order else {}
    interior = in_pixels(source, sensor, fu, fv, (pu + 0.5, pv + 0.5), model, **terms)
    return CameraFile(name, sensor, interior, None, assumed)


def _list(source: CameraSource, values: dict[str, Any], key: str, count: int, of: str) -> list[float]:
    numbers = values.get(key)
    if not isinstance(numbers, list | tuple) or len(numbers) != count:
        raise source.error(f"{key} of {of} is {quoted(numbers)}, not {count} numbers; export it again")
    return [source.number(f"{key} of {of}", None if isinstance(v, bool) else v) for v in numbers]


# mrcal --------------------------------------------------------------------------------------------------------


def _recognise_mrcal(path: Path, text: str) -> bool:
    return re.search(r"['\"]?lens_?model['\"]?\s*:\s*['\"]LENSMODEL_", text) is not None


def read_mrcal(source: CameraSource) -> CameraFile:
    """Read a mrcal .cameramodel file."""
    values = ast.literal_eval(source.text())
    model = values.get("lensmodel", values.get("lens_model"))
    if not isinstance(model, str) or model not in _MRCAL:
        raise source.error(f"lens model {quoted(model)} is not supported; use one of {', '.join(_MRCAL)}")
    fx, fy, cx, cy, *coefficients = _list(source, values, "intrinsics", 4 + _MRCAL[model], model)
    _check_plane(source, np.array(coefficients))
    sensor, assumed = source.sensor(*_list(source, values, "imagersize", 2, model))
    terms = dict(zip(OPENCV_ORDER, coefficients, strict=False))
    interior = in_pixels(source, sensor, fx, fy, (cx + 0.5, cy + 0.5), OPENCV, **terms)
    return CameraFile(source.path.stem, sensor, interior, None, assumed)


def write_mrcal(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a .cameramodel file in the smallest lens model with all nonzero coefficients; extrinsics are zero."""
    fx, fy, column, row = pixels_of(interior, sensor)
    coefficients = [float(getattr(interior.distortion, k)) for k in OPENCV_ORDER]
    model = next(m for m, n in _MRCAL.items() if not any(coefficients[n:]))
    values = [fx, fy, column - 0.5, row - 0.5, *coefficients[: _MRCAL[model]]]
    path.write_text(
        f"{{\n    'lensmodel': '{model}',\n    'intrinsics': [{', '.join(map(repr, values))}],\n"
        f"    'extrinsics': [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],\n"
        f"    'imagersize': [{sensor.width_px}, {sensor.height_px}],\n}}\n",
        encoding="utf-8",
    )


CAMERAS = (
    CameraFormat(
        "opencv", CameraReader(_recognise, read_opencv), write_opencv, OPENCV, OPENCV_FISHEYE,
        (".yml", ".yaml", ".json"), "# {}", MODELS,
    ),
    CameraFormat("ros", None, write_ros, OPENCV, OPENCV_FISHEYE, (), "# {}", ROS_MODELS),
    CameraFormat(
        "mrcal", CameraReader(_recognise_mrcal, read_mrcal), write_mrcal, OPENCV, None, (".cameramodel",), "# {}",
        MRCAL_MODELS,
    ),
    CameraFormat("kalibr", CameraReader(_recognise_kalibr, read_kalibr)),
)  # fmt: skip
