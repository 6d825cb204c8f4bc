"""Camera chains of Kalibr (camchain.yaml): pinhole cameras with distortion `radtan` or `equidistant`.

cam0, cam1, ... have intrinsics (fu, fv, pu, pv), distortion_coeffs (radtan: k1, k2, p1, p2; equidistant: k1 to k4) and
resolution, as OpenCV means them: the centre of the upper left pixel is (0, 0).
Source: Kalibr's wiki, "Supported models" and "YAML formats".
"""

from pathlib import Path
from typing import Any

from jaxphoto.errors import quoted
from jaxphoto.io.cameras import open_cv
from jaxphoto.io.cameras.camera_file import CameraFile, CameraSource, in_pixels
from jaxphoto.io.yaml_text import yaml_values

_MODELS = {
    "radtan": (open_cv.PLANE, ("k1", "k2", "p1", "p2")),
    "equidistant": (open_cv.FISHEYE, ("k1", "k2", "k3", "k4")),
    "none": (open_cv.PLANE, ()),
}


def recognises(path: Path, text: str) -> bool:
    """Whether `text` has what a camera chain calls its cameras."""
    return "distortion_coeffs" in text and "camera_model" in text


def read_kalibr(source: CameraSource) -> CameraFile:
    """One camera of the chain.

    Raises InputError for a file that is cut off, models that are not known here, and missing numbers.
    """
    chain = _chain(source)
    name = source.chosen(list(chain))
    camera = chain[name]
    kind, distortion = camera.get("camera_model"), camera.get("distortion_model")
    if kind != "pinhole":
        raise source.error(f"{name} is a {quoted(kind)}; cameras that are pinhole are known here")
    if not isinstance(distortion, str) or distortion not in _MODELS:
        known = ", ".join(_MODELS)
        raise source.error(f"the distortion {quoted(distortion)} of {name} is not known here; known are {known}")
    model, order = _MODELS[distortion]

    def numbers(key: str, count: int) -> list[float]:
        values = camera.get(key)
        if not isinstance(values, list) or len(values) != count or any(isinstance(v, bool) for v in values):
            raise source.error(f"{key} of {name} has to be a list of {count} numbers; export the chain anew")
        return [source.number(f"{key} of {name}", value) for value in values]

    fu, fv, pu, pv = numbers("intrinsics", 4)
    sensor, assumed = source.sensor(*numbers("resolution", 2))
    named = dict(zip(order, numbers("distortion_coeffs", len(order)), strict=True)) if order else {}
    interior = in_pixels(source, sensor, fu, fv, (pu + 0.5, pv + 0.5), model, **named)
    return CameraFile(name, sensor, interior, None, assumed)


def _chain(source: CameraSource) -> dict[str, dict[str, Any]]:
    """The cameras by name."""
    try:
        content = yaml_values(source.text())
    except ValueError as error:
        raise source.error(str(error)) from None
    return {key: value for key, value in content.items() if isinstance(value, dict)}
