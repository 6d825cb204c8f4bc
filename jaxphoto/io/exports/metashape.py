"""Adjusted photographs -> exported cameras of Agisoft Metashape (cameras.xml).

A camera's <transform> takes its axes, x right, y down, z ahead, to those of the chunk, which are those of the block;
the component's <transform> takes these to the geocentric axes of the datum, so that nothing is lost by a map. A block
in a local frame stays there. Points have no place in the file; image points stand beside it, and control as
markers in a file of their own, which Metashape imports by itself.
Source: Agisoft Metashape User Manual, Appendix D "Camera models" and "Export cameras" and "Export markers"; Metashape
Python Reference, Chunk.transform and Camera.transform; exported files of versions 1.5 and 2.0.
"""

import warnings
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from pyproj import CRS

from jaxphoto.block import Frame
from jaxphoto.georeferencing.map_frame import map_system
from jaxphoto.io.cameras.agisoft import add_values, kind_of, xml_text
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, ExportCamera, downwards
from jaxphoto.io.exports.image_points import write_image_points
from jaxphoto.io.reconstructions.metashape import MARKERS

FILE = "cameras.xml"
_REFERENCE = ("x", "y", "z", "sx", "sy", "sz")
_LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]]]'


def write_metashape(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write cameras.xml into `folder`, beside it image_points.csv and, of control, markers.xml.

    Cameras are called by the ids of images, as Metashape calls photographs.
    """
    p = photographs
    root, chunk = _document(p)
    sensors = ElementTree.SubElement(chunk, "sensors", next_id=str(len(p.cameras)))
    for number, (name, camera) in enumerate(p.cameras.items()):
        _add_sensor(sensors, number, name, camera)
    components = ElementTree.SubElement(chunk, "components", next_id="1", active_id="0")
    component = ElementTree.SubElement(components, "component", id="0", label="Component 1")
    _add_transform(component, p.frame)
    cameras = ElementTree.SubElement(chunk, "cameras", next_id=str(len(p.images)), next_group_id="0")
    rotations, positions = np.swapaxes(downwards(p.exterior), 1, 2), np.asarray(p.exterior.position)
    sensor_of = {name: str(number) for number, name in enumerate(p.cameras)}
    for i, name in enumerate(p.images):
        attributes = {"id": str(i), "sensor_id": sensor_of[p.image_camera[i]], "component_id": "0", "label": name}
        element = ElementTree.SubElement(cameras, "camera", attributes, enabled="true")
        rows = np.vstack([np.column_stack([rotations[i], positions[i]]), [0.0, 0.0, 0.0, 1.0]])
        ElementTree.SubElement(element, "transform").text = _numbers(rows)
    ElementTree.SubElement(chunk, "reference").text = _reference(p.frame)
    (folder / FILE).write_text(xml_text(root), encoding="utf-8")
    write_image_points(p, folder, p.images)
    _write_markers(p, folder)


def _document(p: AdjustedPhotographs) -> tuple[ElementTree.Element, ElementTree.Element]:
    root = ElementTree.Element("document", version="2.0.0")
    return root, ElementTree.SubElement(root, "chunk", label=p.title or "jaxphoto", enabled="true")


def _write_markers(p: AdjustedPhotographs, folder: Path) -> None:
    """Write markers.xml where the block has control or check points: markers, where photographs show them, and their
    coordinates in the system of the file. A marker whose reference is not enabled is a check point.

    A UserWarning counts those without easting and northing, which are left out.
    """
    if p.control is None or not len(p.control.point):
        return
    coordinates = p.control.on_map(p.frame, p.xyz)
    placed = np.flatnonzero(~np.isnan(coordinates[:, :2]).any(axis=1))
    if left := len(coordinates) - len(placed):
        warnings.warn(
            f"{MARKERS}: {left} control or check points without X and Y are left out, which markers of Metashape need",
            UserWarning,
            stacklevel=4,
        )
    root, chunk = _document(p)
    cameras = ElementTree.SubElement(chunk, "cameras", next_id=str(len(p.images)), next_group_id="0")
    for i, name in enumerate(p.images):
        ElementTree.SubElement(cameras, "camera", id=str(i), label=name, enabled="true")
    markers = ElementTree.SubElement(chunk, "markers", next_id=str(len(placed)), next_group_id="0")
    frame = ElementTree.SubElement(ElementTree.SubElement(chunk, "frames", next_id="1"), "frame", id="0")
    marks, rows = ElementTree.SubElement(frame, "markers"), p.rows_of_points
    for number, k in enumerate(placed.tolist()):
        point = int(p.control.point[k])
        marker = ElementTree.SubElement(markers, "marker", id=str(number), label=p.points[point])
        values = [*coordinates[k].tolist(), *p.control.sigma_m[k].tolist()]
        given = {key: repr(v) for key, v in zip(_REFERENCE, values, strict=True) if not np.isnan(v)}
        ElementTree.SubElement(marker, "reference", given, enabled=str(not p.control.check[k]).lower())
        shown = ElementTree.SubElement(marks, "marker", marker_id=str(number))
        for row in rows[point].tolist():
            x, y = map(repr, p.column_row[row].tolist())
            ElementTree.SubElement(shown, "location", camera_id=str(p.image[row]), pinned="true", x=x, y=y)
    ElementTree.SubElement(chunk, "reference").text = _reference(p.frame)
    (folder / MARKERS).write_text(xml_text(root), encoding="utf-8")


def _add_sensor(sensors: ElementTree.Element, number: int, name: str, camera: ExportCamera) -> None:
    given, kind = camera.sensor, kind_of(camera.interior)
    sensor = ElementTree.SubElement(sensors, "sensor", id=str(number), label=name, type=kind)
    size = {"width": str(given.width_px), "height": str(given.height_px)}
    ElementTree.SubElement(sensor, "resolution", size)
    values = {"pixel_width": given.pixel_mm, "pixel_height": given.pixel_mm, "focal_length": float(camera.interior.c)}
    for key, value in values.items():
        ElementTree.SubElement(sensor, "property", name=key, value=repr(float(value)))
    calibration = ElementTree.SubElement(sensor, "calibration", {"type": kind, "class": "adjusted"})
    ElementTree.SubElement(calibration, "resolution", size)
    add_values(calibration, given, camera.interior)


def _add_transform(component: ElementTree.Element, frame: Frame) -> None:
    rotation, translation = frame.map.geocentric_from_local() if frame.kind == "epsg" else (np.eye(3), np.zeros(3))
    transform = ElementTree.SubElement(component, "transform")
    for key, value in (("rotation", rotation), ("translation", translation), ("scale", np.ones(1))):
        ElementTree.SubElement(transform, key, locked="true").text = _numbers(value)


def _reference(frame: Frame) -> str:
    """The coordinate system as WKT."""
    if frame.kind != "epsg" or frame.code is None:
        return _LOCAL
    system = map_system(frame.code)
    if frame.vertical is not None:
        system = CRS.from_epsg(f"{frame.code}+{frame.vertical}")
    return system.to_wkt("WKT1_GDAL")


def _numbers(values: np.ndarray) -> str:
    return " ".join(map(repr, np.asarray(values, float).ravel().tolist()))
