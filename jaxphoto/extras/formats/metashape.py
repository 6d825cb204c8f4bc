"""Agisoft Metashape and PhotoScan: calibrations, exported cameras and markers as XML.

    calibration                              f, cx, cy, b1, b2 in pixels, k1-k4, p1-p4; cx, cy from the image centre, y
                                             down
    document/chunk/sensors/sensor            id, label, calibration
    .../components/component/transform       rotation, translation, scale: from the chunk to geocentric axes of the
                                             datum, or to the local system; chunk/transform in older files
    .../cameras//camera                      id, sensor_id, component_id, label; transform: 4 x 4, from camera axes x
                                             right, y down, z forward to the chunk
    .../markers//marker                      id, label; reference: x, y, z [sx, sy, sz] enabled (if not: check point)
    .../frames/frame/markers/marker/location camera_id, pinned (measured; others are ignored), x, y in our pixels
    .../reference                            WKT of the coordinate system

A "fisheye" (from 2.3 on "equidistant_fisheye") is the same polynomial on the equidistant projection. Exported cameras
have no tie points: they are read from a text file in the same folder, and written to image_points.csv.

Source: Agisoft Metashape User Manual, "Export cameras", "Export markers" and Appendix D; Metashape Python Reference,
Chunk.transform and Camera.transform; exported files of versions 1.5 and 2.0.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

import jax
import numpy as np
from pyproj import CRS

from jaxphoto.arrays import as_jax_array
from jaxphoto.camera import Agisoft, InteriorOrientation, Sensor
from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.control import Mark, SurveyRows, read_marks
from jaxphoto.extras.formats.files import (
    CameraFormat,
    ControlFormat,
    Format,
    add,
    by_content,
    number_rows,
    warn,
    xml_text,
)
from jaxphoto.extras.formats.project import (
    AGISOFT,
    AGISOFT_FISHEYE,
    ControlPoints,
    Project,
    ProjectCamera,
    geocentric,
    is_geocentric,
    pose,
)
from jaxphoto.extras.formats.texts import points_beside, with_marks, write_image_points
from jaxphoto.io.camera_files import CameraFile, CameraReader, CameraSource
from jaxphoto.io.text_files import has_words, read_text
from jaxphoto.io.text_tables import finite
from jaxphoto.procedures.control.surveyed import GivenControl, system_of

CAMERAS_FILE = "cameras.xml"
_MODELS = {"frame": AGISOFT, "fisheye": AGISOFT_FISHEYE, "equidistant_fisheye": AGISOFT_FISHEYE}
_SCALED = ("b1", "b2")
_TERMS = ("f", "cx", "cy", *Agisoft.coefficients)
_PARAMETERS = {"f": "c_mm", "cx": "xp_mm", "cy": "yp_mm"} | {name: name for name in Agisoft.coefficients}
_REFERENCE = ("x", "y", "z", "sx", "sy", "sz")
_WKT = re.compile(r"\s*[A-Z_]{5,}\[")
_LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'


# Calibrations -------------------------------------------------------------------------------------------------


def read_calibration(source: CameraSource) -> CameraFile:
    """Read the camera of a calibration file, or one sensor of exported cameras."""
    root = ElementTree.fromstring(source.text())
    if root.tag == "calibration":
        return _camera(source, source.path.stem, root)
    sensors = {name: (calibration, sensor) for name, sensor, calibration in _sensors(root).values()}
    name = source.chosen(list(sensors))
    return _camera(source, name, *sensors[name])


def _sensors(root: ElementTree.Element) -> dict[str, tuple[str, ElementTree.Element, ElementTree.Element]]:
    """Return name, element and calibration (adjusted, otherwise initial) of each calibrated sensor by id.

    The name is the label, followed by the id if labels are equal.
    """
    sensors, labels = list(root.iter("sensor")), [(s.get("label") or "camera").strip() for s in root.iter("sensor")]
    calibrated = {}
    for sensor, label in zip(sensors, labels, strict=True):
        calibration = sensor.find("calibration[@class='adjusted']")
        calibration = sensor.find("calibration") if calibration is None else calibration
        if calibration is not None:
            key = sensor.get("id", "")
            calibrated[key] = label if labels.count(label) == 1 else f"{label} {key}", sensor, calibration
    return calibrated


def _camera(
    source: CameraSource, name: str, calibration: ElementTree.Element, element: ElementTree.Element | None = None
) -> CameraFile:
    kind = (calibration.findtext("projection") or calibration.get("type") or "frame").strip()
    if kind not in _MODELS:
        raise source.error(f"projection {quoted(kind)} is not supported; use one of {', '.join(_MODELS)}")
    resolution = calibration.find("resolution")
    width, height = (
        source.number(side, calibration.findtext(side) if resolution is None else resolution.get(side))
        for side in ("width", "height")
    )
    pixel = None if element is None else element.find(".//property[@name='pixel_width']")
    pixel_mm = None if pixel is None else source.number("pixel_width", pixel.get("value"))
    sensor, assumed = source.sensor(width, height, pixel_mm)
    numbers = {child.tag: source.number(child.tag, child.text) for child in calibration if child.tag in _TERMS}
    values = dict.fromkeys(_TERMS, 0.0) | numbers
    f = values.pop("f")
    if not f > 0:
        raise source.error("<f> is missing or not positive; give the focal length in pixels")
    x_p, y_p = values.pop("cx") * sensor.pixel_mm, -values.pop("cy") * sensor.pixel_mm
    distortion = Agisoft(**{k: v / f if k in _SCALED else v for k, v in values.items()})
    projection = _MODELS[kind].projection
    interior = InteriorOrientation(f * sensor.pixel_mm, x_p, y_p, distortion, projection=projection)
    return CameraFile(name, sensor, jax.tree.map(as_jax_array, interior), None, assumed)


def write_calibration(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a calibration file; terms equal to zero are omitted."""
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
    values = {"f": f, "cx": float(interior.xp) / sensor.pixel_mm, "cy": -float(interior.yp) / sensor.pixel_mm}
    for key in Agisoft.coefficients:
        values[key] = float(getattr(interior.distortion, key)) * (f if key in _SCALED else 1.0)
    for key, number in values.items():
        if number != 0:
            add(calibration, key, number)


# Exported cameras ---------------------------------------------------------------------------------------------


def find(source: Path) -> list[Path]:
    """Return files of exported cameras; in a folder, files with aligned cameras have priority."""
    exported = by_content("*.xml", lambda path: has_words(path, "<document", "<chunk", "<cameras"))(source)
    return [path for path in exported if has_words(path, "<transform")] or exported


def read(path: Path) -> Project:
    """Read exported cameras, and tie points from the same folder. Free camera parameters are Metashape's estimated
    ones.

    Positions are in the file's coordinate system; markers are control points there. If there are several components,
    the one with most cameras is read.
    """
    chunk = _chunk(path, read_text(path))
    every = chunk.findall("cameras//camera")
    components = Counter(photo.get("component_id", "") for photo in every if photo.find("transform") is not None)
    if not components:
        raise InputError(f"{path.name}: no camera is aligned; align them (markers alone are for jaxphoto control)")
    ((component, _),) = components.most_common(1)
    photos = [p for p in every if p.find("transform") is not None and p.get("component_id", "") == component]
    if len(photos) < len(every):
        warn(f"{path.name}: skipped {len(every) - len(photos)} camera(s), unaligned or of smaller components")
    sensors = _project_cameras(path, chunk)
    labels = [(photo.get("label") or "").strip() for photo in photos]
    for photo, label in zip(photos, labels, strict=True):
        if not label or photo.get("sensor_id", "") not in sensors:
            raise InputError(
                f"{path.name}, camera {quoted(label)}: no label, or its sensor is not calibrated. Calibrate it"
            )
    place = lambda k: f"{path.name}, camera {quoted(labels[k])}, transform"  # noqa: E731
    words = [(photo.findtext("transform") or "").split() for photo in photos]
    poses = number_rows(words, (16,), place).reshape(-1, 4, 4)
    georeferenced = _transform(path, chunk, component)
    rotation, translation, scale = georeferenced or (np.eye(3), np.zeros(3), np.ones(1))
    rotation = rotation.reshape(3, 3)
    centres = translation + scale * poses[:, :3, 3] @ rotation.T
    rotations = np.swapaxes(rotation @ poses[:, :3, :3], 1, 2)
    # Without the name of a system, geocentric positions are on WGS 84.
    system = system_of(_system_words(chunk) or ("EPSG:4326" if is_geocentric(centres) else "local"), path.name)
    if georeferenced and system.crs is not None and system.code is None:
        raise InputError(f"{path.name}: {system.name} has no EPSG code; export it in an EPSG system")
    rows, marks = _markers(path.name, chunk)
    camera_of = [sensors[photo.get("sensor_id", "")] for photo in photos]
    shown = points_beside(path, labels, [camera for _, camera in camera_of])
    shown = with_marks(shown, marks, labels, path.name)
    if not len(shown.image):
        raise InputError(
            f"{path.name} has no tie points and no marks; export tie points as BINGO or PATB into its folder"
        )
    project = Project(
        chunk.get("label") or path.stem, dict(sensors.values()), (), labels, [name for name, _ in camera_of],
        pose(rotations, centres), shown.points, None, shown.image, shown.point, shown.column_row,
        sigma_px=shown.sigma_px, file=path.name,
    )  # fmt: skip
    if georeferenced and system.code is not None:
        project = geocentric(project, system.code, system.vertical).in_map()
    if not len(rows):
        return project
    if not georeferenced:
        warn(f"{path.name} is not georeferenced: skipped {len(rows)} markers with coordinates")
        return project
    surveyed, number = rows.surveyed(), {name: k for k, name in enumerate(shown.points)}
    there = [k for k, name in enumerate(surveyed.ids) if name in number]
    point = np.array([number[surveyed.ids[k]] for k in there], int)
    control = ControlPoints(point, surveyed.coordinates[there], surveyed.sigma_m[there], surveyed.check[there])
    return project._replace(control=control)


def _project_cameras(path: Path, chunk: ElementTree.Element) -> dict[str, tuple[str, ProjectCamera]]:
    """Return name and camera of each calibrated sensor by id."""
    cameras = {}
    for key, (name, sensor, calibration) in _sensors(chunk).items():
        read_camera = _camera(CameraSource(path), name, calibration, sensor)
        camera = ProjectCamera.estimated(read_camera.sensor, read_camera.interior)
        estimated = (sensor.findtext("covariance/params") or "").split()
        if free := tuple(_PARAMETERS[term] for term in estimated if term in _PARAMETERS):
            camera = camera._replace(free=free)
        if sensor.find("property[@name='fixed'][@value='true']") is not None:
            camera = camera._replace(free=())
        cameras[key] = name, camera
    return cameras


def _transform(path: Path, chunk: ElementTree.Element, component: str) -> list[np.ndarray] | None:
    """Return rotation, translation and scale from the chunk to the world; None if the file has no transform."""
    transform = chunk.find(f"components/component[@id='{component}']/transform")
    transform = chunk.find("transform") if transform is None else transform
    if transform is None or transform.find("rotation") is None:
        return None
    values = []
    for key, size in (("rotation", 9), ("translation", 3), ("scale", 1)):
        words = transform.findtext(key, "1").split()
        values += [*number_rows([words], (size,), lambda _, key=key: f"{path.name}, transform, {key}")]  # type: ignore[misc]
    if not values[2] > 0:
        raise InputError(f"{path.name}, transform: scale {values[2][0]:g} is not positive; re-export the cameras")
    return values


# Markers ------------------------------------------------------------------------------------------------------


def read_markers(path: Path, text: str) -> GivenControl:
    """Read markers with reference coordinates, and their pinned projections."""
    chunk = _chunk(path, text)
    rows, marks = _markers(path.name, chunk)
    return GivenControl(rows.surveyed(_system_words(chunk)), read_marks(marks))


def _chunk(path: Path, text: str) -> ElementTree.Element:
    root = ElementTree.fromstring(text)
    chunk = root if root.tag == "chunk" else root.find("chunk")
    if chunk is None:
        raise InputError(f"{path.name}: missing <chunk>. Export markers or cameras of a chunk")
    return chunk


def _system_words(chunk: ElementTree.Element) -> str:
    words = (chunk.findtext("reference") or "").strip()
    return words if _WKT.match(words) else ""


def _markers(file: str, chunk: ElementTree.Element) -> tuple[SurveyRows, list[Mark]]:
    """Return markers with reference coordinates, and the pinned projections of all markers by camera label."""
    cameras = {e.get("id", ""): (e.get("label") or "").strip() for e in chunk.iterfind("cameras//camera")}
    labels = {e.get("id", ""): (e.get("label") or "").strip() for e in chunk.iterfind("markers//marker")}
    points = SurveyRows(file)
    for marker in chunk.iterfind("markers//marker"):
        reference = marker.find("reference")
        if reference is None or reference.get("x") is None or reference.get("y") is None:
            continue
        name = labels[marker.get("id", "")]
        place, get = f"{file}, marker {quoted(name)}", reference.get
        xyz = [_number(get(key, "nan" if key == "z" else ""), key, place) for key in "xyz"]
        # A standard deviation of 0 means unknown in Metashape.
        sigma = [_number(get(key, get("sxyz", "nan")), key, place) or np.nan for key in ("sx", "sy", "sz")]
        points.add(name, xyz, place, sigma, get("enabled", "true").lower() in ("false", "0"))
    marks: list[Mark] = []
    for marker in chunk.iterfind("frames/frame/markers/marker"):
        number = marker.get("marker_id", "")
        for location in marker.iterfind("location"):
            if location.get("pinned", "true").lower() not in ("true", "1"):
                continue
            camera = location.get("camera_id", "")
            place = f"{file}, marker {quoted(labels.get(number, number))}, camera {quoted(camera)}"
            if camera not in cameras or number not in labels:
                raise InputError(f"{place}: unknown marker or camera. Export the markers again")
            column_row = [_number(location.get(key, ""), key, place) for key in "xy"]
            marks.append((cameras[camera], labels[number], column_row, np.nan, place))
    return points, marks


def _number(text: str, key: str, place: str) -> float:
    """Parse a number; "nan" stands for a missing one."""
    value = np.nan if text == "nan" and key not in ("x", "y") else finite(text)
    if value is None or (key.startswith("s") and value < 0):
        raise InputError(f"{place}: {key} is {quoted(text)}, not a valid number. Export the markers again")
    return value


# Written ------------------------------------------------------------------------------------------------------


def write(p: Project, folder: Path) -> None:
    """Write cameras.xml, with control points as markers, and image_points.csv. Camera labels are image ids.

    The chunk uses the axes of the block; the component's transform converts to geocentric axes.
    """
    root = ElementTree.Element("document", version="2.0.0")
    chunk = add(root, "chunk", label=p.title or "jaxphoto", enabled="true")
    sensors = add(chunk, "sensors", next_id=str(len(p.cameras)))
    for number, (name, (camera_sensor, interior, _)) in enumerate(p.cameras.items()):
        kind, pixel_mm = _kind_of(interior), camera_sensor.pixel_mm
        sensor = add(sensors, "sensor", id=str(number), label=name, type=kind)
        size = {"width": str(camera_sensor.width_px), "height": str(camera_sensor.height_px)}
        add(sensor, "resolution", **size)
        for key, mm in (("pixel_width", pixel_mm), ("pixel_height", pixel_mm), ("focal_length", interior.c)):
            add(sensor, "property", name=key, value=repr(float(mm)))
        calibration = add(sensor, "calibration", type=kind, **{"class": "adjusted"})
        add(calibration, "resolution", **size)
        _add_values(calibration, camera_sensor, interior)
    components = add(chunk, "components", next_id="1", active_id="0")
    transform = add(add(components, "component", id="0", label="Component 1"), "transform")
    of_earth = p.frame.kind == "epsg"
    rotation, translation = p.frame.map.geocentric_from_local() if of_earth else (np.eye(3), np.zeros(3))
    for key, value in (("rotation", rotation), ("translation", translation), ("scale", 1.0)):
        add(transform, key, value, locked="true")
    rotations, positions = np.swapaxes(p.world_to_camera, 1, 2), np.asarray(p.exterior.position)
    sensor_of = {name: str(number) for number, name in enumerate(p.cameras)}
    cameras = add(chunk, "cameras", next_id=str(len(p.images)), next_group_id="0")
    for i, name in enumerate(p.images):
        ids = {"id": str(i), "sensor_id": sensor_of[p.image_camera[i]], "component_id": "0"}
        element = add(cameras, "camera", **ids, label=name, enabled="true")
        add(element, "transform", np.vstack([np.column_stack([rotations[i], positions[i]]), [0.0, 0.0, 0.0, 1.0]]))
    _add_markers(chunk, p)
    code, vertical = p.frame.code, p.frame.vertical
    system = CRS.from_epsg(f"{code}" if vertical is None else f"{code}+{vertical}") if of_earth else None
    add(chunk, "reference", _LOCAL if system is None else system.to_wkt("WKT1_GDAL"))
    (folder / CAMERAS_FILE).write_text(xml_text(root), encoding="utf-8")
    write_image_points(p, folder, p.images)


def _add_markers(chunk: ElementTree.Element, p: Project) -> None:
    """Add control and check points in the coordinate system of the export, and their image points."""
    control = p.in_map().control
    if control is None or not len(control.point):
        return
    placed = np.flatnonzero(~np.isnan(control.xyz[:, :2]).any(axis=1))
    if left := len(control.xyz) - len(placed):
        warn(f"{CAMERAS_FILE}: skipped {left} control or check points without X and Y (markers of Metashape need both)")
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
