"""Exported cameras of Agisoft Metashape (cameras.xml) -> the tables of a block.

    document/chunk/sensors/sensor            id, label, calibration (as `jaxphoto.io.cameras.agisoft`)
    .../components/component/transform       rotation, translation, scale: from the chunk to geocentric axes of the
                                             datum, or to the local system; chunk/transform in older files
    .../cameras//camera                      id, sensor_id, component_id, label; transform: 4 x 4, from the axes of the
                                             camera, x right, y down, z ahead, to the chunk
    .../markers, .../frames/frame/markers    control and marks (as `jaxphoto.io.control_files.metashape`)
    .../reference                            WKT of the coordinate system

The file has no tie points: they are those of a text beside it, and the marks of markers. Markers without a place in it
are those of markers.xml beside it.
Source: Agisoft Metashape User Manual, "Export cameras" and Appendix D; Metashape Python Reference, Chunk.transform and
Camera.transform; exported files of versions 1.5 and 2.0.
"""

import warnings
import xml.etree.ElementTree as ElementTree
from collections import Counter
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Frame
from jaxphoto.camera import Agisoft
from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.cameras.agisoft import read_sensor
from jaxphoto.io.cameras.camera_file import CameraSource
from jaxphoto.io.control_files.metashape import markers_of, only_chunk, system_words
from jaxphoto.io.control_files.rows import Mark, SurveyRows
from jaxphoto.io.reconstructions.numbers import number_rows
from jaxphoto.io.reconstructions.on_map import WGS84, OnMap, of_the_earth, on_map
from jaxphoto.io.reconstructions.points_beside import PhotographCamera, joined, marks_shown, points_beside
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, TiedPhotographs, estimated, free_network
from jaxphoto.io.whole_text import LARGE, has_words, read_text
from jaxphoto.procedures.control.surveyed import ControlSystem, SurveyedPoints, system_of

MARKERS = "markers.xml"
_PARAMETERS = {"f": "c_mm", "cx": "xp_mm", "cy": "yp_mm"} | {name: name for name in Agisoft.coefficients}


class _Aligned(NamedTuple):
    label: str
    sensor: str
    """The id of its sensor."""
    component: str
    transform: str


def recognises(source: Path) -> bool:
    """Whether `source` is an exported file of cameras, aligned or not, or a folder that holds such files."""
    return bool(_files(source))


def read_metashape(source: Path) -> BlockTables:
    """The block of exported cameras with the tie points beside them, from the values of the file.

    Cameras are free in what Metashape estimated. Positions are in the coordinate system of the file, and markers with
    coordinates there are its control. Of several components the one with most cameras is read; what is not is told
    (UserWarnings). Further as `free_network`.

    Raises InputError for files that are damaged or do not fit together, and where there are no image points.
    """
    found = [source] if source.is_file() else _files(source)
    if len(found) != 1:
        raise InputError(f"{source} holds {len(found)} files of Metashape's cameras; name one")
    path = found[0]
    chunk = only_chunk(path, read_text(path, LARGE))
    photos, component = _photos(path, chunk)
    sensors, names = _cameras(path, chunk), _names(chunk)
    for photo in photos:
        if photo.sensor not in sensors:
            raise InputError(f"{path.name}, camera {quoted(photo.label)}: its sensor is not calibrated; export it anew")
    poses = number_rows(
        [photo.transform.split() for photo in photos],
        (16,),
        lambda k: f"{path.name}, camera {quoted(photos[k].label)}, transform",
    ).reshape(-1, 4, 4)
    turn, moved, scale, placed = _transform(path, chunk, component)
    centres = moved + scale * poses[:, :3, 3] @ turn.T
    rotations = np.swapaxes(turn @ poses[:, :3, :3], 1, 2)
    system = _system(path, chunk, centres) if placed else ControlSystem(None, None, None)
    there = OnMap(Frame("local"), centres, rotations)
    if system.crs is not None:
        there = on_map(path.name, _datum_code(path, system), system.vertical, centres, rotations)
    rows, marks = _markers(path, chunk)
    labels = [photo.label for photo in photos]
    of_photo = [PhotographCamera(*sensors[photo.sensor][:2]) for photo in photos]
    shown = joined(points_beside(path, labels, of_photo), marks_shown(marks, labels), path.name)
    if not len(shown.image):
        raise InputError(
            f"{path.name} has no tie points and no marks, which cameras of Metashape never bring with them; export the "
            "tie points as BINGO or PATB into the folder of this file, or the project as BlocksExchange"
        )
    return free_network(
        TiedPhotographs(
            path.name,
            "Metashape",
            chunk.get("label") or path.stem,
            {names[key]: camera for key, camera in sensors.items()},
            labels,
            [names[photo.sensor] for photo in photos],
            there.rotations,
            there.centres,
            shown.points,
            None,
            shown.image,
            shown.point,
            shown.column_row,
            there.frame,
            _control(path, rows.surveyed() if rows else None, system, placed),
            shown.sigma_px,
        )
    )


def _files(source: Path) -> list[Path]:
    """Those of a folder but for its markers, with oriented cameras where any has them."""
    paths = sorted(source.glob("*.xml")) if source.is_dir() else [source]
    found = [path for path in paths if has_words(path, "<document", "<chunk", "<cameras")]
    cameras = [path for path in found if path.name != MARKERS] or found
    return [path for path in cameras if has_words(path, "<transform")] or cameras


def _photos(path: Path, chunk: ElementTree.Element) -> tuple[list[_Aligned], str]:
    """The oriented photographs of the largest component, and that component; a UserWarning tells of the others."""
    photos, unposed = [], 0
    for camera in chunk.iterfind("cameras//camera"):
        transform, label = camera.findtext("transform"), (camera.get("label") or "").strip()
        if transform is None:
            unposed += 1
        elif not label:
            raise InputError(f"{path.name}: a <camera> has no label; export the cameras anew")
        else:
            photos.append(_Aligned(label, camera.get("sensor_id", ""), camera.get("component_id", ""), transform))
    count = Counter(photo.component for photo in photos)
    component = max(count, key=lambda key: count[key], default="")
    other = len(photos) - count[component]
    if photos and (unposed or other):
        warnings.warn(
            f"{path.name}: {unposed} camera(s) that are not aligned and {other} of smaller components are not read",
            UserWarning,
            stacklevel=3,
        )
    if not photos:
        raise InputError(
            f"{path.name}: no camera is aligned; align the photographs and export the cameras again (markers alone are "
            "for jaxphoto control)"
        )
    return [photo for photo in photos if photo.component == component], component


def _cameras(path: Path, chunk: ElementTree.Element) -> dict[str, TiedCamera]:
    """Calibrated cameras by the ids of their sensors."""
    found = {}
    for sensor in chunk.iterfind("sensors/sensor"):
        name = sensor.get("id", "")
        camera = read_sensor(CameraSource(path), name, sensor)
        if camera is not None:
            said = (sensor.findtext("covariance/params") or "").split()
            free = tuple(_PARAMETERS[key] for key in said if key in _PARAMETERS) or estimated(camera.interior)
            fixed = any(p.get("name") == "fixed" and p.get("value") == "true" for p in sensor.iterfind("property"))
            found[name] = TiedCamera(camera.sensor, camera.interior, () if fixed else free)
    return found


def _names(chunk: ElementTree.Element) -> dict[str, str]:
    """What cameras are called, by the ids of their sensors: the label, with the id where two have the same."""
    labels = {s.get("id", ""): (s.get("label") or "camera").strip() for s in chunk.iterfind("sensors/sensor")}
    times = Counter(labels.values())
    return {key: label if times[label] == 1 else f"{label} {key}" for key, label in labels.items()}


def _transform(
    path: Path, chunk: ElementTree.Element, component: str
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"], float, bool]:
    """Rotation, translation and scale from the chunk to the world, and whether the file has them."""
    found = [c.find("transform") for c in chunk.iterfind("components/component") if c.get("id", "") == component]
    transform = next((t for t in [*found, chunk.find("transform")] if t is not None), None)
    if transform is None or transform.find("rotation") is None:
        return np.eye(3), np.zeros(3), 1.0, False
    values = {}
    for key, size in (("rotation", 9), ("translation", 3), ("scale", 1)):
        words = (transform.findtext(key) or ("1" if key == "scale" else "")).split()
        values[key] = number_rows([words], (size,), partial(_place, path, key))[0]
    turn, scale = values["rotation"].reshape(3, 3), float(values["scale"][0])
    if not scale > 0:
        raise InputError(f"{path.name}, transform: a scale of {scale:g} cannot be; export the cameras anew")
    return turn, values["translation"], scale, True


def _place(path: Path, key: str, _: int) -> str:
    return f"{path.name}, transform, {key}"


def _system(path: Path, chunk: ElementTree.Element, centres: Float[np.ndarray, "images 3"]) -> ControlSystem:
    """The system of the file; WGS 84 where it says none and photographs are placed about the centre of the earth."""
    words = system_words(chunk)
    if words:
        return system_of(words, path.name)
    return system_of(f"EPSG:{WGS84}", path.name) if of_the_earth(centres) else ControlSystem(None, None, None)


def _datum_code(path: Path, system: ControlSystem) -> int:
    """The EPSG code of the system, or where it has none that of the geographic system below. Raises InputError."""
    if system.code is not None:
        return system.code
    geodetic = None if system.crs is None else system.crs.geodetic_crs
    code = None if geodetic is None else geodetic.to_epsg()
    if code is None:
        raise InputError(
            f"{path.name}: neither its system ({system.name}) nor the datum of that has an EPSG code; export it in a "
            "system that has one"
        )
    warnings.warn(f"{path.name}: its system has no EPSG code; the block is in EPSG:{code}", UserWarning, stacklevel=3)
    return code


def _markers(path: Path, chunk: ElementTree.Element) -> tuple[SurveyRows, list[Mark]]:
    """Those of the file, or where it has none those of markers.xml beside it. Raises InputError where that is in
    another coordinate system."""
    beside = path.with_name(MARKERS)
    if chunk.find("markers//marker") is not None or not beside.is_file() or beside == path:
        return markers_of(path.name, chunk)
    other = only_chunk(beside, read_text(beside, LARGE))
    if system_words(other) != system_words(chunk):
        raise InputError(
            f"{MARKERS} is in another coordinate system than {path.name}; export both in one, or give {MARKERS} to "
            "jaxphoto control"
        )
    return markers_of(MARKERS, other)


def _control(path: Path, points: SurveyedPoints | None, system: ControlSystem, placed: bool) -> SurveyedPoints | None:
    """Control where its coordinates are those of the block; a UserWarning where they are not."""
    if points is None or (placed and (system.crs is None or system.code is not None)):
        return points
    why = "is in no EPSG system" if placed else "is not georeferenced"
    warnings.warn(
        f"{path.name} {why}, so {len(points.ids)} markers with coordinates are no control; give the file to jaxphoto "
        "control, too",
        UserWarning,
        stacklevel=3,
    )
    return None
