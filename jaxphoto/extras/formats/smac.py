"""SMAC parameters in a USGS "Report of Calibration", as text.

Coordinates are in mm, x right and y up from the indicated principal point; distortion is added (`Smac`, sign "add").
Reports do not contain the pixel size; unless the user specifies it, the format of aerial film is assumed. Source: USGS
report OSL/2985.
"""

import collections
import re
from pathlib import Path

import jax

from jaxphoto.arrays import as_jax_array
from jaxphoto.camera import InteriorOrientation, Perspective, Sensor, Smac, rebalance, with_sign
from jaxphoto.extras.formats.camera_models import CameraModel
from jaxphoto.extras.formats.files import CameraFormat
from jaxphoto.io.camera_files import CameraFile, CameraReader, CameraSource, joined_notes

_PARAMETERS = ("K0", "K1", "K2", "K3", "K4", "P1", "P2", "P3", "P4", "xp", "yp")
_NEEDED = ("K0", "K1", "K2", "xp", "yp")
# Side of the film format (mm): 9 inches.
_FILM_MM, _FILM_PIXEL_MM = 228.6, 0.01
# Powers are printed as 0.2616 x 10-4 or 0.2616E-04, with two kinds of minus signs. A match must not start within a
# number.
_NUMBER = (
    r"(?:[-+−]\s?|(?<![\d.]))(?:\d+(?:\.\d*)?|\.\d+)(?:[eEdD][-+−]?\d+|\s*[x×*]\s*10\s*(?:\^|\*\*)?\s*[-+−]\s?\d+)?"
)
# A truncated power of ten invalidates its number.
_CUT = r"(?:\s*[x×*]\s*10(?!\d))?"
_TOKEN = re.compile(rf"(?P<name>\b(?:K[0-4]|P[1-4]|[xy]p)\b)|(?P<equals>=)|(?P<number>{_NUMBER}{_CUT})")
_FOCAL = re.compile(r"calibrated\s+focal\s+length", re.IGNORECASE)
_IN_MM = re.compile(rf"({_NUMBER})\s*mm", re.IGNORECASE)
_POINT = re.compile(rf"[xy]p\s*=\s*{_NUMBER}\s*mm")
_FORMAT = re.compile(rf"image format:\s*(\d+)\s*x\s*(\d+)\s*pixels of\s*({_NUMBER})\s*mm", re.IGNORECASE)


def _recognise(path: Path, text: str) -> bool:
    return _FOCAL.search(text) is not None and "K1" in text


def read_smac_report(source: CameraSource) -> CameraFile:
    """Read the camera of a report. Raise InputError for missing parameters."""
    text = source.text()
    # Remove the principal point: its values in mm must not be taken for a missing focal length.
    plain = _POINT.sub(" ", text)
    named = _FOCAL.search(plain)
    focal = _IN_MM.search(plain, named.end()) if named is not None else None
    values, listed = _values(source, text)
    missing = [name for name in _PARAMETERS if name in listed.union(_NEEDED) and name not in values]
    if focal is None:
        missing.insert(0, "the Calibrated Focal Length in mm")
    if focal is None or missing:
        raise source.error(f"{', '.join(missing)} not found in this SMAC report; write each as NAME = VALUE")
    c = _number(source, "the Calibrated Focal Length", focal[1])
    if not c > 0:
        raise source.error(f"focal length {c:g} mm is not positive; give a positive one")
    sensor, assumed = _sensor(source, text)
    coefficients = {name.lower(): value for name, value in values.items() if name[0] in "KP"}
    interior = InteriorOrientation(c, values["xp"], values["yp"], Smac(**coefficients, sign="add"))  # type: ignore[arg-type]
    return CameraFile(source.path.stem, sensor, jax.tree.map(as_jax_array, interior), None, assumed)


def write_smac_report(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera with the distortion `Smac`, converted exactly to R0 = 0 and sign "add"."""
    d = interior.distortion
    at_zero = rebalance(interior, 0.0) if isinstance(d, Smac) and float(d.r0) != 0 else interior
    interior = with_sign(at_zero, "add")
    d, c = interior.distortion, float(interior.c)
    value = lambda key: f"{key.upper()} = {float(getattr(d, key))!r}"  # noqa: E731
    lines = [
        "REPORT OF CALIBRATION",
        f"Camera: {name}",
        f"Image format: {sensor.width_px} x {sensor.height_px} pixels of {float(sensor.pixel_mm)!r} mm",
        "",
        f"I. Calibrated Focal Length: {c!r} mm",
        "",
        "II. Lens Distortion",
        "Symmetric radial distortion parameters (mm)",
        *(f"  {value(k)}" for k in ("k0", "k1", "k2", "k3", "k4")),
        "Decentering distortion parameters (mm)",
        *(f"  {value(p)}" for p in ("p1", "p2", "p3", "p4")),
        "Calibrated principal point",
        f"  xp = {float(interior.x_p)!r} mm",
        f"  yp = {float(interior.y_p)!r} mm",
        "",
        "Simultaneous Multiframe Analytical Calibration (SMAC): the distortion is added to measured coordinates",
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _values(source: CameraSource, text: str) -> tuple[dict[str, float], set[str]]:
    """Return values by name, and all names in the text.

    Each name precedes its value. Text extracted from a PDF may list all names of a column, then all signs, then all
    values.
    """
    tokens = [(m.lastgroup, m.group()) for m in _TOKEN.finditer(text)]
    values: dict[str, float] = {}
    waiting: collections.deque[str] = collections.deque()
    signs = k = 0
    while k < len(tokens):
        kind, token = tokens[k]
        if kind == "name" and [t[0] for t in tokens[k + 1 : k + 3]] == ["equals", "number"]:
            values.setdefault(token, _number(source, token, tokens[k + 2][1]))
            k += 3
            continue
        if kind == "name":
            waiting.append(token)
        elif kind == "equals":
            signs += 1
        elif signs and waiting:
            name = waiting.popleft()
            values.setdefault(name, _number(source, name, token))
            signs -= 1
        k += 1
    return values, {token for kind, token in tokens if kind == "name"}


def _number(source: CameraSource, name: str, text: str) -> float:
    plain = re.sub(r"\s", "", text).replace("−", "-")
    return source.number(name, re.sub(r"[x×*]10(\^|\*\*)?|[dD]", "e", plain))


def _sensor(source: CameraSource, text: str) -> tuple[Sensor, str]:
    written = _FORMAT.search(text)
    if written is not None:
        width, height, pixel = written.groups()
        return source.sensor(float(width), float(height), _number(source, "the size of a pixel", pixel))
    pixel = source.pixel_mm if source.pixel_mm is not None else _FILM_PIXEL_MM
    if source.size_px is not None:
        return source.sensor(*source.size_px)
    side = round(_FILM_MM / pixel) if pixel > 0 else 0
    sensor, note = source.sensor(side, side, pixel)
    return sensor, joined_notes(
        note, f"the report gives no format; {_FILM_MM} mm square in pixels of {pixel:g} mm assumed"
    )


CAMERAS = (
    CameraFormat(
        "smac", CameraReader(_recognise, read_smac_report), write_smac_report,
        CameraModel(Smac, (), Perspective()), suffixes=(".txt", ".rpt"),
    ),
)  # fmt: skip
