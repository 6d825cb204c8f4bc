"""How photographs were taken, from EXIF and XMP, and the table conditions.csv of a result folder.

Tags are those of EXIF 2.32 (CIPA DC-008): body and lens serial numbers, temperature, humidity and pressure, times with
fractions and offset. DJI writes the serial numbers of camera and drone, and the temperatures of lens and sensor, into
XMP.
"""

import math
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import ExifTags, Image

from jaxphoto.camera.conditions import NUMBERS, TEXTS, Conditions
from jaxphoto.errors import InputError
from jaxphoto.io.names import LONGEST, harm_in
from jaxphoto.io.photograph_metadata import xmp_fields
from jaxphoto.io.picture_size import pictures_of_any_size
from jaxphoto.io.text_tables import LARGEST, read_csv
from jaxphoto.writing.inputs import input_file

CONDITIONS = "conditions.csv"
_TAG = ExifTags.Base
# EXIF 2.31 and later; Pillow has no names for them.
_TEMPERATURE, _HUMIDITY, _PRESSURE = 0x9400, 0x9401, 0x9402
_TIME = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)")
_SHA256 = re.compile(r"[0-9a-f]{64}")


def conditions_of(path: Path, used: bool = True) -> Conditions:
    """What the file of one photograph says of how it was taken; damaged EXIF says nothing."""
    read = input_file(path)
    known = Conditions(path.stem, path.name, read.sha256, used)
    try:
        with pictures_of_any_size(), Image.open(path) as picture:
            top = picture.getexif()
            return known._replace(**_said(top, top.get_ifd(ExifTags.IFD.Exif), _xmp(picture.info.get("xmp"))))
    # On bytes that are not what they should be Pillow raises what its formats do, each in its own way.
    except Exception:
        return known


def _said(top: Any, taken: dict, xmp: dict[str, str]) -> dict[str, Any]:
    lens = (taken.get(_TAG.LensMake), taken.get(_TAG.LensModel))
    return {
        "time": _time(taken),
        "make": _words(top.get(_TAG.Make)),
        "model": _words(top.get(_TAG.Model)),
        "serial": _words(taken.get(_TAG.BodySerialNumber)) or _words(xmp.get("CameraSerialNumber")),
        "lens": " ".join(filter(None, map(_words, lens))),
        "lens_serial": _words(taken.get(_TAG.LensSerialNumber)),
        "drone": " ".join(filter(None, (_words(xmp.get(k)) for k in ("DroneModel", "DroneSerialNumber")))),
        "firmware": _words(top.get(_TAG.Software)),
        "focal_length_mm": _number(taken.get(_TAG.FocalLength), positive=True),
        "f_number": _number(taken.get(_TAG.FNumber), positive=True),
        "exposure_s": _number(taken.get(_TAG.ExposureTime), positive=True),
        "iso": _number(_first(taken.get(_TAG.ISOSpeedRatings)), positive=True),
        "subject_distance_m": _number(taken.get(_TAG.SubjectDistance), positive=True),
        "temperature_c": _number(taken.get(_TEMPERATURE)),
        "lens_temperature_c": _number(xmp.get("LensTemperature")),
        "sensor_temperature_c": _number(xmp.get("SensorTemperature")),
        "humidity_percent": _number(taken.get(_HUMIDITY)),
        "pressure_hpa": _number(taken.get(_PRESSURE)),
    }


def _time(taken: dict) -> str:
    found = _TIME.match(_words(taken.get(_TAG.DateTimeOriginal)))
    if not found:
        return ""
    fraction = _words(taken.get(_TAG.SubsecTimeOriginal))
    # Not as words are looked at: those that begin with a plus sign could be formulas.
    offset = str(taken.get(_TAG.OffsetTimeOriginal, "")).strip("\0 ")
    said = "{}-{}-{} {}".format(*found.groups())
    said += f".{fraction}" if fraction.isascii() and fraction.isdigit() else ""
    return said + (offset if re.fullmatch(r"[+-]\d\d:\d\d|Z", offset) else "")


def _xmp(packet: Any) -> dict[str, str]:
    """The attributes of a drone's packet by their names, whatever the namespace."""
    return {key.partition(":")[2]: value for key, value in xmp_fields(packet).items()}


def _words(value: Any) -> str:
    """A text of a file, "" where there is none or it would do harm where results show it."""
    words = " ".join(value.replace("\0", " ").split()) if isinstance(value, str) else ""
    return "" if len(words) > LONGEST or harm_in(words) else words


def _first(value: Any) -> Any:
    return value[0] if isinstance(value, tuple) and value else value


def _number(value: Any, positive: bool = False) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    known = math.isfinite(number) and abs(number) <= LARGEST and (number > 0 or not positive)
    return number if known else None


def marked(conditions: Sequence[Conditions], used: Collection[str]) -> list[Conditions]:
    """The same, those of the images `used` marked as that, and no others."""
    return [one._replace(used=one.image in used) for one in conditions]


def write_conditions(conditions: Sequence[Conditions], folder: Path, used: Collection[str]) -> None:
    """conditions.csv: a row each photograph, columns as of `Conditions`; `used` are the images of the block."""
    rows = marked(conditions, used)
    pd.DataFrame(rows, columns=Conditions._fields).to_csv(folder / CONDITIONS, index=False)


def read_conditions(path: Path) -> list[Conditions]:
    """The rows of a conditions.csv. Raises InputError for what is none."""
    words = ("image", "file", "sha256", "used", *TEXTS)
    table = read_csv(path, ("image", "file", "sha256", "used"), (*TEXTS, *NUMBERS), text=words)
    columns = {name: table.text(name).tolist() for name in words}
    columns |= {
        name: [None if math.isnan(v) else v for v in table.numbers(name, empty=True).tolist()] for name in NUMBERS
    }
    for line, (digest, used) in enumerate(zip(columns["sha256"], columns["used"], strict=True)):
        if not _SHA256.fullmatch(digest):
            raise table.bad(line, "sha256 is not 64 hexadecimal digits; write the results anew")
        if used not in ("True", "False"):
            raise table.bad(line, "used is neither True nor False; write the results anew")
    columns["used"] = [used == "True" for used in columns["used"]]
    rows = [Conditions(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]
    if not rows:
        raise InputError(f"{path.name}: there is no photograph in it; write the results anew")
    return rows
