"""Photographs: what their files say about the camera, and the interior orientation to start from.

Only sizes and EXIF are read here; the picture itself is what `jaxphoto.extras.photos` reads. A picture is taken as
it lies in the file, which is as the sensor saw it: the EXIF orientation flag turns nothing.
"""

import math
import warnings
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from PIL import ExifTags, Image

from jaxphoto.camera import AbstractDistortion, InteriorOrientation, Sensor
from jaxphoto.camera.lens_prior import lens_prior
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.exposure_times import Taken
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.io.photograph_metadata import DroneRecord, drone_record, xmp_fields
from jaxphoto.io.photograph_times import taken
from jaxphoto.io.picture_size import check_pixels, pictures_of_any_size
from jaxphoto.procedures.known_lens import KnownLens

_DIAGONAL_35_MM = math.hypot(36, 24)
# What lenses there are for it: fields of 154 to half a degree. Some cameras note 1 or 65535 where they do not know.
_FILM_MM = (5.0, 5000.0)
# Of the longer side: the start of many programs where nothing is known, a field of 45 degrees.
_USUAL_C = 1.2
# Fields of 20 to 80 degrees are usual: c of 0.6 to 2.8 times the longer side.
_GUESSED = 0.5
# Of a pixel whose size is not known; c in pixels is what matters then.
_NOMINAL_PIXEL_MM = 0.005
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_TAG = ExifTags.Base


class Photograph(NamedTuple):
    """What the file of a photograph says; None where its EXIF does not."""

    name: str
    """Of the file, without its ending: the id of the image."""
    path: Path
    width_px: int
    height_px: int
    make: str | None = None
    model: str | None = None
    focal_length_mm: float | None = None
    focal_length_35mm_mm: float | None = None
    """Of the lens that gives the same field on film of 36 mm x 24 mm."""
    sensor_width_mm: float | None = None
    """From the focal plane resolution and the size that EXIF notes, which a file made smaller may keep."""
    orientation: int = 1
    """The flag by which viewers turn the picture, 1 to 8; 1 where there is none."""
    gps: Gps | None = None
    above_takeoff_m: float | None = None
    """The height above take-off, which drones note beside that of `gps`."""
    attitude: CameraAttitude | None = None
    aircraft_deg: tuple[float, float, float] | None = None
    """Roll, pitch and yaw of the aircraft, where its camera hangs in a gimbal."""
    taken: Taken | None = None
    serial: str | None = None
    """Number of the camera's body."""
    digital_zoom: float = 1.0
    """By how much a part of the picture was enlarged."""


class CameraStart(NamedTuple):
    """The camera that photographs were taken with, as far as it is known before a calibration."""

    sensor: Sensor
    interior: InteriorOrientation
    origin: str
    """A sentence that says where pixel size and principal distance come from."""
    c_rounding: float = 0.0
    """Relative standard deviation of c, in pixels, that is due to how it was noted."""


def photographs(paths: Sequence[str | Path]) -> list[Photograph]:
    """The photographs in the files `paths`, in this order.

    Raises InputError for a file that is missing or no picture, and for two whose names differ in the folder or the
    ending only.
    """
    read: dict[str, Photograph] = {}
    for path in map(Path, paths):
        photograph = read_photograph(path)
        other = read.setdefault(path.stem, photograph)
        if other is not photograph:
            raise InputError(
                f"{other.path} and {path} would both be the image {path.stem!r}; give each photograph once, and "
                "rename one of two that are different"
            )
    return list(read.values())


def sensor_and_interior(
    photographs: Sequence[Photograph], pixel_mm: float | None = None, c_mm: float | None = None
) -> CameraStart:
    """The camera of `photographs`, all taken with one: what is given counts, then what EXIF says.

    The pixel size is that of the focal plane resolution, or follows from the focal length f and that of the same field
    on film, f35: the diagonal of the sensor is 43.27 mm f / f35. The principal distance is f; with a pixel size that is
    given it follows from f35 first, which no change of the picture's size alters. Where EXIF says neither it starts at
    1.2 times the longer side. The distortion starts at zero.

    Raises InputError for no photographs, for such as differ in what `ONE_CAMERA` names, and for
    a c_mm of pixels whose size nobody says.
    """
    if not photographs:
        raise InputError("no photograph is given; name the files of those that one camera took")
    for what, given in (("pixel_mm", pixel_mm), ("c_mm", c_mm)):
        if given is not None and not (math.isfinite(given) and given > 0):
            raise InputError(f"{what} is {given:g}; give a positive number of millimetres")
    _check_one_camera(photographs, c_mm)
    first = next((p for p in photographs if p.focal_length_35mm_mm or p.focal_length_mm), photographs[0])
    longer = max(first.width_px, first.height_px)
    pixel, pixel_origin = _pixel(first, pixel_mm)
    if pixel is None and c_mm is not None:
        raise InputError(
            f"c_mm is given, but neither a pixel size nor EXIF that tells it ({first.path}); give pixel_mm as well"
        )
    if pixel is None:
        pixel = _NOMINAL_PIXEL_MM
    if c_mm is not None:
        c, c_origin, rounding = c_mm, "c as given", 0.0
    elif pixel_mm is None and first.focal_length_mm and pixel_origin:
        c, c_origin = first.focal_length_mm, "c is the focal length of EXIF"
        # A pixel size that follows from both focal lengths is as good as the one that is noted in whole millimetres.
        rounding = _rounded(c if first.sensor_width_mm else first.focal_length_35mm_mm or c)
    elif first.focal_length_35mm_mm:
        c = first.focal_length_35mm_mm / _DIAGONAL_35_MM * math.hypot(first.width_px, first.height_px) * pixel
        c_origin = f"c from {first.focal_length_35mm_mm:g} mm on film of 36 mm x 24 mm (EXIF)"
        rounding = _rounded(first.focal_length_35mm_mm)
    elif pixel_mm is not None and first.focal_length_mm:
        c, c_origin = first.focal_length_mm, "c is the focal length of EXIF"
        rounding = _rounded(c)
    else:
        c = _USUAL_C * longer * pixel
        c_origin = f"c a guess, {_USUAL_C:g} times the longer side: EXIF does not tell it"
        rounding = _GUESSED
    sensor = Sensor(first.width_px, first.height_px, pixel, pixel_assumed=not pixel_origin)
    pixel_origin = pixel_origin or "pixel size nominal: EXIF does not tell it, and only c in pixels matters"
    sentence = f"c = {c:.6g} mm ({c / pixel:.5g} pixels of {pixel:.4g} mm): {c_origin}; {pixel_origin}."
    return CameraStart(sensor, InteriorOrientation(c), sentence, rounding)


def known_lens(photographs: Sequence[Photograph], camera: CameraStart, distortion: AbstractDistortion) -> KnownLens:
    """What is known of the lens of the photographs by make and model, about `camera` without any distortion."""
    told = next((p for p in photographs if p.make or p.model), photographs[0])
    nominal = InteriorOrientation(camera.interior.c, 0.0, 0.0, distortion)
    return KnownLens(nominal, lens_prior(told.make, told.model), camera.c_rounding)


def _rounded(mm: float) -> float:
    """The relative standard deviation of a focal length as it is written: uniform within its last digit."""
    step = next((step for step in (1.0, 0.1) if abs(mm / step - round(mm / step)) < 1e-6), 0.01)
    return step / math.sqrt(12) / mm


def _pixel(photograph: Photograph, given_mm: float | None) -> tuple[float | None, str]:
    """The size of a pixel and where it comes from; None where nothing says it."""
    if given_mm is not None:
        return given_mm, "pixel size as given"
    if photograph.sensor_width_mm:
        return photograph.sensor_width_mm / photograph.width_px, "pixel size from the focal plane resolution (EXIF)"
    if photograph.focal_length_mm and photograph.focal_length_35mm_mm:
        diagonal_mm = _DIAGONAL_35_MM * photograph.focal_length_mm / photograph.focal_length_35mm_mm
        pixel = diagonal_mm / math.hypot(photograph.width_px, photograph.height_px)
        return pixel, (
            f"pixel size from the focal lengths {photograph.focal_length_mm:g} mm and, on film, "
            f"{photograph.focal_length_35mm_mm:g} mm (EXIF)"
        )
    return None, ""


ONE_CAMERA: list[tuple[str, Callable[["Photograph"], Hashable], str]] = [
    (
        "size",
        lambda p: f"{p.width_px} x {p.height_px} px",
        "give those of one camera as they were taken: turn back what was turned, leave out what was cut or made "
        "smaller",
    ),
    (
        "orientation flag",
        # What still has to be turned by a quarter lies as the sensor saw it, as do others of its size: a program that
        # had turned some by quarters would have exchanged width and height.
        lambda p: None if p.orientation > 4 and p.width_px != p.height_px else p.orientation,
        "pictures are read as they lie in the file, and a program may have turned some: where all are as the "
        "sensor saw them, set one flag (exiftool -n -Orientation=1 FILES), else leave the odd ones out",
    ),
    ("camera", lambda p: " ".join(filter(None, (p.make, p.model))) or None, "give the photographs of one camera"),
    (
        "serial number",
        lambda p: p.serial,
        "two cameras of one model differ as much as its lenses do: give the photographs of one",
    ),
    ("digital zoom", lambda p: f"{p.digital_zoom:.4g}", "give those of one zoom"),
    ("focal length", lambda p: p.focal_length_mm and f"{p.focal_length_mm:.4g} mm", "give those of one zoom"),
]
"""What all photographs of one camera have in common, and the mend where they have not."""


def _check_one_camera(photographs: Sequence[Photograph], c_mm: float | None) -> None:
    for what, of, mend in ONE_CAMERA if c_mm is None else ONE_CAMERA[:-1]:
        groups: dict[Any, list[Photograph]] = {}
        for p in photographs:
            if of(p) is not None:
                groups.setdefault(of(p), []).append(p)
        if len(groups) > 1:
            listed = "; ".join(f"{value}: {_some(group)}" for value, group in groups.items())
            raise InputError(f"the photographs of one camera have different {what}s ({listed}); {mend}")


def _some(group: list[Photograph]) -> str:
    names = ", ".join(p.path.name for p in group[:3])
    return names if len(group) <= 3 else f"{names} and {len(group) - 3} more"


def read_photograph(path: Path) -> Photograph:
    """What the file of one photograph says. Raises InputError for a file that is missing or no picture."""
    if path.is_dir():
        raise InputError(f"{path} is a folder; name its photographs, for example {path}/*.jpg")
    if path.is_symlink() and not path.exists():
        raise InputError(f"{path}: what this links to is not there; bring that file here, or remove the link")
    if not path.is_file():
        raise InputError(f"{path}: there is no such photograph; correct the name")
    try:
        with pictures_of_any_size(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # The lengths within a PNG, which OpenCV believes; it cannot be read after that.
            with Image.open(path) as picture:
                picture.verify()
            with Image.open(path) as picture:
                check_pixels(path, *picture.size)
                return Photograph(path.stem, path, *picture.size, **_exif(picture))
    except InputError:
        raise
    # On bytes that are not what they should be Pillow raises what its formats do, each in its own way.
    except Exception as error:
        raise InputError(f"{path}: this is no picture that can be read; give a TIFF, PNG or JPEG") from error


def _exif(picture: Image.Image) -> dict[str, Any]:
    """The fields of `Photograph` after the first four, from EXIF that may be absent or damaged."""
    try:
        top = picture.getexif()
        shot, gps = top.get_ifd(ExifTags.IFD.Exif), top.get_ifd(ExifTags.IFD.GPSInfo)
    except Exception:
        return {}
    flag, film = top.get(_TAG.Orientation, 1), _positive(shot.get(_TAG.FocalLengthIn35mmFilm))
    fields = xmp_fields(picture.info.get("xmp"))
    drone = drone_record(fields)
    in_packet = next((value for key, value in fields.items() if key.endswith(":CameraSerialNumber")), None)
    return {
        "make": _words(top.get(_TAG.Make)),
        "model": _words(top.get(_TAG.Model)),
        "focal_length_mm": _positive(shot.get(_TAG.FocalLength)),
        "focal_length_35mm_mm": film if film is not None and _FILM_MM[0] <= film <= _FILM_MM[1] else None,
        "sensor_width_mm": _sensor_width(shot, *picture.size),
        "orientation": flag if flag in range(1, 9) else 1,
        "gps": _gps(gps, drone),
        "above_takeoff_m": drone.above_takeoff_m,
        "attitude": drone.attitude,
        "aircraft_deg": drone.aircraft_deg,
        "taken": taken(shot, gps, drone.utc),
        "serial": _words(shot.get(_TAG.BodySerialNumber)) or _words(in_packet),
        # 0 says that there was none.
        "digital_zoom": _positive(shot.get(_TAG.DigitalZoomRatio)) or 1.0,
    }


def _sensor_width(taken: dict, width_px: int, height_px: int) -> float | None:
    """In mm along x: the width that EXIF notes over the focal plane resolution; None for a picture cut since."""
    resolution = _positive(taken.get(_TAG.FocalPlaneXResolution))
    unit = _UNIT_MM.get(taken.get(_TAG.FocalPlaneResolutionUnit, 2))
    if resolution is None or unit is None:
        return None
    width = _positive(taken.get(_TAG.ExifImageWidth)) or width_px
    height = _positive(taken.get(_TAG.ExifImageHeight)) or height_px
    cut = abs(width * height_px / (height * width_px) - 1) > 0.01
    return None if cut else width / resolution * unit


def _positive(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _words(value: Any) -> str | None:
    words = value.replace("\0", "").strip() if isinstance(value, str) else ""
    return words or None


def _gps(tags: dict, drone: DroneRecord) -> Gps | None:
    """The position of EXIF, else of the drone's packet, with the height and what else that says.

    (0, 0) is a receiver's nothing. Latitudes beyond the poles stay: `georeferencing.recorded_positions` knows two
    numbers that changed places.
    """
    try:
        latitude, longitude = (_degrees(tags[k]) * _sign(tags.get(k - 1)) for k in (2, 4))
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        if drone.latitude_longitude_deg is None:
            return None
        latitude, longitude = drone.latitude_longitude_deg
    if not (math.isfinite(latitude) and math.isfinite(longitude) and max(abs(latitude), abs(longitude)) <= 180):
        return None
    altitude = drone.altitude_m if drone.altitude_m is not None else _altitude(tags)
    known = altitude if altitude is not None and math.isfinite(altitude) else None
    return Gps(latitude, longitude, known, drone.sigma_m, drone.heights, drone.fix)


def _altitude(tags: dict) -> float | None:
    try:
        return float(tags[6]) * (-1 if tags.get(5) in (1, b"\x01") else 1)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None


def _degrees(parts: Any) -> float:
    return sum(float(part) / 60**k for k, part in enumerate(parts))


def _sign(reference: Any) -> int:
    return -1 if str(reference).strip("\0 ").upper()[:1] in ("S", "W") else 1
