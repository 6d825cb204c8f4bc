"""Agisoft Metashape and PhotoScan: calibrations, exported cameras and markers as XML.

    calibration                              f, cx, cy, b1, b2 in pixels, k1-k4, p1-p4; cx, cy from the image centre, y
                                             down
    document/chunk/sensors/sensor            id, label, calibration
    .../components/component/transform       rotation, translation, scale: from the chunk to geocentric axes of the
                                             datum, or to the local system; chunk/transform in older files
    .../cameras//camera                      id, sensor_id, component_id, label; transform: 4 x 4, from the axes of the
                                             camera, x right, y down, z ahead, to the chunk
    .../markers//marker                      id, label; reference: x, y, z [sx, sy, sz] enabled (if not: check point)
    .../frames/frame/markers/marker/location camera_id, pinned (only these are measured), x, y in our pixels
    .../reference                            WKT of the coordinate system

Calibrations with fx, fy and skew are of PhotoScan before 1.2 and of Agisoft Lens: cx and cy count from the upper left
corner, f = fy, b1 = fx - fy, b2 = skew, and p1 and p2 are in OpenCV's order. A "fisheye" (from 2.3 on
"equidistant_fisheye") is the same polynomial on the equidistant projection. Exported cameras have no tie points: these
are read from a text beside the file, and written to image_points.csv; markers also from and to markers.xml.
Source: Agisoft Metashape User Manual, "Export cameras", "Export markers" and Appendix D; Metashape Python Reference,
Chunk.transform and Camera.transform; Agisoft Lens User Manual 0.4; Agisoft's forum, topic 6437; exported files of
versions 1.5 and 2.0.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from pyproj import CRS

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Frame
from jaxphoto.camera import Agisoft, InteriorOrientation, Sensor
from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.camera_models import AGISOFT, AGISOFT_FISHEYE, ProjectCamera
from jaxphoto.extras.formats.control import Mark, SurveyRows, read_marks
from jaxphoto.extras.formats.files import (
    CameraFormat,
    ControlFormat,
    Format,
    add,
    number_rows,
    warn,
    xml_text,
)
from jaxphoto.extras.formats.points_beside import joined, marks_shown, points_beside, write_image_points
from jaxphoto.extras.formats.project import WGS84, ControlPoints, Project, geocentric, is_geocentric, pose
from jaxphoto.georeferencing.map_frame import map_system
from jaxphoto.io.camera_files import CameraFile, CameraReader, CameraSource, joined_notes
from jaxphoto.io.text_files import has_words, read_legacy_text
from jaxphoto.io.text_tables import finite
from jaxphoto.procedures.control.surveyed import ControlSystem, GivenControl, system_of

CAMERAS_FILE, MARKERS_FILE = "cameras.xml", "markers.xml"
_MODELS = {"frame": AGISOFT, "fisheye": AGISOFT_FISHEYE, "equidistant_fisheye": AGISOFT_FISHEYE}
_SCALED = ("b1", "b2")
_TERMS = ("f", "fx", "fy", "cx", "cy", "skew", *Agisoft.coefficients)
_PARAMETERS = {"f": "c_mm", "cx": "xp_mm", "cy": "yp_mm"} | {name: name for name in Agisoft.coefficients}
_REFERENCE = ("x", "y", "z", "sx", "sy", "sz")
_WKT = re.compile(r"\s*[A-Z_]{5,}\[")
_LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'


# Calibrations -------------------------------------------------------------------------------------------------


def read_calibration(source: CameraSource) -> CameraFile:
    """Read the camera of a calibration file, or one sensor of exported cameras."""
    root = ElementTree.fromstring(source.text())
    sensors = {source.path.stem: (root, None)} if root.tag == "calibration" else _sensors(root)
    name = source.chosen(list(sensors))
    return _camera(source, name, *sensors[name])


def _sensors(root: ElementTree.Element) -> dict[str, tuple[ElementTree.Element, str | None]]:
    """Calibration and pixel size of every calibrated sensor by label."""
    sensors = {}
    for sensor in root.iter("sensor"):
        calibration, pixel = _calibration(sensor)
        if calibration is not None:
            label = sensor.get("label", sensor.get("id", ""))
            sensors[label if label not in sensors else f"{label} {sensor.get('id')}"] = (calibration, pixel)
    return sensors


def _calibration(sensor: ElementTree.Element) -> tuple[ElementTree.Element | None, str | None]:
    """The adjusted calibration of a sensor, else the initial one, and its pixel size."""
    calibrations = {c.get("class", "adjusted"): c for c in sensor.findall("calibration")}
    sizes = {p.get("name"): p.get("value") for p in sensor.iter("property")}
    return calibrations.get("adjusted", calibrations.get("initial")), sizes.get("pixel_width")


def _camera(source: CameraSource, name: str, calibration: ElementTree.Element, pixel: str | None) -> CameraFile:
    kind = (calibration.findtext("projection") or calibration.get("type") or "frame").strip()
    if kind not in _MODELS:
        raise source.error(f"the projection {quoted(kind)} is not known here; known are {', '.join(_MODELS)}")
    resolution = calibration.find("resolution")
    sides = ("width", "height")
    size = [calibration.findtext(side) if resolution is None else resolution.get(side) for side in sides]
    if None in size and source.size_px is not None:
        size = list(map(str, source.size_px))
    if None in size:
        raise source.error("<width> or <height> is missing; add both")
    pixel_mm = source.number("pixel_width", pixel) if pixel is not None else None
    width, height = map(source.number, sides, size)
    sensor, assumed = source.sensor(width, height, pixel_mm)
    values, note = _values(source, calibration, sensor)
    f = values.pop("f")
    x_p, y_p = values.pop("cx") * sensor.pixel_mm, -values.pop("cy") * sensor.pixel_mm
    distortion = Agisoft(**{k: v / f if k in _SCALED else v for k, v in values.items()})
    projection = _MODELS[kind].projection
    interior = InteriorOrientation(f * sensor.pixel_mm, x_p, y_p, distortion, projection=projection)
    return CameraFile(name, sensor, jax.tree.map(as_jax_array, interior), None, joined_notes(note, assumed))


def _values(source: CameraSource, calibration: ElementTree.Element, sensor: Sensor) -> tuple[dict[str, float], str]:
    """f, cx, cy, b1, b2 and coefficients as in Metashape, and a note on an older file."""
    older = calibration.find("f") is None and calibration.find("fx") is not None
    numbers = {child.tag: source.number(child.tag, child.text) for child in calibration if child.tag in _TERMS}
    for key in ("fx", "fy") if older else ("f",):
        if key not in numbers:
            raise source.error(f"<{key}> is missing; add it")
        if not numbers[key] > 0:
            raise source.error(f"{key} is {numbers[key]:g} pixels; a focal length is positive")
    values = {key: numbers.get(key, 0.0) for key in ("f", "cx", "cy", *Agisoft.coefficients)}
    if not older:
        return values, ""
    values |= {"f": numbers["fy"], "b1": numbers["fx"] - numbers["fy"], "b2": numbers.get("skew", 0.0)}
    for key, side in (("cx", sensor.width_px), ("cy", sensor.height_px)):
        values[key] = numbers[key] - side / 2 if key in numbers else 0.0
    values |= {"p1": values["p2"], "p2": values["p1"]}
    tangential = values["p1"] != 0 or values["p2"] != 0
    return values, "fx and fy are of an old version; its p1 and p2 were taken in OpenCV's order" * tangential


def write_calibration(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a calibration file without terms that are zero."""
    root = ElementTree.Element("calibration")
    add(root, "projection", _kind_of(interior))
    add(root, "width", str(sensor.width_px))
    add(root, "height", str(sensor.height_px))
    _add_values(root, sensor, interior)
    path.write_text(xml_text(root), "utf-8")


def _kind_of(interior: InteriorOrientation) -> str:
    return next(kind for kind, model in _MODELS.items() if type(model.projection) is type(interior.projection))


def _add_values(calibration: ElementTree.Element, sensor: Sensor, interior: InteriorOrientation) -> None:
    f = float(interior.c) / sensor.pixel_mm
    values = {"f": f, "cx": float(interior.x_p) / sensor.pixel_mm, "cy": -float(interior.y_p) / sensor.pixel_mm}
    for key in (*_SCALED, *(k for k in Agisoft.coefficients if k not in _SCALED)):
        values[key] = float(getattr(interior.distortion, key)) * (f if key in _SCALED else 1.0)
    for key, number in values.items():
        if number != 0:
            add(calibration, key, number)


# Exported cameras ---------------------------------------------------------------------------------------------


class _Aligned(NamedTuple):
    label: str
    sensor: str
    """The id of its sensor."""
    component: str
    transform: str


def find(source: Path) -> list[Path]:
    """Return exported cameras, in a folder those that are aligned if any is; markers.xml only if it is alone."""
    paths = sorted(source.glob("*.xml")) if source.is_dir() else [source]
    exported = [path for path in paths if has_words(path, "<document", "<chunk", "<cameras")]
    cameras = [path for path in exported if path.name != MARKERS_FILE] or exported
    return [path for path in cameras if has_words(path, "<transform")] or cameras


def read(path: Path) -> Project:
    """Read exported cameras with the tie points beside them; cameras are free in what Metashape estimated.

    Positions are in the file's coordinate system, in which markers are control. Of several components that with the
    most cameras is read.
    """
    chunk = _chunk(path, read_legacy_text(path))
    photos, component = _photos(path, chunk)
    sensors, names = _project_cameras(path, chunk), _sensor_names(chunk)
    for photo in photos:
        if photo.sensor not in sensors:
            raise InputError(f"{path.name}, camera {quoted(photo.label)}: its sensor is not calibrated.")
    labels = [photo.label for photo in photos]
    place = lambda k: f"{path.name}, camera {quoted(labels[k])}, transform"  # noqa: E731
    poses = number_rows([photo.transform.split() for photo in photos], (16,), place).reshape(-1, 4, 4)
    rotation, translation, scale, georeferenced = _transform(path, chunk, component)
    centres = translation + scale * poses[:, :3, 3] @ rotation.T
    rotations = np.swapaxes(rotation @ poses[:, :3, :3], 1, 2)
    system = _system(path, chunk, centres) if georeferenced else ControlSystem(None, None, None)
    rows, marks = _markers(path, chunk)
    cameras = [sensors[photo.sensor] for photo in photos]
    shown = joined(points_beside(path, labels, cameras), marks_shown(marks, labels), path.name)
    if not len(shown.image):
        raise InputError(f"{path.name} has no tie points and no marks; export tie points as BINGO or PATB beside it")
    project = Project(
        chunk.get("label") or path.stem, {names[key]: camera for key, camera in sensors.items()}, (), labels,
        [names[photo.sensor] for photo in photos], pose(rotations, centres), shown.points, None, shown.image,
        shown.point, shown.column_row, sigma_px=shown.sigma_px, file=path.name,
    )  # fmt: skip
    if system.crs is not None:
        project = geocentric(project, _datum_code(path, system), system.vertical).in_map()
    if not len(rows):
        return project
    if (georeferenced and system.crs is None) or system.code is not None:
        return project._replace(control=_control(rows, shown.points))
    why = "is in no EPSG system" if georeferenced else "is not georeferenced"
    warn(f"{path.name} {why}: {len(rows)} markers with coordinates are no control; give it to jaxphoto control, too")
    return project


def _control(rows: SurveyRows, points: list[str]) -> ControlPoints:
    surveyed = rows.surveyed()
    number = {name: k for k, name in enumerate(points)}
    there = [k for k, name in enumerate(surveyed.ids) if name in number]
    point = np.array([number[surveyed.ids[k]] for k in there], int)
    return ControlPoints(point, surveyed.coordinates[there], surveyed.sigma_m[there], surveyed.check[there])


def _photos(path: Path, chunk: ElementTree.Element) -> tuple[list[_Aligned], str]:
    """The aligned cameras of the largest component, and that component."""
    photos, unaligned = [], 0
    for camera in chunk.iterfind("cameras//camera"):
        transform, label = camera.findtext("transform"), (camera.get("label") or "").strip()
        if transform is None:
            unaligned += 1
        elif not label:
            raise InputError(f"{path.name}: a <camera> has no label. Export the cameras again")
        else:
            photos.append(_Aligned(label, camera.get("sensor_id", ""), camera.get("component_id", ""), transform))
    if not photos:
        raise InputError(f"{path.name}: no camera is aligned; align them (markers alone are for jaxphoto control)")
    ((component, count),) = Counter(photo.component for photo in photos).most_common(1)
    if unaligned or count < len(photos):
        warn(
            f"{path.name}: {unaligned} camera(s) that are not aligned and {len(photos) - count} of smaller components "
            "are not read"
        )
    return [photo for photo in photos if photo.component == component], component


def _project_cameras(path: Path, chunk: ElementTree.Element) -> dict[str, ProjectCamera]:
    """Calibrated cameras by the ids of their sensors."""
    cameras = {}
    for sensor in chunk.iterfind("sensors/sensor"):
        calibration, pixel = _calibration(sensor)
        if calibration is not None:
            read_camera = _camera(CameraSource(path), sensor.get("id", ""), calibration, pixel)
            camera = ProjectCamera.estimated(read_camera.sensor, read_camera.interior)
            estimated = (sensor.findtext("covariance/params") or "").split()
            if free := tuple(_PARAMETERS[key] for key in estimated if key in _PARAMETERS):
                camera = camera._replace(free=free)
            if any(p.get("name") == "fixed" and p.get("value") == "true" for p in sensor.iterfind("property")):
                camera = camera._replace(free=())
            cameras[read_camera.name] = camera
    return cameras


def _sensor_names(chunk: ElementTree.Element) -> dict[str, str]:
    """Names of cameras by the ids of their sensors: the label, with the id if two are the same."""
    labels = {s.get("id", ""): (s.get("label") or "camera").strip() for s in chunk.iterfind("sensors/sensor")}
    times = Counter(labels.values())
    return {key: label if times[label] == 1 else f"{label} {key}" for key, label in labels.items()}


def _transform(path: Path, chunk: ElementTree.Element, component: str) -> tuple[np.ndarray, np.ndarray, float, bool]:
    """Rotation, translation and scale from the chunk to the world, and whether the file has them."""
    transforms = [c.find("transform") for c in chunk.iterfind("components/component") if c.get("id", "") == component]
    transform = next((t for t in [*transforms, chunk.find("transform")] if t is not None), None)
    if transform is None or transform.find("rotation") is None:
        return np.eye(3), np.zeros(3), 1.0, False
    values = []
    for key, size in (("rotation", 9), ("translation", 3), ("scale", 1)):
        words = (transform.findtext(key) or ("1" if key == "scale" else "")).split()
        values.append(number_rows([words], (size,), lambda _, key=key: f"{path.name}, transform, {key}")[0])  # type: ignore[misc]
    rotation, translation, (scale,) = values
    if not scale > 0:
        raise InputError(f"{path.name}, transform: a scale of {scale:g} cannot be. Export the cameras again")
    return rotation.reshape(3, 3), translation, float(scale), True


def _system(path: Path, chunk: ElementTree.Element, centres: Float[np.ndarray, "images 3"]) -> ControlSystem:
    """The system of the file; WGS 84 if it names none and positions are geocentric."""
    words = _system_words(chunk) or (f"EPSG:{WGS84}" if is_geocentric(centres) else "local")
    return system_of(words, path.name)


def _datum_code(path: Path, system: ControlSystem) -> int:
    """The EPSG code of the system, else that of its geographic system."""
    if system.code is not None:
        return system.code
    geodetic = None if system.crs is None else system.crs.geodetic_crs
    code = None if geodetic is None else geodetic.to_epsg()
    if code is None:
        raise InputError(f"{path.name}: neither {system.name} nor its datum has an EPSG code")
    warn(f"{path.name}: its system has no EPSG code; the block is in EPSG:{code}")
    return code


# Markers ------------------------------------------------------------------------------------------------------


def read_markers(path: Path, text: str) -> GivenControl:
    """Read markers with reference coordinates and their pinned projections."""
    chunk = _chunk(path, text)
    rows, marks = _markers_of(path.name, chunk)
    return GivenControl(rows.surveyed(_system_words(chunk)), read_marks(marks))


def _chunk(path: Path, text: str) -> ElementTree.Element:
    root = ElementTree.fromstring(text)
    chunk = root if root.tag == "chunk" else root.find("chunk")
    if chunk is None:
        raise InputError(f"{path.name}: there is no <chunk>. Export markers or cameras of a chunk")
    return chunk


def _system_words(chunk: ElementTree.Element) -> str:
    words = (chunk.findtext("reference") or "").strip()
    return words if _WKT.match(words) else ""


def _markers(path: Path, chunk: ElementTree.Element) -> tuple[SurveyRows, list[Mark]]:
    """Those of the file, else those of markers.xml beside it."""
    beside = path.with_name(MARKERS_FILE)
    if chunk.find("markers//marker") is not None or not beside.is_file() or beside == path:
        return _markers_of(path.name, chunk)
    other = _chunk(beside, read_legacy_text(beside))
    if _system_words(other) != _system_words(chunk):
        raise InputError(f"{MARKERS_FILE} is in another coordinate system than {path.name}")
    return _markers_of(MARKERS_FILE, other)


def _markers_of(file: str, chunk: ElementTree.Element) -> tuple[SurveyRows, list[Mark]]:
    """Markers with reference coordinates, and the pinned projections of all markers, by the labels of cameras."""
    cameras = {e.get("id", ""): (e.get("label") or "").strip() for e in chunk.iterfind("cameras//camera")}
    labels = {e.get("id", ""): (e.get("label") or "").strip() for e in chunk.iterfind("markers//marker")}
    points = SurveyRows(file)
    for marker in chunk.iterfind("markers//marker"):
        reference = marker.find("reference")
        if reference is None or reference.get("x") is None or reference.get("y") is None:
            continue
        name = labels[marker.get("id", "")]
        place = f"{file}, marker {quoted(name)}"
        xyz = [_number(reference, key, place) for key in "xyz"]
        sigma = [_sigma(reference, key, place) for key in ("sx", "sy", "sz")]
        points.add(name, xyz, place, sigma, reference.get("enabled", "true").lower() in ("false", "0"), once=True)
    marks: list[Mark] = []
    for marker in chunk.iterfind("frames/frame/markers/marker"):
        number = marker.get("marker_id", "")
        for location in marker.iterfind("location"):
            if location.get("pinned", "true").lower() not in ("true", "1"):
                continue
            camera = location.get("camera_id", "")
            place = f"{file}, marker {quoted(labels.get(number, number))}, camera {quoted(camera)}"
            if camera not in cameras or number not in labels:
                raise InputError(f"{place}: the file has no such {'marker' if camera in cameras else 'camera'}")
            column_row = [_number(location, key, place) for key in "xy"]
            marks.append((cameras[camera], labels[number], column_row, np.nan, place))
    return points, marks


def _number(element: ElementTree.Element, key: str, place: str) -> float:
    text = element.get(key)
    if text is None and key == "z":
        return np.nan
    value = finite(text or "")
    if value is None:
        raise InputError(f"{place}: {key} is {quoted(text)}, not a number. Export the markers again")
    return value


def _sigma(reference: ElementTree.Element, key: str, place: str) -> float:
    """Standard deviation of an axis, or of all three; Metashape writes 0 for none."""
    key = key if reference.get(key) is not None else "sxyz"
    value = _number(reference, key, place) if reference.get(key) is not None else np.nan
    if value < 0:
        raise InputError(f"{place}: {key} is {value:g}; a standard deviation is positive, so correct it")
    return value if value > 0 else np.nan


# Written ------------------------------------------------------------------------------------------------------


def write(p: Project, folder: Path) -> None:
    """Write cameras.xml, beside it image_points.csv and, of control, markers.xml. Labels of cameras are ids of images.

    The axes of the chunk are those of the block, and the component's transform takes them to geocentric axes.
    """
    root, chunk = _document(p)
    sensors = add(chunk, "sensors", next_id=str(len(p.cameras)))
    for number, (name, camera) in enumerate(p.cameras.items()):
        _add_sensor(sensors, number, name, camera)
    components = add(chunk, "components", next_id="1", active_id="0")
    transform = add(add(components, "component", id="0", label="Component 1"), "transform")
    of_earth = p.frame.kind == "epsg"
    rotation, translation = p.frame.map.geocentric_from_local() if of_earth else (np.eye(3), np.zeros(3))
    for key, value in (("rotation", rotation), ("translation", translation), ("scale", 1.0)):
        add(transform, key, value, locked="true")
    rotations, positions = np.swapaxes(p.world_to_camera, 1, 2), np.asarray(p.exterior.position)
    sensor_of = {name: str(number) for number, name in enumerate(p.cameras)}
    for i, element in enumerate(_add_cameras(chunk, p)):
        element.attrib |= {"sensor_id": sensor_of[p.image_camera[i]], "component_id": "0"}
        add(element, "transform", np.vstack([np.column_stack([rotations[i], positions[i]]), [0.0, 0.0, 0.0, 1.0]]))
    add(chunk, "reference", _reference(p.frame))
    (folder / CAMERAS_FILE).write_text(xml_text(root), encoding="utf-8")
    write_image_points(p, folder, p.images)
    if p.control is not None and len(p.control.point):
        _write_markers(p, folder)


def _document(p: Project) -> tuple[ElementTree.Element, ElementTree.Element]:
    root = ElementTree.Element("document", version="2.0.0")
    return root, add(root, "chunk", label=p.title or "jaxphoto", enabled="true")


def _add_cameras(chunk: ElementTree.Element, p: Project) -> list[ElementTree.Element]:
    cameras = add(chunk, "cameras", next_id=str(len(p.images)), next_group_id="0")
    return [add(cameras, "camera", id=str(i), label=name, enabled="true") for i, name in enumerate(p.images)]


def _write_markers(p: Project, folder: Path) -> None:
    """Write control and check points as markers in the coordinate system of the file."""
    control = p.in_map().control
    assert control is not None
    placed = np.flatnonzero(~np.isnan(control.xyz[:, :2]).any(axis=1))
    if left := len(control.xyz) - len(placed):
        warn(
            f"{MARKERS_FILE}: {left} control or check points without X and Y are left out, which markers of Metashape "
            "need"
        )
    root, chunk = _document(p)
    _add_cameras(chunk, p)
    markers = add(chunk, "markers", next_id=str(len(placed)), next_group_id="0")
    frame = add(add(chunk, "frames", next_id="1"), "frame", id="0")
    marks, rows = add(frame, "markers"), p.rows_of_points
    for number, k in enumerate(placed.tolist()):
        point = int(control.point[k])
        marker = add(markers, "marker", id=str(number), label=p.points[point])
        values = [*control.xyz[k].tolist(), *control.sigma_m[k].tolist()]
        numbers = {key: repr(v) for key, v in zip(_REFERENCE, values, strict=True) if not np.isnan(v)}
        add(marker, "reference", **numbers, enabled=str(not control.check[k]).lower())
        mark = add(marks, "marker", marker_id=str(number))
        for row in rows[point].tolist():
            x, y = map(repr, p.column_row[row].tolist())
            add(mark, "location", camera_id=str(p.image[row]), pinned="true", x=x, y=y)
    add(chunk, "reference", _reference(p.frame))
    (folder / MARKERS_FILE).write_text(xml_text(root), encoding="utf-8")


def _add_sensor(sensors: ElementTree.Element, number: int, name: str, camera: ProjectCamera) -> None:
    kind, pixel_mm = _kind_of(camera.interior), camera.sensor.pixel_mm
    sensor = add(sensors, "sensor", id=str(number), label=name, type=kind)
    size = {"width": str(camera.sensor.width_px), "height": str(camera.sensor.height_px)}
    add(sensor, "resolution", **size)
    values = {"pixel_width": pixel_mm, "pixel_height": pixel_mm, "focal_length": float(camera.interior.c)}
    for key, value in values.items():
        add(sensor, "property", name=key, value=repr(float(value)))
    calibration = add(sensor, "calibration", type=kind, **{"class": "adjusted"})
    add(calibration, "resolution", **size)
    _add_values(calibration, camera.sensor, camera.interior)


def _reference(frame: Frame) -> str:
    """The coordinate system as WKT."""
    if frame.kind != "epsg" or frame.code is None:
        return _LOCAL
    compound = frame.vertical is not None
    system = CRS.from_epsg(f"{frame.code}+{frame.vertical}") if compound else map_system(frame.code)
    return system.to_wkt("WKT1_GDAL")


FORMATS = (
    Format(
        "metashape", "cameras of Agisoft Metashape, XML", find, read, write=write, plane=AGISOFT,
        fisheye=AGISOFT_FISHEYE, endings=(".xml", ".csv"), lacks=("points",),
    ),
)  # fmt: skip
CAMERAS = (
    CameraFormat(
        "agisoft",
        CameraReader(lambda path, text: "<calibration" in text and "<opencv_storage" not in text, read_calibration),
        write_calibration, AGISOFT, AGISOFT_FISHEYE, (".xml",), "<!-- {} -->",
    ),
)  # fmt: skip
CONTROL = (
    ControlFormat(
        "metashape", "markers of Metashape", lambda _, text: text.lstrip().startswith("<") and "<marker" in text,
        read_markers,
    ),
)  # fmt: skip
