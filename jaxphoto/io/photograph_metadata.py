"""What drones write into the XMP packet of a photograph, as far as positions and attitudes need it.

| make | namespace | position | attitude |
| --- | --- | --- | --- |
| DJI | drone-dji | AbsoluteAltitude, RelativeAltitude, AltitudeType, RtkFlag, RtkStdLon to Hgt | GimbalYawDegree ... |
| | | GpsLatitude, GpsLongitude or GpsLongtitude | |
| Autel | drone, drone-autel | the same names | the same names, or Camera |
| senseFly, Parrot, others | Camera (Pix4D) | GPSXYAccuracy, GPSZAccuracy | Yaw, Pitch, Roll, IMU...Accuracy |
| Parrot | drone-parrot | | CameraYawDegree, CameraPitchDegree, CameraRollDegree |
| Skydio | drone-skydio | Latitude, Longitude, AbsoluteAltitude, RelativeAltitude | CameraOrientationNED: Yaw ... |

Sources: DJI, manuals of the Zenmuse P1 and the Mavic 3E ("XMP Data List": GimbalPitchDegree and others in north, east,
down, order ZYX; RtkFlag 0 none, 16 single, 32 to 49 float, 50 fixed; AbsoluteAltitude "geodetic height"); Pix4D,
"Specifications of XMP Camera tags"; Parrot, "Embedded photo metadata" (accuracies as fractions; Camera.Pitch 38.0 where
CameraPitchDegree is -52.0); Skydio, "Camera and metadata overview".
"""

import re
from collections.abc import Mapping
from datetime import datetime
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.georeferencing.camera_attitude import (
    USUAL_SIGMA_DEG,
    CameraAttitude,
    level_from_belly,
    level_from_gimbal,
)
from jaxphoto.georeferencing.gps import Fix, Heights

# Attributes or elements, however the packet is laid out: an XML parser refuses packets that cameras cut off.
_FIELD = re.compile(
    rb"(?<![/\w-])(drone-(?:dji|autel|parrot|skydio)|drone|[Cc]amera|CRSInfo):(\w+)"
    rb"\s*(?:=\s*[\"']([^\"']{0,100})[\"']|>([^<]{0,100})<)"
)
# The three angles are written for several frames, one element each.
_SKYDIO = re.compile(
    rb"<drone-skydio:CameraOrientationNED\b(.{0,2000}?)(?:/>|</drone-skydio:CameraOrientationNED)", re.DOTALL
)
# Of a packet, what is looked at; it lies in one segment of 64 kilobytes in a JPEG.
_MOST_BYTES = 1_000_000
_DJI_LIKE = ("drone-dji", "drone-autel", "drone")
_FULL_TURN_DEG = 360.0


class DroneRecord(NamedTuple):
    """What an XMP packet says; None where it does not."""

    latitude_longitude_deg: tuple[float, float] | None = None
    altitude_m: float | None = None
    above_takeoff_m: float | None = None
    heights: Heights = "unknown"
    """Of `altitude_m`, or of the height of EXIF where the packet has none."""
    sigma_m: tuple[float, float, float] | None = None
    """East, north and up."""
    fix: Fix = "unknown"
    attitude: CameraAttitude | None = None
    aircraft_deg: tuple[float, float, float] | None = None
    """Roll, pitch and yaw."""
    utc: datetime | None = None
    """Of the exposure, to the microsecond where DJI writes it; without a zone."""


def xmp_fields(packet: Any) -> dict[str, str]:
    """The attributes of drones in a packet by `namespace:name`; none where it is absent or another's."""
    if not isinstance(packet, bytes | str):
        return {}
    content = (packet.encode("utf-8", "replace") if isinstance(packet, str) else packet)[:_MOST_BYTES]
    fields = _fields(_FIELD.findall(content))
    if found := _SKYDIO.search(content):
        turned = _fields(_FIELD.findall(found[1]))
        fields |= {f"CameraOrientationNED:{key.partition(':')[2]}": value for key, value in turned.items()}
    return fields


def _fields(found: list[tuple[bytes, bytes, bytes, bytes]]) -> dict[str, str]:
    named = {}
    for space, name, given, inner in found:
        prefix = "Camera" if space == b"camera" else space.decode()
        named[f"{prefix}:{name.decode()}"] = (given or inner).decode("utf-8", "replace").strip()
    return named


def drone_record(fields: Mapping[str, str]) -> DroneRecord:
    """What the attributes say of position and attitude; numbers that are none say nothing."""
    space = next((s for s in _DJI_LIKE if any(key.startswith(f"{s}:") for key in fields)), "")
    record = _dji(fields, space) if space else DroneRecord()
    if (skydio := _number(fields, "drone-skydio:AbsoluteAltitude")) is not None:
        record = record._replace(altitude_m=skydio, above_takeoff_m=_number(fields, "drone-skydio:RelativeAltitude"))
    plan, height = _number(fields, "Camera:GPSXYAccuracy"), _number(fields, "Camera:GPSZAccuracy")
    if record.sigma_m is None and plan and height and min(plan, height) > 0:
        record = record._replace(sigma_m=(plan, plan, height))
    if record.heights == "unknown":
        record = record._replace(heights=_vertical(fields))
    return record._replace(attitude=_attitude(fields, space), latitude_longitude_deg=_plan(fields, space))


def _plan(fields: Mapping[str, str], space: str) -> tuple[float, float] | None:
    for latitude, longitude in (
        (f"{space}:GpsLatitude", f"{space}:GpsLongitude"),
        # As DJI wrote it for years.
        (f"{space}:GpsLatitude", f"{space}:GpsLongtitude"),
        ("drone-skydio:Latitude", "drone-skydio:Longitude"),
    ):
        north, east = _number(fields, latitude), _number(fields, longitude)
        if north is not None and east is not None:
            return north, east
    return None


def _dji(fields: Mapping[str, str], space: str) -> DroneRecord:
    """The packet of DJI, or of another with the same names."""
    number = lambda name: _number(fields, f"{space}:{name}")  # noqa: E731
    flag = number("RtkFlag")
    sigma = [number(f"RtkStd{axis}") for axis in ("Lon", "Lat", "Hgt")]
    flown = [number(f"Flight{axis}Degree") for axis in ("Roll", "Pitch", "Yaw")]
    # Without corrections it is the barometer's, or a mixture, whose zero DJI does not document.
    ellipsoid = fields.get(f"{space}:AltitudeType", "") == "RtkAlt" or (flag is not None and flag > 0)
    return DroneRecord(
        altitude_m=number("AbsoluteAltitude"),
        above_takeoff_m=number("RelativeAltitude"),
        heights="ellipsoid" if ellipsoid else "unknown",
        # Without corrections they are not those of the position.
        sigma_m=None if flag == 0 else _three(sigma, least=0.0),
        fix=fix_of(flag),
        aircraft_deg=_three(flown, most=_FULL_TURN_DEG),
        utc=_utc(fields.get(f"{space}:UTCAtExposure", "")),
    )


def fix_of(flag: float | None) -> Fix:
    """The kind of solution of DJI's flag: 16 single, 32 to 49 float, 50 and more fixed."""
    if flag is None or not flag > 0:
        return "unknown"
    return "single" if flag < 32 else "float" if flag < 50 else "fixed"


def _vertical(fields: Mapping[str, str]) -> Heights:
    said = fields.get("CRSInfo:VERTCRS") or fields.get("Camera:VertCS") or fields.get("Camera:VerticalCS") or ""
    if "ellips" in said.lower() or said.strip().upper() in ("WGS84", "WGS 84"):
        return "ellipsoid"
    return "geoid" if re.search(r"EGM|NAVD|MSL|geoid|EPSG:5\d{3}", said, re.IGNORECASE) else "unknown"


def _attitude(fields: Mapping[str, str], space: str) -> CameraAttitude | None:
    gimbal = [f"{space}:Gimbal{axis}Degree" for axis in ("Yaw", "Pitch", "Roll")]
    upside_down = any((_number(fields, f"{space}:{name}") or 0) != 0 for name in ("CamReverse", "GimbalReverse"))
    for names, matrix, skipped in (
        (gimbal, level_from_gimbal, upside_down),
        ([f"drone-parrot:Camera{axis}Degree" for axis in ("Yaw", "Pitch", "Roll")], level_from_gimbal, False),
        ([f"CameraOrientationNED:{axis}" for axis in ("Yaw", "Pitch", "Roll")], level_from_gimbal, False),
        ([f"Camera:{axis}" for axis in ("Yaw", "Pitch", "Roll")], level_from_belly, False),
    ):
        angles = _three([_number(fields, name) for name in names], most=_FULL_TURN_DEG)
        if angles is not None and not skipped:
            said = _three([_number(fields, f"Camera:IMU{a}Accuracy") for a in ("Roll", "Pitch", "Yaw")], least=0.0)
            return CameraAttitude(matrix(*angles), said or USUAL_SIGMA_DEG)
    return None


def _three(values: list[float | None], least: float | None = None, most: float = np.inf):
    """The three numbers, None unless all are there, more than `least` and of no larger size than `most`."""
    known = [v for v in values if v is not None and (least is None or v > least) and abs(v) <= most]
    return (known[0], known[1], known[2]) if len(known) == 3 else None


def _number(fields: Mapping[str, str], name: str) -> float | None:
    """A finite number, which Parrot writes as a fraction."""
    text = fields.get(name, "")
    try:
        value = float(Fraction(text)) if re.fullmatch(r"-?\d{1,15}/\d{1,15}", text) else float(text)
    except (ValueError, ZeroDivisionError, OverflowError):
        return None
    return value if np.isfinite(value) else None


def _utc(text: str) -> datetime | None:
    """DJI writes 2023-04-05T06:07:08.123456, or with blanks."""
    try:
        return datetime.fromisoformat(text.strip().rstrip("Z")).replace(tzinfo=None)
    except ValueError:
        return None
