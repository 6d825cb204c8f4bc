"""Photographs: metadata of their files, initial interior orientation, and selection of the valid ones of a folder.

Photographs are used as stored, in sensor orientation: the EXIF orientation flag is not applied.

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
import os
import re
import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

from PIL import ExifTags, Image

from jaxphoto.camera import AbstractDistortion, InteriorOrientation, Sensor
from jaxphoto.camera.lens_prior import lens_prior
from jaxphoto.errors import InputError, counted, few
from jaxphoto.georeferencing.camera_attitude import USUAL_SIGMA_DEG, CameraAttitude, level_from_belly, level_from_gimbal
from jaxphoto.georeferencing.recorded_positions import Fix, Gps, Heights, Taken, gps_seconds
from jaxphoto.procedures.known_lens import KnownLens
from jaxphoto.writing import MARKER, input_file

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


_DIAGONAL_35_MM = math.hypot(36, 24)
# Valid range (mm) of the 35 mm equivalent focal length; some cameras write 1 or 65535 if it is unknown.
_FILM_MM = (5.0, 5000.0)
# Without EXIF: c / longer side (field of view 45 degrees), and its relative sigma (fields of 20 to 80 degrees).
_USUAL_C, _USUAL_C_SIGMA = 1.2, 0.5
_NOMINAL_PIXEL_MM = 0.005
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff")
"""File name extensions of photographs."""


class Photograph(NamedTuple):
    """Metadata of a photograph; None if missing in EXIF."""

    name: str
    """File name without extension: the id of the image."""
    path: Path
    width_px: int
    height_px: int
    make: str | None = None
    model: str | None = None
    focal_length_mm: float | None = None
    focal_length_35mm_mm: float | None = None
    """Focal length with the same field of view on 36 mm x 24 mm film."""
    sensor_width_mm: float | None = None
    """Sensor width from the focal plane resolution and the image size in EXIF."""
    orientation: int = 1
    """EXIF orientation flag, 1 to 8."""
    gps: Gps | None = None
    above_takeoff_m: float | None = None
    attitude: CameraAttitude | None = None
    aircraft_deg: tuple[float, float, float] | None = None
    """Roll, pitch and yaw of the aircraft (degrees), if the camera is on a gimbal."""
    taken: Taken | None = None
    serial: str | None = None
    """Serial number of the camera body."""
    digital_zoom: float = 1.0


class CameraStart(NamedTuple):
    """Camera of photographs before calibration."""

    sensor: Sensor
    interior: InteriorOrientation
    origin: str
    """Sentence about the origin of pixel size and principal distance."""
    c_rounding: float = 0.0
    """Relative standard deviation of c, in pixels, due to rounding in EXIF."""


def photographs(paths: Sequence[str | Path]) -> list[Photograph]:
    """Read the photographs `paths`. Raises InputError for missing files, other formats, and duplicate names."""
    read: dict[str, Photograph] = {}
    for path in map(Path, paths):
        photograph = read_photograph(path)
        other = read.setdefault(path.stem, photograph)
        if other is not photograph:
            raise InputError(f"{other.path} and {path} both have the image name {path.stem!r}; rename or omit one")
    return list(read.values())


def read_photograph(path: Path) -> Photograph:
    """Read the metadata of a photograph. Raises InputError for a missing file or another format."""
    if path.is_dir():
        raise InputError(f"{path} is a folder; give its photographs, for example {path}/*.jpg")
    if not path.is_file():
        problem = "the target of this link is missing" if path.is_symlink() else "photograph not found"
        raise InputError(f"{path}: {problem}; correct the name")
    try:
        with open_picture(path) as picture:
            return _photograph(path, *picture.size, read_exif(picture))
    # Pillow raises many kinds of exceptions for damaged bytes.
    except Exception as error:
        raise InputError(f"{path}: not a readable image; give a TIFF, PNG or JPEG") from error


def _photograph(path: Path, width_px: int, height_px: int, exif: Exif) -> Photograph:
    top, shot = exif.top, exif.shot
    drone = drone_record(exif.xmp)
    film = number(shot.get(TAG.FocalLengthIn35mmFilm), positive=True)
    flag = top.get(TAG.Orientation, 1)
    serial = next((value for key, value in exif.xmp.items() if key.endswith(":CameraSerialNumber")), "")
    return Photograph(
        path.stem,
        path,
        width_px,
        height_px,
        text(top.get(TAG.Make)) or None,
        text(top.get(TAG.Model)) or None,
        number(shot.get(TAG.FocalLength), positive=True),
        film if film is not None and _FILM_MM[0] <= film <= _FILM_MM[1] else None,
        _sensor_width(shot, width_px, height_px),
        flag if flag in range(1, 9) else 1,
        gps_position(exif.gps, drone),
        drone.above_takeoff_m,
        drone.attitude,
        drone.aircraft_deg,
        time_of_exposure(shot, drone.utc),
        text(shot.get(TAG.BodySerialNumber)) or serial or None,
        # Zero means no digital zoom.
        number(shot.get(TAG.DigitalZoomRatio), positive=True) or 1.0,
    )


def _sensor_width(shot: Mapping, width_px: int, height_px: int) -> float | None:
    """Return the sensor width (mm) from image size and focal plane resolution in EXIF; None for cropped photographs."""
    resolution = number(shot.get(TAG.FocalPlaneXResolution), positive=True)
    unit = _UNIT_MM.get(shot.get(TAG.FocalPlaneResolutionUnit, 2))
    if resolution is None or unit is None:
        return None
    width = number(shot.get(TAG.ExifImageWidth), positive=True) or width_px
    height = number(shot.get(TAG.ExifImageHeight), positive=True) or height_px
    cropped = abs(width * height_px / (height * width_px) - 1) > 0.01
    return None if cropped else width / resolution * unit


def sensor_and_interior(
    photographs: Sequence[Photograph], pixel_mm: float | None = None, c_mm: float | None = None
) -> CameraStart:
    """Return the initial camera of `photographs`, which share one camera, from the arguments, else from EXIF.

    The pixel size follows from the focal plane resolution, or from the focal length f and the 35 mm equivalent focal
    length f35: the sensor diagonal is 43.27 mm f / f35. The principal distance is f. With a given pixel size it follows
    from f35 if possible, which is independent of resizing. Without EXIF it is 1.2 times the longer side. The distortion
    is zero.

    Raises InputError without photographs, for different cameras (`ONE_CAMERA`), and for c_mm without a pixel size.
    """
    if not photographs:
        raise InputError("no photographs; give the files of one camera")
    for name, value in (("pixel_mm", pixel_mm), ("c_mm", c_mm)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} is {value:g}; give a positive number of millimetres")
    for name, value_of, cure in ONE_CAMERA if c_mm is None else ONE_CAMERA[:-1]:
        groups: dict[Hashable, list[str]] = {}
        for p in photographs:
            if value_of(p) is not None:
                groups.setdefault(value_of(p), []).append(p.path.name)
        if len(groups) > 1:
            listed = "; ".join(f"{value}: {few(names)}" for value, names in groups.items())
            raise InputError(f"the photographs of one camera have different {name}s ({listed}); {cure}")
    first = next((p for p in photographs if p.focal_length_35mm_mm or p.focal_length_mm), photographs[0])
    f, f35 = first.focal_length_mm, first.focal_length_35mm_mm
    diagonal_px = math.hypot(first.width_px, first.height_px)
    if pixel_mm is not None:
        pixel, pixel_origin = pixel_mm, "pixel size as given"
    elif first.sensor_width_mm:
        pixel = first.sensor_width_mm / first.width_px
        pixel_origin = "pixel size from the focal plane resolution (EXIF)"
    elif f and f35:
        pixel = _DIAGONAL_35_MM * f / f35 / diagonal_px
        pixel_origin = f"pixel size from the focal lengths {f:g} mm and, on film, {f35:g} mm (EXIF)"
    elif c_mm is not None:
        raise InputError(f"c_mm is given, but no pixel size ({first.path} has none in EXIF); give pixel_mm as well")
    else:
        pixel, pixel_origin = _NOMINAL_PIXEL_MM, "pixel size nominal (not in EXIF); only c in pixels matters"
    assumed = "nominal" in pixel_origin
    if c_mm is not None:
        c, c_origin, rounding = c_mm, "c as given", 0.0
    elif f35 and (assumed or pixel_mm is not None or not f):
        c = f35 / _DIAGONAL_35_MM * diagonal_px * pixel
        c_origin, rounding = f"c from {f35:g} mm on film of 36 mm x 24 mm (EXIF)", _rounding(f35)
    elif f and not assumed:
        # A pixel size computed from f and f35 has the precision of f35, which is rounded to millimetres.
        c, c_origin = f, "c is the focal length of EXIF"
        rounding = _rounding(f if first.sensor_width_mm or pixel_mm is not None else f35 or f)
    else:
        c = _USUAL_C * max(first.width_px, first.height_px) * pixel
        c_origin, rounding = f"c is a guess, {_USUAL_C:g} times the longer side (not in EXIF)", _USUAL_C_SIGMA
    sensor = Sensor(first.width_px, first.height_px, pixel, pixel_assumed=assumed)
    origin = f"c = {c:.6g} mm ({c / pixel:.5g} pixels of {pixel:.4g} mm): {c_origin}; {pixel_origin}."
    return CameraStart(sensor, InteriorOrientation(c), origin, rounding)


def _rounding(mm: float) -> float:
    """Return the relative standard deviation of a focal length that is rounded to its last digit."""
    step = next((step for step in (1.0, 0.1) if abs(mm / step - round(mm / step)) < 1e-6), 0.01)
    return step / math.sqrt(12) / mm


def known_lens(photographs: Sequence[Photograph], camera: CameraStart, distortion: AbstractDistortion) -> KnownLens:
    """Return prior information about the lens by make and model, at `camera` without distortion."""
    first = next((p for p in photographs if p.make or p.model), photographs[0])
    nominal = InteriorOrientation(camera.interior.c, 0.0, 0.0, distortion)
    return KnownLens(nominal, lens_prior(first.make, first.model), camera.c_rounding)


ONE_CAMERA: list[tuple[str, Callable[[Photograph], Hashable], str]] = [
    ("size", lambda p: f"{p.width_px} x {p.height_px} px", "give those of one camera, neither cropped nor resized"),
    (
        "orientation flag",
        # Ignore flags of a rotation by 90 degrees: a photograph of the size of the others is not rotated yet.
        lambda p: None if p.orientation > 4 and p.width_px != p.height_px else p.orientation,
        "a program may have rotated some: if all are in sensor orientation, set one flag (exiftool -n -Orientation=1 "
        "FILES), else omit the rotated ones",
    ),
    ("camera", lambda p: " ".join(filter(None, (p.make, p.model))) or None, "give the photographs of one camera"),
    ("serial number", lambda p: p.serial, "give the photographs of one camera: lenses of one model differ"),
    ("digital zoom", lambda p: f"{p.digital_zoom:.4g}", "give those of one zoom"),
    ("focal length", lambda p: p.focal_length_mm and f"{p.focal_length_mm:.4g} mm", "give those of one zoom"),
]
"""Properties that the photographs of one camera share, and the cure if they differ."""


def valid_photographs(paths: Sequence[str | Path]) -> tuple[list[Photograph], dict[str, str]]:
    """Read the photographs of one camera in `paths`; return them, and the reason for each skipped file.

    `paths` are files and folders. Skipped files: other formats, truncated files, duplicate names, identical copies, and
    files that differ from the majority in a property of `ONE_CAMERA`. Raises InputError for a missing path, and if all
    files are skipped.
    """
    files = list(dict.fromkeys(picture_files(paths)))
    if missing := [file for file in files if not (file.is_file() or file.is_symlink())]:
        raise InputError(f"{missing[0]}: photograph or folder not found; correct the name")
    skipped: dict[str, str] = {}
    originals: dict[str, Photograph] = {}
    by_name: dict[str, Photograph] = {}
    # Among copies, the one with the shortest name is kept: "DJI_0002", not "DJI_0002 (1)".
    for file in sorted(files, key=lambda file: len(file.name)):
        try:
            photograph = read_photograph(file)
            _check_complete(file)
        except InputError as error:
            skipped[str(file)] = str(error)
            continue
        original = originals.setdefault(input_file(file).sha256, photograph)
        if original is not photograph:
            skipped[str(file)] = f"{file}: it is a copy of {original.path}"
        elif by_name.setdefault(photograph.name, photograph) is not photograph:
            skipped[str(file)] = f"{file}: {by_name[photograph.name].path} has the same name; rename one of them"
    kept = {p.path: p for p in by_name.values()}
    valid = [kept[file] for file in files if file in kept]
    for name, value_of, cure in ONE_CAMERA:
        values = Counter(v for p in valid if (v := value_of(p)) is not None)
        usual = values.most_common(1)[0][0] if values else None
        for p in valid:
            if (v := value_of(p)) is not None and v != usual:
                skipped[str(p.path)] = f"{p.path}: its {name} is {v}, that of most is {usual}; {cure}"
        valid = [p for p in valid if str(p.path) not in skipped]
    if not valid:
        hints = [*skipped.values(), *skipped_subfolders(paths).values()][:1]
        raise InputError("; ".join([f"{', '.join(map(str, paths))}: none is a readable photograph", *hints]))
    return valid, skipped


def skipped_messages(skipped: Mapping[str, str]) -> list[str]:
    """Return the reasons for skipped files; more than three files with one reason share one message."""
    files: dict[str, list[str]] = {}
    for path, reason in skipped.items():
        files.setdefault(reason.removeprefix(f"{path}: "), []).append(path)
    messages = []
    for reason, paths in files.items():
        if len(paths) > 3:
            messages.append(f"{len(paths)} files ({few([Path(path).name for path in paths])}), each: {reason}")
        else:
            messages += [skipped[path] for path in paths]
    return messages


def picture_files(paths: Sequence[str | Path]) -> list[Path]:
    """List the files in `paths`, and the photographs in folders of `paths`, by name; hidden files are skipped."""
    files = []
    for path in map(Path, paths):
        inner = sorted(f for f in path.iterdir() if not f.name.startswith(".")) if path.is_dir() else []
        files += [f for f in inner if f.suffix.lower() in SUFFIXES and not f.is_dir()] if path.is_dir() else [path]
    return files


def skipped_subfolders(paths: Sequence[str | Path]) -> dict[str, str]:
    """Return subfolders with photographs that are not in `paths`, with messages; not those that jaxphoto wrote."""
    named, messages = {Path(path).resolve() for path in paths}, {}
    folders = (path for path in map(Path, paths) if path.is_dir())
    for inner in (inner for folder in folders for inner in sorted(folder.iterdir())):
        readable = inner.is_dir() and os.access(inner, os.R_OK | os.X_OK) and not inner.name.startswith(".")
        if readable and inner.resolve() not in named and not (inner / MARKER).exists():
            n = sum(f.suffix.lower() in SUFFIXES and f.suffix.lower() != ".png" for f in inner.iterdir())
            if n:
                messages[str(inner)] = (
                    f"{inner}: {counted(n, 'photograph')} in a subfolder that is not read; add this folder"
                )
    return messages


def _check_complete(file: Path) -> None:
    """Raise InputError for a truncated JPEG or PNG; truncated TIFFs are detected on reading."""
    try:
        with open_picture(file) as picture:
            if picture.format == "JPEG":
                # Decode at one eighth of the size.
                picture.draft("L", (512, 512))
                picture.load()
            else:
                picture.verify()
    except (OSError, SyntaxError) as error:
        raise InputError(f"{file}: the image is cut off or damaged ({error}); copy it again") from error
