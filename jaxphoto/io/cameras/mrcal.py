"""Camera models of mrcal (.cameramodel): LENSMODEL_PINHOLE and LENSMODEL_OPENCV4 to 12.

Names and values as Python writes them: lensmodel, intrinsics (fx, fy, cx, cy and OpenCV's k1, k2, p1, p2, k3, ...),
imagersize, extrinsics. The centre of the upper left pixel is (0, 0), ours (0.5, 0.5).
Source: mrcal documentation, "Camera model file formats" and "Lens models".
"""

import ast
import re
from pathlib import Path

import numpy as np

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import quoted
from jaxphoto.io.cameras.camera_file import CameraFile, CameraSource, from_centre_px, in_pixels
from jaxphoto.io.cameras.open_cv import ORDER, PLANE

_PLACES = 4
# Of each model the number of coefficients; those beyond k6 are of a thin prism.
_MODELS = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}
MODELS = {name: PLANE.only("b1", *ORDER[:n]) for name, n in _MODELS.items() if n <= len(ORDER)}
"""What those are that are written."""


def recognises(path: Path, text: str) -> bool:
    """Whether `text` names a lens model of mrcal."""
    return re.search(r"['\"]?lens_?model['\"]?\s*:\s*['\"]LENSMODEL_", text) is not None


def read_mrcal(source: CameraSource) -> CameraFile:
    """The camera of a .cameramodel.

    Raises InputError for a file that is cut off, lens models that are not known here, and terms of a thin prism.
    """
    try:
        values = ast.literal_eval(source.text())
    except (ValueError, SyntaxError, RecursionError, MemoryError, TypeError):
        raise source.error("this is no camera model of mrcal that can be read; write it anew") from None
    if not isinstance(values, dict):
        raise source.error("it has no names and values; let mrcal write it anew")
    model = values.get("lensmodel", values.get("lens_model"))
    if not isinstance(model, str) or model not in _MODELS:
        raise source.error(
            f"the lens model {quoted(model)} is not known here; known are {', '.join(_MODELS)}: "
            "mrcal-convert-lensmodel LENSMODEL_OPENCV8 FILE fits one"
        )
    numbers = _numbers(source, values, "intrinsics", _PLACES + _MODELS[model])
    if np.any(numbers[_PLACES + len(ORDER) :] != 0):
        raise source.error("its terms of a thin prism are not known here; calibrate with LENSMODEL_OPENCV8")
    sensor, assumed = source.sensor(*_numbers(source, values, "imagersize", 2).tolist())
    fx, fy, cx, cy = numbers[:_PLACES].tolist()
    named = dict(zip(ORDER, numbers[_PLACES:].tolist(), strict=False))
    interior = in_pixels(source, sensor, fx, fy, (cx + 0.5, cy + 0.5), PLANE, **named)
    return CameraFile(source.path.stem, sensor, interior, None, assumed)


def write_mrcal(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera that is a `PLANE`, by the smallest model that holds it, at the origin."""
    fx, fy, column, row = from_centre_px(interior, sensor)
    coefficients = [float(getattr(interior.distortion, k)) for k in ORDER]
    model = next(m for m, n in _MODELS.items() if not any(coefficients[n:]))
    values = [fx, fy, column - 0.5, row - 0.5, *coefficients[: _MODELS[model]]]
    lines = [
        f"'lensmodel': '{model}'",
        f"'intrinsics': [{', '.join(map(repr, values))}]",
        "'extrinsics': [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]",
        f"'imagersize': [{sensor.width_px}, {sensor.height_px}]",
    ]
    path.write_text("{\n" + "".join(f"    {line},\n" for line in lines) + "}\n", encoding="utf-8")


def _numbers(source: CameraSource, values: dict, key: str, count: int) -> np.ndarray:
    given = values.get(key)
    if not isinstance(given, list | tuple) or len(given) != count:
        raise source.error(f"{key} is {quoted(given)}, and {count} numbers are needed; let mrcal write the file anew")
    return np.array([source.number(key, None if isinstance(value, bool) else value) for value in given])
