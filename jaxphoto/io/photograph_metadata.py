"""Metadata of photographs: EXIF, read by Pillow, and the XMP packets of drones.

| make | namespace | position | attitude |
| --- | --- | --- | --- |
| DJI | drone-dji | AbsoluteAltitude, RelativeAltitude, AltitudeType, RtkFlag, RtkStdLon to Hgt, | GimbalYawDegree ... |
| | | GpsLatitude, GpsLongitude or GpsLongtitude, UTCAtExposure | FlightYawDegree ... |
| Autel | drone, drone-autel | as DJI | as DJI, or Camera |
| senseFly, Parrot, others | Camera (Pix4D) | GPSXYAccuracy, GPSZAccuracy, VertCS | Yaw, Pitch, Roll, IMU...Accuracy |
| Parrot | drone-parrot | | CameraYawDegree, CameraPitchDegree, CameraRollDegree |
| Skydio | drone-skydio | Latitude, Longitude, AbsoluteAltitude, RelativeAltitude | CameraOrientationNED: Yaw ... |

Sources: DJI, manuals of the Zenmuse P1 and the Mavic 3E ("XMP Data List": gimbal angles in north, east, down, order
ZYX; RtkFlag 0 none, 16 single, 32 to 49 float, 50 fixed); Pix4D, "Specifications of XMP Camera tags"; Parrot, "Embedded
photo metadata" (accuracies as fractions); Skydio, "Camera and metadata overview"; EXIF 2.32 (CIPA DC-008).
"""

import math
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

from PIL import ExifTags, Image

from jaxphoto.georeferencing.camera_attitude import USUAL_SIGMA_DEG, CameraAttitude, level_from_belly, level_from_gimbal
from jaxphoto.georeferencing.gps import Fix, Gps, Heights, Taken, gps_seconds

TAG = ExifTags.Base
# XMP attributes or elements. Search by regular expressions: some packets are truncated or not well-formed XML.
_FIELD = re.compile(
    r"(?<![/\w-])(drone-(?:dji|autel|parrot|skydio)|drone|[Cc]amera|CRSInfo):(\w+)"
    r"\s*(?:=\s*[\"']([^\"']{0,100})[\"']|>([^<]{0,100})<)"
)
# Skydio writes angles in several frames: use the north, east, down frame.
_SKYDIO = re.compile(
    r"<drone-skydio:CameraOrientationNED\b(.{0,2000}?)(?:/>|</drone-skydio:CameraOrientationNED)", re.DOTALL
)
_DJI_LIKE = ("drone-dji", "drone-autel", "drone")
_ANGLES = ("Yaw", "Pitch", "Roll")


@contextmanager
def open_picture(path: Path) -> Iterator[Image.Image]:
    """Open a picture of any size; Pillow's limit of 179 million pixels is too small for aerial cameras."""
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        with warnings.catch_warnings():
            # Ignore Pillow's warnings about damaged EXIF.
            warnings.simplefilter("ignore")
            with Image.open(path) as picture:
                yield picture
    finally:
        Image.MAX_IMAGE_PIXELS = limit


class Exif(NamedTuple):
    """Metadata of a photograph; empty if its EXIF is missing or damaged."""

    top: Mapping[int, Any]
    shot: Mapping[int, Any]
    gps: Mapping[int, Any]
    xmp: Mapping[str, str]
    """XMP attributes of drones, by `namespace:name`."""


def read_exif(picture: Image.Image) -> Exif:
    """Read EXIF and XMP."""
    try:
        top = picture.getexif()
        shot, gps = top.get_ifd(ExifTags.IFD.Exif), top.get_ifd(ExifTags.IFD.GPSInfo)
        return Exif(top, shot, gps, xmp_fields(picture.info.get("xmp")))
    # Pillow raises many errors for damaged bytes.
    except Exception:
        return Exif({}, {}, {}, {})


def number(value: Any, positive: bool = False) -> float | None:
    """Parse a finite number of EXIF or XMP (Parrot writes fractions); None for other values."""
    try:
        result = float(Fraction(value)) if isinstance(value, str) and "/" in value else float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return result if math.isfinite(result) and (result > 0 or not positive) else None


def text(value: Any) -> str:
    """Normalise whitespace in an EXIF text; "" for other values."""
    return " ".join(value.replace("\0", " ").split()) if isinstance(value, str) else ""


def xmp_fields(packet: Any) -> dict[str, str]:
    """Return the attributes of drones in an XMP packet, by `namespace:name`."""
    if isinstance(packet, bytes):
        packet = packet.decode("utf-8", "replace")
    if not isinstance(packet, str):
        return {}
    fields = _fields(packet)
    if match := _SKYDIO.search(packet):
        fields |= {f"CameraOrientationNED:{key.partition(':')[2]}": value for key, value in _fields(match[1]).items()}
    return fields


def _fields(packet: str) -> dict[str, str]:
    return {
        f"{'Camera' if space == 'camera' else space}:{name}": (attribute or element).strip()
        for space, name, attribute, element in _FIELD.findall(packet)
    }


class DroneRecord(NamedTuple):
    """Position and attitude in an XMP packet; None if missing."""

    latitude_longitude_deg: tuple[float, float] | None = None
    altitude_m: float | None = None
    above_takeoff_m: float | None = None
    heights: Heights = "unknown"
    """Reference of `altitude_m`, or of the EXIF height if the packet has no height."""
    sigma_m: tuple[float, float, float] | None = None
    """Standard deviations east, north, up (m)."""
    fix: Fix = "unknown"
    attitude: CameraAttitude | None = None
    aircraft_deg: tuple[float, float, float] | None = None
    """Roll, pitch, yaw of the aircraft (degrees)."""
    utc: datetime | None = None
    """Time of exposure."""


def drone_record(fields: Mapping[str, str]) -> DroneRecord:
    """Return position and attitude from the attributes of a packet."""
    value = lambda name: number(fields.get(name, ""))  # noqa: E731
    space = next((s for s in _DJI_LIKE if any(key.startswith(f"{s}:") for key in fields)), "")
    flag = value(f"{space}:RtkFlag")
    # Without RTK corrections, the height reference is unknown, and stated sigmas do not apply to the position.
    corrected = fields.get(f"{space}:AltitudeType") == "RtkAlt" or (flag is not None and flag > 0)
    sigma = None if flag == 0 else _three([value(f"{space}:RtkStd{axis}") for axis in ("Lon", "Lat", "Hgt")], 0.0)
    plan, height = value("Camera:GPSXYAccuracy"), value("Camera:GPSZAccuracy")
    vertical = fields.get("CRSInfo:VERTCRS") or fields.get("Camera:VertCS") or fields.get("Camera:VerticalCS") or ""
    heights: Heights = "unknown"
    if corrected or re.search(r"ellips|^WGS ?84$", vertical, re.IGNORECASE):
        heights = "ellipsoid"
    elif re.search(r"EGM|NAVD|MSL|geoid|EPSG:5\d{3}", vertical, re.IGNORECASE):
        heights = "geoid"
    above = "drone-skydio" if value("drone-skydio:AbsoluteAltitude") is not None else space
    try:
        # Format: "2023-04-05T06:07:08.123456", or a blank in place of T.
        utc = datetime.fromisoformat(fields.get(f"{space}:UTCAtExposure", "").rstrip("Z")).replace(tzinfo=None)
    except ValueError:
        utc = None
    latitude, longitude = value(f"{space}:GpsLatitude"), value(f"{space}:GpsLongitude")
    # Some firmware writes GpsLongtitude.
    longitude = value(f"{space}:GpsLongtitude") if longitude is None else longitude
    if above != space:
        latitude, longitude = value(f"{above}:Latitude"), value(f"{above}:Longitude")
    return DroneRecord(
        None if latitude is None or longitude is None else (latitude, longitude),
        value(f"{above}:AbsoluteAltitude"),
        value(f"{above}:RelativeAltitude"),
        heights,
        sigma or (_three([plan, plan, height], 0.0) if plan and height else None),
        fix_of(flag),
        _attitude(value, space),
        _three([value(f"{space}:Flight{axis}Degree") for axis in ("Roll", "Pitch", "Yaw")]),
        utc,
    )


def fix_of(flag: float | None) -> Fix:
    """Convert DJI's RTK flag to the kind of solution: 16 single, 32 to 49 float, 50 and more fixed."""
    if flag is None or not flag > 0:
        return "unknown"
    return "single" if flag < 32 else "float" if flag < 50 else "fixed"


def _attitude(value: Callable[[str], float | None], space: str) -> CameraAttitude | None:
    reversed_gimbal = any(value(f"{space}:{name}") for name in ("CamReverse", "GimbalReverse"))
    for names, matrix in (
        ("" if reversed_gimbal else f"{space}:Gimbal{{}}Degree", level_from_gimbal),
        ("drone-parrot:Camera{}Degree", level_from_gimbal),
        ("CameraOrientationNED:{}", level_from_gimbal),
        ("Camera:{}", level_from_belly),
    ):
        angles = _three([value(names.format(axis)) for axis in _ANGLES])
        if angles is not None and max(map(abs, angles)) <= 360:
            sigma = _three([value(f"Camera:IMU{axis}Accuracy") for axis in ("Roll", "Pitch", "Yaw")], 0.0)
            return CameraAttitude(matrix(*angles), sigma or USUAL_SIGMA_DEG)
    return None


def _three(values: Sequence[float | None], above: float = -math.inf) -> tuple[float, float, float] | None:
    """Return the three values if all exist and exceed `above`, else None."""
    a, b, c = values
    return None if a is None or b is None or c is None or min(a, b, c) <= above else (a, b, c)


def gps_position(tags: Mapping[int, Any], drone: DroneRecord) -> Gps | None:
    """Return the position from EXIF, else from the drone's packet, with height and accuracy from the packet.

    Latitudes beyond the poles are retained: `georeferencing.recorded_positions` detects exchanged coordinates.
    """
    try:
        latitude, longitude = (
            sum(float(part) / 60**k for k, part in enumerate(tags[tag]))
            * (-1 if text(tags.get(tag - 1)).upper()[:1] in ("S", "W") else 1)
            for tag in (2, 4)
        )
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        if drone.latitude_longitude_deg is None:
            return None
        latitude, longitude = drone.latitude_longitude_deg
    if not max(abs(latitude), abs(longitude)) <= 180:
        return None
    altitude = drone.altitude_m
    if altitude is None and (exif := number(tags.get(6))) is not None:
        altitude = -exif if tags.get(5) in (1, b"\x01") else exif
    return Gps(latitude, longitude, altitude, drone.sigma_m, drone.heights, drone.fix)


def time_of_exposure(shot: Mapping[int, Any], utc: datetime | None) -> Taken | None:
    """Return the time of exposure: UTC from a drone's packet, else DateTimeOriginal; None if both are missing."""
    if utc is not None:
        return Taken(gps_seconds(utc), 1e-6 if utc.microsecond else 1.0, 0.0)
    try:
        clock = gps_seconds(datetime.strptime(text(shot.get(TAG.DateTimeOriginal))[:19], "%Y:%m:%d %H:%M:%S"))
    except ValueError:
        return None
    digits = text(shot.get(TAG.SubsecTimeOriginal))
    has_fraction = bool(re.fullmatch(r"[0-9]{1,9}", digits)) and int(digits) > 0
    if has_fraction:
        clock += int(digits) / 10 ** len(digits)
    zone = re.match(r"([+-])(\d\d):(\d\d)", text(shot.get(TAG.OffsetTimeOriginal)))
    ahead = (-1.0 if zone[1] == "-" else 1.0) * (3600 * int(zone[2]) + 60 * int(zone[3])) if zone else None
    return Taken(clock, 10.0 ** -len(digits) if has_fraction else 1.0, ahead)
