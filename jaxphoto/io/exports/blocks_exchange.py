"""Adjusted photographs -> BlocksExchange XML of Bentley (ContextCapture, iTwin Capture), with tie points.

Pixels are counted from the *centre* of the upper left one; <Rotation> takes the system of the block to axes x right,
y down, z ahead; K1 to K3, P1 and P2 are Agisoft's formula (P1 and P2 change places in OpenCV's). The system is the
east-north-up frame at the block's origin on WGS 84, which is Cartesian, else a local one.
Source: ContextCapture User Guide, "BlocksExchange XML/XMLZ format" and "Perspective camera model".
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from jaxphoto.camera import Agisoft, Perspective
from jaxphoto.io.cameras.agisoft import xml_text
from jaxphoto.io.cameras.camera_file import CameraModel
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, ExportCamera, downwards

FILE = "blocks_exchange.xml"
PLANE = CameraModel(Agisoft, ("k4", "p3", "p4", "b1", "b2"), Perspective())
# The centre of its first pixel is (0, 0).
_FIRST_PX = 0.5
_COLOUR = "<Color><Red>0</Red><Green>0</Green><Blue>0</Blue></Color>"


def write_blocks_exchange(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write blocks_exchange.xml into `folder`; heights are then above the ellipsoid, or local."""
    p = photographs
    root = ElementTree.Element("BlocksExchange", version="2.1")
    # Its frame lies on the ellipsoid under the origin of ours, with the same vertical.
    shift = np.zeros(3) if p.place is None else np.array([0.0, 0.0, p.place[2]])
    if p.place is not None:
        longitude, latitude, _ = p.place
        system = _add(_add(root, "SpatialReferenceSystems"), "SRS")
        texts = {"Id": "0", "Name": "Local East-North-Up", "Definition": f"ENU:{latitude!r},{longitude!r}"}
        _add_texts(system, texts)
    block = _add(root, "Block")
    _add_texts(block, {"Name": p.title or "jaxphoto"} | ({} if p.place is None else {"SRSId": "0"}))
    groups = _add(block, "Photogroups")
    rotations, centres = downwards(p.exterior), np.asarray(p.exterior.position) + shift
    for name, camera in p.cameras.items():
        group = _add(groups, "Photogroup")
        _add_camera(group, name, camera)
        for i in np.flatnonzero(np.array(p.image_camera, object) == name).tolist():
            _add_photo(group, i, p.files[i], rotations[i], centres[i])
    _add(block, "TiePoints")
    # Of a million image points a tree of elements takes a gigabyte.
    before, after = xml_text(root).split("<TiePoints />")
    text = f"{before}<TiePoints>\n{_ties(p, shift)}    </TiePoints>{after}"
    (folder / FILE).write_text(text, encoding="utf-8")


def _ties(p: AdjustedPhotographs, shift: np.ndarray) -> str:
    """The element <TiePoint> of every point that photographs show."""
    images, places = p.image.tolist(), (p.column_row - _FIRST_PX).tolist()
    found = []
    for (x, y, z), rows in zip((p.xyz + shift).tolist(), p.rows_of_points, strict=True):
        if len(rows):
            measured = (
                f"<Measurement><PhotoId>{images[k]}</PhotoId><x>{places[k][0]!r}</x><y>{places[k][1]!r}</y></Measurement>"
                for k in rows.tolist()
            )
            position = f"<Position><x>{x!r}</x><y>{y!r}</y><z>{z!r}</z></Position>"
            found.append(f"<TiePoint>{position}{_COLOUR}{''.join(measured)}</TiePoint>\n")
    return "".join(found)


def _add_camera(group: ElementTree.Element, name: str, camera: ExportCamera) -> None:
    sensor, interior = camera
    _add_texts(group, {"Name": name})
    size = {"Width": str(sensor.width_px), "Height": str(sensor.height_px)}
    _add_texts(_add(group, "ImageDimensions"), size)
    focal = repr(float(interior.c / sensor.pixel_mm))
    kind = {"CameraModelType": "Perspective", "FocalLengthPixels": focal, "CameraOrientation": "XRightYDown"}
    _add_texts(group, kind)
    centre = sensor.px_from_mm(np.array([[float(interior.x_p), float(interior.y_p)]]))[0] - _FIRST_PX
    _add_numbers(_add(group, "PrincipalPoint"), "xy", centre)
    names = ("k1", "k2", "k3", "p1", "p2")
    values = np.array([float(getattr(interior.distortion, n)) for n in names])
    _add_numbers(_add(group, "Distortion"), [n.upper() for n in names], values)


def _add_photo(group: ElementTree.Element, i: int, file: str, rotation: np.ndarray, centre: np.ndarray) -> None:
    photo = _add(group, "Photo")
    _add_texts(photo, {"Id": str(i), "ImagePath": file})
    pose = _add(photo, "Pose")
    _add_numbers(_add(pose, "Rotation"), [f"M_{row}{column}" for row in range(3) for column in range(3)], rotation)
    _add_numbers(_add(pose, "Center"), "xyz", centre)


def _add(parent: ElementTree.Element, name: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, name)


def _add_texts(parent: ElementTree.Element, texts: dict[str, str]) -> None:
    for name, text in texts.items():
        _add(parent, name).text = text


def _add_numbers(parent: ElementTree.Element, names: str | list[str], values: np.ndarray) -> None:
    _add_texts(parent, dict(zip(names, map(repr, values.ravel().tolist()), strict=True)))
