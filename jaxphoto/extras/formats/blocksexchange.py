"""BlocksExchange XML of Bentley's ContextCapture and iTwin Capture, which Metashape and Pix4D export, too.

    SpatialReferenceSystems/SRS                 Id, Definition
    Block/Photogroups/Photogroup                ImageDimensions, FocalLengthPixels (or FocalLength with SensorSize, mm),
                                                PrincipalPoint, Distortion (K1-K3, P1, P2), CameraOrientation
    .../Photo                                   Id, ImagePath, Pose/Rotation (M_00 to M_22), Pose/Center
    Block/TiePoints/TiePoint                    Position, Measurement (PhotoId, x, y)

Pixels count from the *centre* of the upper left one; <Rotation> takes the system of the block to axes x right, y down,
z ahead; K1 to K3, P1 and P2 are Agisoft's formula (OpenCV's with P1 and P2 exchanged). The system is
ENU:latitude,longitude (east, north and up of that place on WGS 84), an EPSG code, WKT, or a local one. Written is the
east-north-up frame at the block's origin, else a local one. Source: ContextCapture User Guide, "BlocksExchange XML/XMLZ
format" and "Perspective camera model".
"""

import io
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.camera_models import AGISOFT, BROWN_TERMS, ProjectCamera, in_pixels, pixels_of
from jaxphoto.extras.formats.files import Format, add, by_content, number_rows, warn, xml_text
from jaxphoto.extras.formats.project import Project, about_place, in_system, pose
from jaxphoto.io.camera_files import CameraSource
from jaxphoto.io.text_files import has_words, read_bytes

FILE = "blocks_exchange.xml"
_NUMBER = r"\s*([-+]?\d{1,4}(?:\.\d*)?(?:e-\d\d)?)\s*"
_ENU = re.compile(f"ENU:{_NUMBER},{_NUMBER}(?:,{_NUMBER})?")
_FIRST_PX = 0.5
_MATRIX = [f"M_{row}{column}" for row in range(3) for column in range(3)]
# Signs of the camera's y and z axes that make them y down, z ahead.
_AXES = {"XRightYDown": 1.0, "XRightYUp": -1.0}
_COLOUR = "<Color><Red>0</Red><Green>0</Green><Blue>0</Blue></Color>"


class _Photo(NamedTuple):
    number: str
    file: str
    camera: str
    pose: ElementTree.Element
    sign: float


class _Ties(NamedTuple):
    """Tie points as text, and of each measurement photograph, point and place."""

    xyz: list[list[str | None]]
    photo: list[str]
    point: list[int]
    xy: list[list[str | None]]


def read(path: Path) -> Project:
    """Read a block; cameras are free in c, xp, yp, k1 to k3, p1, p2. Control is not read."""
    root, ties, n_control = _parsed(path)
    blocks = root.findall("Block")
    if len(blocks) != 1:
        raise InputError(f"{path.name} has {len(blocks)} blocks, and one is read; export that one by itself")
    (block,) = blocks
    system = _system(path, root, block)
    cameras, photos, n_unposed = _photogroups(path, block)
    if skipped := [
        f"{n} {what}" for n, what in ((n_unposed, "photographs without pose"), (n_control, "control points")) if n
    ]:
        warn(f"{path.name}: {' and '.join(skipped)} are not read")
    index = {photo.number: k for k, photo in enumerate(photos)}
    if len(index) < len(photos):
        raise InputError(f"{path.name}: two photographs have one Id. Export the file again")
    here = lambda what: lambda k: f"{path.name}, photo {photos[k].number}, {what}"  # noqa: E731
    matrices = [[photo.pose.findtext(f"Rotation/{name}") for name in _MATRIX] for photo in photos]
    rotations = number_rows(matrices, (9,), here("Rotation")).reshape(-1, 3, 3)
    rotations = rotations * np.array([[1.0, p.sign, p.sign] for p in photos]).reshape(-1, 3, 1)
    centres = [[photo.pose.findtext(f"Center/{axis}") for axis in "xyz"] for photo in photos]
    kept = [k for k, number in enumerate(ties.photo) if number in index]
    of_tie = lambda k: f"{path.name}, tie point {ties.point[kept[k]] + 1}"  # noqa: E731
    project = Project(
        (block.findtext("Name") or path.stem).strip(), cameras, (), [photo.file for photo in photos],
        [photo.camera for photo in photos], pose(rotations, number_rows(centres, (3,), here("Center"))),
        [f"t{k + 1}" for k in range(len(ties.xyz))],
        number_rows(ties.xyz, (3,), lambda k: f"{path.name}, tie point {k + 1}"),
        np.array([index[ties.photo[k]] for k in kept], int), np.array([ties.point[k] for k in kept], int),
        number_rows([ties.xy[k] for k in kept], (2,), of_tie) + _FIRST_PX, file=path.name,
    )  # fmt: skip
    if origin := _ENU.fullmatch(system):
        latitude, longitude, height = (float(number or 0) for number in origin.groups())
        return about_place(project, (longitude, latitude, height))
    return in_system(project, system) if system else project


def _parsed(path: Path) -> tuple[ElementTree.Element, _Ties, int]:
    """The tree without tie points (gigabytes in it), the tie points, and the number of control points."""
    ties, n_control = _Ties([], [], [], []), 0
    events = ElementTree.iterparse(io.BytesIO(read_bytes(path)), ("start", "end"))
    _, root = next(events)
    for event, element in events:
        if event == "end" and element.tag == "TiePoint":
            ties.xyz.append([element.findtext(f"Position/{axis}") for axis in "xyz"])
            for measurement in element.iterfind("Measurement"):
                ties.photo.append((measurement.findtext("PhotoId") or "").strip())
                ties.point.append(len(ties.xyz) - 1)
                ties.xy.append([measurement.findtext(axis) for axis in "xy"])
            element.clear()
        elif event == "end" and element.tag == "ControlPoint":
            n_control += 1
            element.clear()
    return root, ties, n_control


def _system(path: Path, root: ElementTree.Element, block: ElementTree.Element) -> str:
    """The words that name the system of the block, "" for a local one. Raise InputError for a geographic one."""
    number = (block.findtext("SRSId") or "").strip()
    for system in root.iterfind("SpatialReferenceSystems/SRS"):
        words = (system.findtext("Definition") or "").strip()
        if (system.findtext("Id") or "").strip() != number or words.startswith("LOCAL_CS"):
            continue
        try:
            geographic = CRS.from_user_input(words).is_geographic
        except (CRSError, UnicodeError, ValueError):
            geographic = False
        if geographic:
            raise InputError(f"{path.name}: {quoted(words)} is longitude and latitude. Export it in a map system")
        return words
    return ""


def _photogroups(path: Path, block: ElementTree.Element) -> tuple[dict[str, ProjectCamera], list[_Photo], int]:
    """Cameras by name, photographs with a pose, and the number of those without."""
    cameras: dict[str, ProjectCamera] = {}
    photos: list[_Photo] = []
    n_unposed = 0
    for count, group in enumerate(block.iterfind("Photogroups/Photogroup"), 1):
        name = (group.findtext("Name") or "").strip() or f"photogroup {count}"
        name = name if name not in cameras else f"{name} {count}"
        axes = (group.findtext("CameraOrientation") or "XRightYDown").strip()
        if axes not in _AXES:
            raise InputError(f"{path.name}, {name}: CameraOrientation {quoted(axes)} is none of {', '.join(_AXES)}")
        posed = []
        for photo in group.iterfind("Photo"):
            position, file = photo.find("Pose"), (photo.findtext("ImagePath") or "").strip()
            number = (photo.findtext("Id") or "").strip()
            if position is None or position.find("Rotation") is None or position.find("Center/x") is None:
                n_unposed += 1
            else:
                posed.append(_Photo(number, file or number, name, position, _AXES[axes]))
        if posed:
            cameras[name] = _camera(CameraSource(path), name, group)
            photos += posed
    return cameras, photos, n_unposed


def _camera(source: CameraSource, name: str, group: ElementTree.Element) -> ProjectCamera:
    kind = (group.findtext("CameraModelType") or "Perspective").strip()
    if kind != "Perspective":
        raise source.error(f"camera {quoted(name)} is a {quoted(kind)}, and perspective ones are read; export those")

    def number(key: str, default: float | None = None) -> float:
        text = group.findtext(key)
        if text is None and default is not None:
            return default
        return source.number(f"{key} of camera {quoted(name)}", text)

    width, height = number("ImageDimensions/Width"), number("ImageDimensions/Height")
    longer = max(width, height, 1.0)
    pixel_mm = number("SensorSize") / longer if group.find("SensorSize") is not None else None
    sensor, _ = source.sensor(width, height, pixel_mm)
    if group.find("FocalLengthPixels") is not None:
        focal = number("FocalLengthPixels")
    else:
        focal = number("FocalLength") / number("SensorSize") * longer
    if number("AspectRatio", 1.0) != 1.0 or number("Skew", 0.0) != 0.0:
        warn(f"{source.path.name}: aspect ratio and skew of camera {name} are not read; free b1 and b2 to find them")
    middle = zip("xy", (width / 2 - _FIRST_PX, height / 2 - _FIRST_PX), strict=True)
    column, row = (number(f"PrincipalPoint/{axis}", at) + _FIRST_PX for axis, at in middle)
    terms = {key: number(f"Distortion/{key.upper()}", 0.0) for key in BROWN_TERMS}
    interior = in_pixels(source, sensor, focal, focal, (column, row), AGISOFT, **terms)
    return ProjectCamera(sensor, interior, ("c_mm", "xp_mm", "yp_mm", *BROWN_TERMS))


def write(p: Project, folder: Path) -> None:
    """Write blocks_exchange.xml; heights are above the ellipsoid, or local."""
    root = ElementTree.Element("BlocksExchange", version="2.1")
    # Its frame lies on the ellipsoid under our origin.
    shift = np.zeros(3)
    if p.place is not None:
        longitude, latitude, height = p.place
        shift[2] = height
        system = add(add(root, "SpatialReferenceSystems"), "SRS")
        _add_all(system, Id="0", Name="Local East-North-Up", Definition=f"ENU:{latitude!r},{longitude!r}")
    block = add(root, "Block")
    _add_all(block, Name=p.title or "jaxphoto", **({} if p.place is None else {"SRSId": "0"}))
    groups = add(block, "Photogroups")
    rotations, centres = p.world_to_camera, np.asarray(p.exterior.position) + shift
    for name, camera in p.cameras.items():
        group = add(groups, "Photogroup")
        _add_camera(group, name, camera)
        for i in np.flatnonzero(np.array(p.image_camera, object) == name).tolist():
            photo = add(group, "Photo")
            _add_all(photo, Id=str(i), ImagePath=p.files[i])
            position = add(photo, "Pose")
            _add_all(add(position, "Rotation"), **dict(zip(_MATRIX, rotations[i].ravel().tolist(), strict=True)))
            _add_all(add(position, "Center"), **dict(zip("xyz", centres[i].tolist(), strict=True)))
    add(block, "TiePoints")
    # As text: elements of a million image points take a gigabyte.
    before, after = xml_text(root).split("<TiePoints />")
    images, places, ties = p.image.tolist(), (p.column_row - _FIRST_PX).tolist(), []
    for (x, y, z), rows in zip((np.asarray(p.xyz) + shift).tolist(), p.rows_of_points, strict=True):
        measured = "".join(
            f"<Measurement><PhotoId>{images[k]}</PhotoId><x>{places[k][0]!r}</x><y>{places[k][1]!r}</y></Measurement>"
            for k in rows.tolist()
        )
        if measured:
            position_text = f"<Position><x>{x!r}</x><y>{y!r}</y><z>{z!r}</z></Position>"
            ties.append(f"<TiePoint>{position_text}{_COLOUR}{measured}</TiePoint>\n")
    text = f"{before}<TiePoints>\n{''.join(ties)}    </TiePoints>{after}"
    (folder / FILE).write_text(text, encoding="utf-8")


def _add_camera(group: ElementTree.Element, name: str, camera: ProjectCamera) -> None:
    f, _, column, row = pixels_of(camera.interior, camera.sensor)
    add(group, "Name", name)
    size = {"Width": str(camera.sensor.width_px), "Height": str(camera.sensor.height_px)}
    _add_all(add(group, "ImageDimensions"), **size)
    _add_all(group, CameraModelType="Perspective", FocalLengthPixels=f, CameraOrientation="XRightYDown")
    _add_all(add(group, "PrincipalPoint"), x=column - _FIRST_PX, y=row - _FIRST_PX)
    _add_all(add(group, "Distortion"), **{n.upper(): value for n, value in camera.terms(BROWN_TERMS).items()})


def _add_all(parent: ElementTree.Element, **content: str | float) -> None:
    for tag, value in content.items():
        add(parent, tag, value)


FORMATS = (
    Format(
        "blocksexchange", "BlocksExchange XML of Bentley, with tie points",
        by_content("*.xml", lambda path: has_words(path, "<BlocksExchange")), read, write=write,
        plane=AGISOFT.only(*BROWN_TERMS), endings=(".xml",),
    ),
)  # fmt: skip
