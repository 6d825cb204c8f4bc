"""When a photograph was taken: EXIF to the second or finer, and how far that clock is from UTC."""

import re
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from jaxphoto.georeferencing.exposure_times import Taken

_EPOCH = datetime(1980, 1, 6)
_ORIGINAL, _DIGITS, _ZONE = 0x9003, 0x9291, 0x9011
_GPS_TIME, _GPS_DATE = 7, 29


def taken(exif: Mapping[int, Any], gps: Mapping[int, Any], utc: datetime | None) -> Taken | None:
    """The time of exposure: UTC of a drone's packet first, then DateTimeOriginal; None where EXIF has none.

    How far the camera's clock is ahead of UTC comes from OffsetTimeOriginal, else from the receiver's own time.
    """
    if utc is not None:
        return Taken(seconds(utc), 1e-6 if utc.microsecond else 1.0, 0.0)
    text = _text(exif.get(_ORIGINAL))
    try:
        clock = seconds(datetime.strptime(text[:19], "%Y:%m:%d %H:%M:%S"))
    except ValueError:
        return None
    digits = _text(exif.get(_DIGITS)).strip()
    finer = bool(re.fullmatch(r"[0-9]{1,9}", digits)) and int(digits) > 0
    if finer:
        clock += int(digits) / 10 ** len(digits)
    return Taken(clock, 10.0 ** -len(digits) if finer else 1.0, _ahead(exif, gps, clock))


def seconds(at: datetime) -> float:
    """Since 1980-01-06, in the zone of `at`; leap seconds are not counted."""
    return (at - _EPOCH).total_seconds()


def _ahead(exif: Mapping[int, Any], gps: Mapping[int, Any], clock: float) -> float | None:
    if zone := re.match(r"([+-])(\d\d):(\d\d)", _text(exif.get(_ZONE))):
        hours, minutes = int(zone[2]), int(zone[3])
        return (-1.0 if zone[1] == "-" else 1.0) * (3600 * hours + 60 * minutes)
    try:
        hour, minute, second = (float(part) for part in gps[_GPS_TIME])
        day = datetime.strptime(_text(gps.get(_GPS_DATE))[:10], "%Y:%m:%d")
        ahead = clock - (seconds(day) + 3600 * hour + 60 * minute + second)
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    # Receivers note the second of their last position; a zone is told, and no more.
    return 900.0 * round(ahead / 900.0) if abs(ahead) < 15 * 3600 else None


def _text(value: Any) -> str:
    return value.replace("\0", "").strip() if isinstance(value, str) else ""
