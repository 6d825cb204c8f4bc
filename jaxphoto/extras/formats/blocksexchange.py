"""BlocksExchange XML of Bentley's ContextCapture and iTwin Capture; Metashape and Pix4D export it, too.

    SpatialReferenceSystems/SRS                 Id, Definition
    Block/Photogroups/Photogroup                ImageDimensions, FocalLengthPixels (or FocalLength with SensorSize, mm),
                                                PrincipalPoint, Distortion (K1-K3, P1, P2)
    .../Photo                                   Id, ImagePath, Pose/Rotation (M_00 to M_22), Pose/Center
    Block/TiePoints/TiePoint                    Position, Measurement (PhotoId, x, y)

Pixel (0, 0) is at the *centre* of the upper left pixel. <Rotation> transforms from the block's coordinate system to
camera axes x right, y down, z forward. K1 to K3, P1 and P2 are Agisoft's coefficients (OpenCV's with P1 and P2
exchanged). The system is ENU:latitude,longitude (east, north, up at this origin on WGS 84), an EPSG code, WKT, or
local. The export uses the east-north-up frame at the block's origin if it has one, otherwise a local system. Source:
ContextCapture User Guide, "BlocksExchange XML/XMLZ format" and "Perspective camera model".
"""

import io
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.files import Format, add, by_content, number_rows, warn, xml_text
from jaxphoto.extras.formats.project import (
    AGISOFT,
    BROWN_TERMS,
    Project,
    ProjectCamera,
    about_place,
    in_pixels,
    pixels_of,
    pose,
    with_system,
)
from jaxphoto.georeferencing.map_frame import map_system
from jaxphoto.io.camera_files import CameraSource
from jaxphoto.io.text_files import has_words, read_text

FILE = "blocks_exchange.xml"
_NUMBER = r"\s*([-+]?\d{1,4}(?:\.\d*)?(?:e-\d\d)?)\s*"
_ENU = re.compile(f"ENU:{_NUMBER},{_NUMBER}(?:,{_NUMBER})?")
_FIRST_PX = 0.5
_MATRIX = [f"M_{row}{column}" for row in range(3) for column in range(3)]
_COLOUR = "<Color><Red>0</Red><Green>0</Green><Blue>0</Blue></Color>"


def read(path: Path) -> Project:
    """Read a block; cameras have free c, xp, yp, k1 to k3, p1, p2. Control points are not read."""
    # Parse tie points one by one: as a tree they may take gigabytes.
    xyz: list[list[str | None]] = []
    rows: list[tuple[str, int, list[str | None]]] = []
    events = ElementTree.iterparse(io.StringIO(read_text(path)), ("start", "end"))
    _, root = next(events)
    for event, element in events:
        if event == "end" and element.tag == "TiePoint":
            for m in element.iterfind("Measurement"):
                rows.append(((m.findtext("PhotoId") or "").strip(), len(xyz), [m.findtext(axis) for axis in "xy"]))
            xyz.append([element.findtext(f"Position/{axis}") for axis in "xyz"])
            element.clear()
    blocks = root.findall("Block")
    if len(blocks) != 1:
        raise InputError(f"{path.name} has {len(blocks)} blocks, not 1; export one block")
    (block,) = blocks
    cameras, photos, camera_of = _photogroups(path, block)
    if (n_control := len(block.findall("ControlPoints/ControlPoint"))) > 0:
        warn(f"{path.name}: skipped {n_control} control points; add them by jaxphoto control")
    ids = [(photo.findtext("Id") or "").strip() for photo in photos]
    index = {number: k for k, number in enumerate(ids)}
    if len(index) < len(photos):
        raise InputError(f"{path.name}: two photographs have the same Id. Export the file again")
    here = lambda what: lambda k: f"{path.name}, photo {ids[k]}, {what}"  # noqa: E731
    matrices = [[photo.findtext(f"Pose/Rotation/{name}") for name in _MATRIX] for photo in photos]
    centres = [[photo.findtext(f"Pose/Center/{axis}") for axis in "xyz"] for photo in photos]
    rotations = number_rows(matrices, (9,), here("Rotation")).reshape(-1, 3, 3)
    rows = [row for row in rows if row[0] in index]
    project = Project(
        (block.findtext("Name") or path.stem).strip(), cameras, (),
        [(photo.findtext("ImagePath") or number).strip() for photo, number in zip(photos, ids, strict=True)], camera_of,
        pose(rotations, number_rows(centres, (3,), here("Center"))), [f"t{k + 1}" for k in range(len(xyz))],
        number_rows(xyz, (3,), lambda k: f"{path.name}, tie point {k + 1}"),
        np.array([index[row[0]] for row in rows], int), np.array([row[1] for row in rows], int),
        number_rows([row[2] for row in rows], (2,), lambda k: f"{path.name}, tie point {rows[k][1] + 1}") + _FIRST_PX,
        file=path.name,
    )  # fmt: skip
    number = (block.findtext("SRSId") or "").strip()
    systems = {s.findtext("Id", "").strip(): s for s in root.iterfind("SpatialReferenceSystems/SRS")}
    system = (systems[number].findtext("Definition") or "").strip() if number in systems else ""
    if origin := _ENU.fullmatch(system):
        latitude, longitude, height = (float(value or 0) for value in origin.groups())
        return about_place(project, (longitude, latitude, height))
    project = with_system(project, system)
    if project.frame.code is not None and map_system(project.frame.code).is_geographic:
        raise InputError(f"{path.name}: {quoted(system)} is a geographic system. Export it in a map system")
    return project


def _photogroups(
    path: Path, block: ElementTree.Element
) -> tuple[dict[str, ProjectCamera], list[ElementTree.Element], list[str]]:
    """Return cameras by name, photographs with a pose, and their cameras."""
    cameras: dict[str, ProjectCamera] = {}
    photos: list[ElementTree.Element] = []
    camera_of: list[str] = []
    for count, group in enumerate(block.iterfind("Photogroups/Photogroup"), 1):
        name = (group.findtext("Name") or "").strip() or f"photogroup {count}"
        name = name if name not in cameras else f"{name} {count}"
        kinds = group.findtext("CameraModelType", "Perspective"), group.findtext("CameraOrientation", "XRightYDown")
        for kind, usual in zip(kinds, ("Perspective", "XRightYDown"), strict=True):
            if kind.strip() != usual:
                raise InputError(f"{path.name}, camera {name}: {quoted(kind)} is not supported; export {usual}")
        posed = group.findall("Photo/Pose/Rotation/../..")
        if left := len(group.findall("Photo")) - len(posed):
            warn(f"{path.name}: skipped {left} photographs without pose")
        if posed:
            cameras[name] = _camera(CameraSource(path), name, group)
            photos += posed
            camera_of += [name] * len(posed)
    return cameras, photos, camera_of


def _camera(source: CameraSource, name: str, group: ElementTree.Element) -> ProjectCamera:
    def number(key: str, default: Any = None) -> float:
        return source.number(f"{key} of camera {quoted(name)}", group.findtext(key, default))

    width, height = number("ImageDimensions/Width"), number("ImageDimensions/Height")
    pixel_mm = number("SensorSize") / max(width, height) if group.find("SensorSize") is not None else None
    sensor, _ = source.sensor(width, height, pixel_mm)
    in_mm = group.find("FocalLengthPixels") is None
    focal = number("FocalLength") / number("SensorSize") * max(width, height) if in_mm else number("FocalLengthPixels")
    if number("AspectRatio", 1.0) != 1.0 or number("Skew", 0.0) != 0.0:
        warn(f"{source.path.name}: skipped aspect ratio and skew of camera {name}; free b1 and b2 to estimate them")
    middle = zip("xy", (width / 2 - _FIRST_PX, height / 2 - _FIRST_PX), strict=True)
    column, row = (number(f"PrincipalPoint/{axis}", at) + _FIRST_PX for axis, at in middle)
    terms = {key: number(f"Distortion/{key.upper()}", 0.0) for key in BROWN_TERMS}
    interior = in_pixels(source, sensor, focal, focal, (column, row), AGISOFT, **terms)
    return ProjectCamera(sensor, interior, ("c_mm", "xp_mm", "yp_mm", *BROWN_TERMS))


def write(p: Project, folder: Path) -> None:
    """Write blocks_exchange.xml; heights are ellipsoidal, or local."""
    root = ElementTree.Element("BlocksExchange", version="2.1")
    # The ENU frame has its origin on the ellipsoid below our origin: add the origin's height.
    shift = np.zeros(3)
    if p.place is not None:
        longitude, latitude, height = p.place
        shift[2] = height
        srs = {"Id": "0", "Name": "Local East-North-Up", "Definition": f"ENU:{latitude!r},{longitude!r}"}
        _add_all(root, {"SpatialReferenceSystems": {"SRS": srs}})
    block = add(root, "Block")
    _add_all(block, {"Name": p.title or "jaxphoto"} | ({} if p.place is None else {"SRSId": "0"}))
    groups = add(block, "Photogroups")
    rotations, centres = p.world_to_camera, np.asarray(p.exterior.position) + shift
    for name, camera in p.cameras.items():
        group, (f, _, column, row) = add(groups, "Photogroup"), pixels_of(camera.interior, camera.sensor)
        content = {
            "Name": name,
            "ImageDimensions": {"Width": str(camera.sensor.width_px), "Height": str(camera.sensor.height_px)},
            "CameraModelType": "Perspective", "FocalLengthPixels": f, "CameraOrientation": "XRightYDown",
            "PrincipalPoint": {"x": column - _FIRST_PX, "y": row - _FIRST_PX},
            "Distortion": {term.upper(): value for term, value in camera.terms(BROWN_TERMS).items()},
        }  # fmt: skip
        _add_all(group, content)
        for i in np.flatnonzero(np.array(p.image_camera, object) == name).tolist():
            matrix = dict(zip(_MATRIX, rotations[i].ravel().tolist(), strict=True))
            position = {"Rotation": matrix, "Center": dict(zip("xyz", centres[i].tolist(), strict=True))}
            _add_all(add(group, "Photo"), {"Id": str(i), "ImagePath": p.files[i], "Pose": position})
    add(block, "TiePoints")
    # Write tie points as text: XML elements of a million image points take a gigabyte.
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


def _add_all(parent: ElementTree.Element, content: Mapping[str, Any]) -> None:
    """Add an element for each item; a mapping is an element with elements."""
    for tag, value in content.items():
        if isinstance(value, dict):
            _add_all(add(parent, tag), value)
        else:
            add(parent, tag, value)


FORMATS = (
    Format(
        "blocksexchange", "BlocksExchange XML of Bentley, with tie points",
        by_content("*.xml", lambda path: has_words(path, "<BlocksExchange")), read, write=write,
        plane=AGISOFT.only(*BROWN_TERMS), endings=(".xml",),
    ),
)  # fmt: skip
