"""Conditions of exposure from EXIF and XMP, and the table conditions.csv of a result folder.

DJI writes the serial numbers of camera and drone, and the temperatures of lens and sensor, into XMP.
"""

import io
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxphoto.camera.conditions import NUMBERS, TEXTS, Conditions
from jaxphoto.errors import InputError
from jaxphoto.io.photographs import TAG, Exif, number, open_picture, read_exif, text
from jaxphoto.io.text_files import read_text
from jaxphoto.writing import input_file

CONDITIONS = "conditions.csv"
# Tags of EXIF 2.31 without a name in Pillow.
_TEMPERATURE, _HUMIDITY, _PRESSURE = 0x9400, 0x9401, 0x9402
_TIME = re.compile(r"(\d{4}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)")


def conditions_of(path: Path, used: bool = True) -> Conditions:
    """Read the conditions of one photograph; fields are empty if its EXIF is damaged."""
    known = Conditions(path.stem, path.name, input_file(path).sha256, used)
    try:
        with open_picture(path) as picture:
            return known._replace(**_conditions(read_exif(picture)))
    # Pillow raises many errors for damaged bytes.
    except Exception:
        return known


def _conditions(exif: Exif) -> dict[str, Any]:
    top, shot = exif.top, exif.shot
    xmp = {key.partition(":")[2]: value for key, value in exif.xmp.items()}
    iso = shot.get(TAG.ISOSpeedRatings)
    positive = {
        "focal_length_mm": shot.get(TAG.FocalLength),
        "f_number": shot.get(TAG.FNumber),
        "exposure_s": shot.get(TAG.ExposureTime),
        "iso": iso[0] if isinstance(iso, tuple) and iso else iso,
        "subject_distance_m": shot.get(TAG.SubjectDistance),
    }
    return {name: number(value, positive=True) for name, value in positive.items()} | {
        "time": _time(shot),
        "make": text(top.get(TAG.Make)),
        "model": text(top.get(TAG.Model)),
        "serial": text(shot.get(TAG.BodySerialNumber)) or text(xmp.get("CameraSerialNumber")),
        "lens": " ".join(filter(None, (text(shot.get(tag)) for tag in (TAG.LensMake, TAG.LensModel)))),
        "lens_serial": text(shot.get(TAG.LensSerialNumber)),
        "drone": " ".join(filter(None, (text(xmp.get(key)) for key in ("DroneModel", "DroneSerialNumber")))),
        "firmware": text(top.get(TAG.Software)),
        "temperature_c": number(shot.get(_TEMPERATURE)),
        "lens_temperature_c": number(xmp.get("LensTemperature")),
        "sensor_temperature_c": number(xmp.get("SensorTemperature")),
        "humidity_percent": number(shot.get(_HUMIDITY)),
        "pressure_hpa": number(shot.get(_PRESSURE)),
    }


def _time(shot: Any) -> str:
    match = _TIME.match(text(shot.get(TAG.DateTimeOriginal)))
    if not match:
        return ""
    fraction, offset = text(shot.get(TAG.SubsecTimeOriginal)), text(shot.get(TAG.OffsetTimeOriginal))
    time = "{}-{}-{} {}".format(*match.groups()) + (f".{fraction}" if re.fullmatch(r"[0-9]+", fraction) else "")
    return time + (offset if re.fullmatch(r"[+-]\d\d:\d\d|Z", offset) else "")


def marked(conditions: Sequence[Conditions], used: Collection[str]) -> list[Conditions]:
    """Set `used` of each photograph: True for the images `used` of a block."""
    return [one._replace(used=one.image in used) for one in conditions]


def write_conditions(conditions: Sequence[Conditions], folder: Path, used: Collection[str]) -> None:
    """Write conditions.csv, one row per photograph; `used` lists the images of the block."""
    pd.DataFrame(marked(conditions, used), columns=Conditions._fields).to_csv(folder / CONDITIONS, index=False)


def read_conditions(path: Path) -> list[Conditions]:
    """Read conditions.csv. Raises InputError for missing columns or an empty table."""
    content = io.StringIO(read_text(path))
    try:
        table = pd.read_csv(content, dtype=str, keep_default_na=False)
        numbers = {name: pd.to_numeric(table[name]) for name in NUMBERS if name in table}
        valid = table["sha256"].str.fullmatch("[0-9a-f]{64}") & table["used"].isin(["True", "False"])
        table = table.assign(used=table["used"] == "True")[
            ["image", "file", "sha256", "used", *table.columns.intersection(list(TEXTS))]
        ]
    except (KeyError, ValueError) as error:
        raise InputError(f"{path.name}: not a table of photographs ({error}); rewrite the results") from None
    if not valid.all() or table.empty:
        where = f", row {int(np.argmin(valid)) + 2}" if len(table) else ""
        raise InputError(f"{path.name}{where}: invalid sha256 or used; rewrite the results")
    rows = table.to_dict("records")
    for name, values in numbers.items():
        for row, value in zip(rows, values.tolist(), strict=True):
            row[name] = value if np.isfinite(value) else None
    return [Conditions(**{str(key): value for key, value in row.items()}) for row in rows]
