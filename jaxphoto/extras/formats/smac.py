"""SMAC parameters in a USGS "Report of Calibration", as text, each as NAME = VALUE.

Coordinates are in mm, x right and y up from the indicated principal point; distortion is added (`Smac`, sign "add").
Reports do not contain the pixel size; unless the user specifies it, the format of aerial film is assumed. Source: USGS
report OSL/2985.
"""

import re
from pathlib import Path

import jax

from jaxphoto.arrays import as_jax_array
from jaxphoto.camera import InteriorOrientation, Smac
from jaxphoto.extras.formats.files import CameraFormat
from jaxphoto.io.camera_files import CameraFile, CameraReader, CameraSource, joined_notes

_NEEDED = ("K0", "K1", "K2", "xp", "yp")
# Side of the film format (mm): 9 inches.
_FILM_MM, _FILM_PIXEL_MM = 228.6, 0.01
# Powers are printed as 0.2616 x 10-4 or 0.2616E-04, with two kinds of minus signs.
_NUMBER = r"([-+−]?\s?[\d.]+(?:[eEdD][-+−]?\d+|\s*[x×*]\s*10\s*(?:\^|\*\*)?\s*[-+−]?\s?\d*)?)"
_VALUE = re.compile(rf"\b(K[0-4]|P[1-4]|[xy]p)\s*=\s*{_NUMBER}")
_FOCAL = re.compile(rf"calibrated\s+focal\s+length\D*?{_NUMBER}\s*mm", re.IGNORECASE)


def _recognise(path: Path, text: str) -> bool:
    return re.search(r"calibrated\s+focal\s+length", text, re.IGNORECASE) is not None and "K1" in text


def read_smac_report(source: CameraSource) -> CameraFile:
    """Read the camera of a report. Raise InputError for missing parameters."""
    text = source.text()
    listed, focal = dict(_VALUE.findall(text)), _FOCAL.search(text)
    missing = [name for name in re.findall(r"\b(?:K[0-4]|P[1-4])\b", text) if name not in listed]
    missing += [name for name in _NEEDED if name not in listed]
    if focal is None or missing:
        names = ["the Calibrated Focal Length in mm"] * (focal is None) + list(dict.fromkeys(missing))
        raise source.error(f"{', '.join(names)} not found in this SMAC report; write each as NAME = VALUE")
    values = {name: _number(source, name, value) for name, value in listed.items()}
    c, pixel = _number(source, "the Calibrated Focal Length", focal[1]), source.pixel_mm or _FILM_PIXEL_MM
    if not c > 0:
        raise source.error(f"focal length {c:g} mm is not positive; give a positive one")
    side = round(_FILM_MM / pixel)
    sensor, assumed = source.sensor(*(source.size_px or (side, side)), None if source.size_px else pixel)
    note = (
        "" if source.size_px else f"the report gives no format; {_FILM_MM} mm square in pixels of {pixel:g} mm assumed"
    )
    coefficients = {name.lower(): value for name, value in values.items() if name[0] in "KP"}
    interior = InteriorOrientation(c, values["xp"], values["yp"], Smac(**coefficients, sign="add"))  # type: ignore[arg-type]
    return CameraFile(source.path.stem, sensor, jax.tree.map(as_jax_array, interior), None, joined_notes(assumed, note))


def _number(source: CameraSource, name: str, text: str) -> float:
    plain = re.sub(r"\s", "", text).replace("−", "-")
    return source.number(name, re.sub(r"[x×*]10(\^|\*\*)?|[dD]", "e", plain))


CAMERAS = (CameraFormat("smac", CameraReader(_recognise, read_smac_report)),)
