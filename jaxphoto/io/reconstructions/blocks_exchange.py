"""BlocksExchange XML of Bentley's ContextCapture and iTwin Capture, which Metashape and Pix4D export, too -> the tables
of a free network.

    SpatialReferenceSystems/SRS                 Id, Definition
    Block/Photogroups/Photogroup                ImageDimensions, FocalLengthPixels (or FocalLength with SensorSize, mm),
                                                PrincipalPoint, Distortion (K1-K3, P1, P2), CameraOrientation
    .../Photo                                   Id, ImagePath, Pose/Rotation (M_00 to M_22), Pose/Center
    Block/TiePoints/TiePoint                    Position, Measurement (PhotoId, x, y)

Signs and pixels as `jaxphoto.io.exports.blocks_exchange`. The system is ENU:latitude,longitude (east, north and
up of that place on WGS 84), an EPSG code, WKT, or a local one.
Source: ContextCapture User Guide, "BlocksExchange XML/XMLZ format" and "Perspective camera model".
"""

import io
import re
import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.cameras.agisoft import PLANE
from jaxphoto.io.cameras.camera_file import CameraSource, in_pixels
from jaxphoto.io.reconstructions.numbers import number_rows
from jaxphoto.io.reconstructions.on_map import about_place, in_system
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, TiedPhotographs, free_network
from jaxphoto.io.whole_text import LARGE, has_words, read_whole

_NUMBER = r"\s*([-+]?\d{1,4}(?:\.\d*)?(?:e-\d\d)?)\s*"
_ENU = re.compile(f"ENU:{_NUMBER},{_NUMBER}(?:,{_NUMBER})?")
_ROOT = "<BlocksExchange"
_FIRST_PX = 0.5
_COEFFICIENTS = ("k1", "k2", "k3", "p1", "p2")
_MATRIX = [f"M_{row}{column}" for row in range(3) for column in range(3)]
# Camera axes: the signs of y and z by which they are x right, y down, z ahead.
_AXES = {"XRightYDown": 1.0, "XRightYUp": -1.0}


class _Photo(NamedTuple):
    number: str
    file: str
    camera: str
    pose: ElementTree.Element
    sign: float


def recognises(source: Path) -> bool:
    """Whether `source` is a file of this kind, or a folder that holds exactly one."""
    return len(_files(source)) == 1


def read_blocks_exchange(source: Path) -> BlockTables:
    """The free-network self-calibration of a block in BlocksExchange XML, from its values.

    Cameras have the distortion `agisoft` and are free in c_mm, xp_mm, yp_mm, k1 to k3, p1 and p2. Photographs without a
    pose are left out, control points and pixels that are not square are not read (UserWarnings). Further as
    `free_network`.

    Raises InputError for files that are damaged or do not fit together, fisheyes, poses that are no matrices, and
    positions in longitude and latitude.
    """
    found = [source] if source.is_file() else _files(source)
    if len(found) != 1:
        raise InputError(f"{source} holds {len(found)} files of BlocksExchange XML; name one")
    path = found[0]
    root, ties = _parsed(path)
    blocks = root.findall("Block")
    if len(blocks) != 1:
        raise InputError(f"{path.name} has {len(blocks)} blocks, and one is read; export that one by itself")
    (block,) = blocks
    system = _system(path, root, block)
    cameras, photos, unposed = _photogroups(path, block)
    place = {photo.number: k for k, photo in enumerate(photos)}
    if len(place) < len(photos):
        raise InputError(f"{path.name}: two photographs have one Id; export the file anew")
    here = lambda what: lambda k: f"{path.name}, photo {photos[k].number}, {what}"  # noqa: E731
    matrices = [[photo.pose.findtext(f"Rotation/{name}") for name in _MATRIX] for photo in photos]
    rotations = number_rows(matrices, (9,), here("Rotation")).reshape(-1, 3, 3)
    rotations = rotations * np.array([[1.0, p.sign, p.sign] for p in photos]).reshape(-1, 3, 1)
    centres = [[photo.pose.findtext(f"Center/{axis}") for axis in "xyz"] for photo in photos]
    lost = [f"{n} {what}" for n, what in ((unposed, "photographs without pose"), (ties.control, "control points")) if n]
    if lost:
        warnings.warn(f"{path.name}: {' and '.join(lost)} are not read", UserWarning, stacklevel=2)
    known = [k for k, number in enumerate(ties.photo) if number in place]
    tied = TiedPhotographs(
        path.name,
        "the program",
        (block.findtext("Name") or path.stem).strip(),
        cameras,
        [photo.file for photo in photos],
        [photo.camera for photo in photos],
        rotations,
        number_rows(centres, (3,), here("Center")),
        [f"t{k + 1}" for k in range(len(ties.xyz))],
        number_rows(ties.xyz, (3,), lambda k: f"{path.name}, tie point {k + 1}"),
        np.array([place[ties.photo[k]] for k in known], int),
        np.array([ties.point[k] for k in known], int),
        number_rows([ties.xy[k] for k in known], (2,), lambda k: f"{path.name}, tie point {ties.point[known[k]] + 1}")
        + _FIRST_PX,
    )
    if origin := _ENU.fullmatch(system):
        latitude, longitude, height = (float(number or 0) for number in origin.groups())
        tied = about_place(tied, (longitude, latitude, height))
    elif system:
        tied = in_system(tied, system)
    return free_network(tied)


def _files(source: Path) -> list[Path]:
    paths = sorted(source.glob("*.xml")) if source.is_dir() else [source]
    return [path for path in paths if has_words(path, _ROOT)]


class _Ties(NamedTuple):
    """Tie points in the order of the file, as text, and of each measurement photograph, point and place."""

    xyz: list[list[str | None]]
    photo: list[str]
    point: list[int]
    xy: list[list[str | None]]
    control: int


def _parsed(path: Path) -> tuple[ElementTree.Element, _Ties]:
    """The tree without tie points, of which a million would take gigabytes in it, and the tie points."""
    xyz: list[list[str | None]] = []
    photo: list[str] = []
    point: list[int] = []
    xy: list[list[str | None]] = []
    control = 0
    events = ElementTree.iterparse(io.BytesIO(read_whole(path, LARGE)), ("start", "end"))
    root = None
    try:
        for event, element in events:
            root = element if root is None else root
            if event == "start":
                continue
            if element.tag == "TiePoint":
                xyz.append([element.findtext(f"Position/{axis}") for axis in "xyz"])
                for measured in element.iterfind("Measurement"):
                    photo.append((measured.findtext("PhotoId") or "").strip())
                    point.append(len(xyz) - 1)
                    xy.append([measured.findtext(axis) for axis in "xy"])
                element.clear()
            elif element.tag == "ControlPoint":
                control += 1
                element.clear()
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        # The others where it says to be of an encoding that is none, or that the parser does not know.
        raise InputError(
            f"{path.name}: the XML is broken ({error}); it is cut off or was changed, export it anew"
        ) from None
    if root is None or root.tag != "BlocksExchange":
        raise InputError(f"{path.name} is no BlocksExchange XML; export the block as such")
    return root, _Ties(xyz, photo, point, xy, control)


def _system(path: Path, root: ElementTree.Element, block: ElementTree.Element) -> str:
    """The words that name the system of the block; "" for a local one. Raises InputError where positions are angles."""
    number = (block.findtext("SRSId") or "").strip()
    for system in root.iterfind("SpatialReferenceSystems/SRS"):
        words = (system.findtext("Definition") or "").strip()
        if (system.findtext("Id") or "").strip() != number or words.startswith("LOCAL_CS"):
            continue
        try:
            angles = CRS.from_user_input(words).is_geographic
        except (CRSError, UnicodeError, ValueError):
            angles = False
        if angles:
            raise InputError(
                f"{path.name}: the block is in {quoted(words)}, longitude and latitude; export it in a map system"
            )
        return words
    return ""


def _photogroups(path: Path, block: ElementTree.Element) -> tuple[dict[str, TiedCamera], list[_Photo], int]:
    """Cameras by name, photographs that have a pose, and how many have none."""
    cameras: dict[str, TiedCamera] = {}
    photos: list[_Photo] = []
    unposed = 0
    for count, group in enumerate(block.iterfind("Photogroups/Photogroup"), 1):
        name = (group.findtext("Name") or "").strip() or f"photogroup {count}"
        name = name if name not in cameras else f"{name} {count}"
        axes = (group.findtext("CameraOrientation") or "XRightYDown").strip()
        if axes not in _AXES:
            raise InputError(
                f"{path.name}, {name}: CameraOrientation {quoted(axes)} is not read; export {' or '.join(_AXES)}"
            )
        posed = []
        for photo in group.iterfind("Photo"):
            pose, file = photo.find("Pose"), (photo.findtext("ImagePath") or "").strip()
            number = (photo.findtext("Id") or "").strip()
            if pose is None or pose.find("Rotation") is None or pose.find("Center/x") is None:
                unposed += 1
            else:
                posed.append(_Photo(number, file or number, name, pose, _AXES[axes]))
        if posed:
            cameras[name] = _camera(CameraSource(path), name, group)
            photos += posed
    return cameras, photos, unposed


def _camera(source: CameraSource, name: str, group: ElementTree.Element) -> TiedCamera:
    kind = (group.findtext("CameraModelType") or "Perspective").strip()
    if kind != "Perspective":
        raise source.error(f"camera {quoted(name)} is a {quoted(kind)}, and perspective ones are read; export those")

    def number(key: str, default: float | None = None) -> float:
        text = group.findtext(key)
        return (
            default if text is None and default is not None else source.number(f"{key} of camera {quoted(name)}", text)
        )

    width, height = number("ImageDimensions/Width"), number("ImageDimensions/Height")
    # Of the longer side; a side of no pixels is refused below.
    longer = max(width, height, 1.0)
    pixel_mm = number("SensorSize") / longer if group.find("SensorSize") is not None else None
    sensor, _ = source.sensor(width, height, pixel_mm)
    if group.find("FocalLengthPixels") is not None:
        focal = number("FocalLengthPixels")
    else:
        focal = number("FocalLength") / number("SensorSize") * longer
    if number("AspectRatio", 1.0) != 1.0 or number("Skew", 0.0) != 0.0:
        what = f"{source.path.name}: aspect ratio and skew of camera {name} are not read; free b1 and b2 to find them"
        warnings.warn(what, UserWarning, stacklevel=4)
    middle = (width / 2 - _FIRST_PX, height / 2 - _FIRST_PX)
    centre = [number(f"PrincipalPoint/{axis}", at) + _FIRST_PX for axis, at in zip("xy", middle, strict=True)]
    values = {key: number(f"Distortion/{key.upper()}", 0.0) for key in _COEFFICIENTS}
    interior = in_pixels(source, sensor, focal, focal, (centre[0], centre[1]), PLANE, **values)
    return TiedCamera(sensor, interior, ("c_mm", "xp_mm", "yp_mm", *_COEFFICIENTS))
