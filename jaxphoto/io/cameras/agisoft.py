"""Agisoft's calibration XML: f, cx, cy, b1, b2 in pixels and k1-k4, p1-p4 of Metashape and PhotoScan.

cx and cy run from the image centre, y down. Exported cameras (<document>) hold the same per sensor, with the size of a
pixel. Files with fx, fy and skew are of PhotoScan before 1.2 and of Agisoft Lens: cx and cy run from the upper left
corner, f = fy, b1 = fx - fy, b2 = skew, and p1 and p2 are in OpenCV's order.
A "fisheye" is the same polynomial on the equidistant projection, (x, y) = theta (X, Y) / |(X, Y)|; since version 2.3 it
is called equidistant there, beside an equisolid one.
Source: Agisoft Metashape User Manual, Appendix D "Camera models"; Metashape Expert Manual, "Fisheye and spherical
sensors"; Agisoft Lens User Manual 0.4; Agisoft's forum, topic 6437.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax

from jaxphoto.arrays import on_device
from jaxphoto.camera import Agisoft, Equidistant, InteriorOrientation, Perspective, Sensor
from jaxphoto.errors import quoted
from jaxphoto.io.cameras.camera_file import CameraFile, CameraModel, CameraSource, joined_notes

PLANE = CameraModel(Agisoft, ("p3", "p4"), Perspective())
FISHEYE = CameraModel(Agisoft, ("p3", "p4"), Equidistant())
"""What its cameras are here."""
_MODELS = {"frame": PLANE, "fisheye": FISHEYE, "equidistant_fisheye": FISHEYE}
_SCALED = ("b1", "b2")
_COEFFICIENTS = tuple(name for name in Agisoft.coefficients if name not in _SCALED)
_KNOWN = ("f", "fx", "fy", "cx", "cy", "skew", *Agisoft.coefficients)


def recognises(path: Path, text: str) -> bool:
    """Whether `text` is XML with a <calibration>."""
    return "<calibration" in text and "<opencv_storage" not in text


def read_agisoft(source: CameraSource) -> CameraFile:
    """The camera of a calibration file, or one sensor of exported cameras.

    Raises InputError for a file that is cut off, projections that are not known, missing elements, and what is no
    number.
    """
    try:
        root = ElementTree.fromstring(source.text())
    except ElementTree.ParseError as error:
        raise source.error(f"the XML is broken ({error}); it is cut off or was changed, so export it anew") from None
    found = {source.path.stem: (root, None)} if root.tag == "calibration" else _sensors(root)
    name = source.chosen(list(found))
    return _camera(source, name, *found[name])


def read_sensor(source: CameraSource, name: str, sensor: ElementTree.Element) -> CameraFile | None:
    """The camera of one <sensor> of exported cameras, None where it is not calibrated. Raises as `read_agisoft`."""
    calibration, pixel = _calibration(sensor)
    return None if calibration is None else _camera(source, name, calibration, pixel)


def _camera(source: CameraSource, name: str, calibration: ElementTree.Element, pixel: str | None) -> CameraFile:
    kind = (calibration.findtext("projection") or calibration.get("type") or "frame").strip()
    if kind not in _MODELS:
        raise source.error(f"the projection {quoted(kind)} is not known here; known are {', '.join(_MODELS)}")
    pixel_mm = source.number("pixel_width", pixel) if pixel is not None else None
    sensor, assumed = source.sensor(*_size(source, calibration), pixel_mm)
    values, note = _values(source, calibration, sensor)
    f = values.pop("f")
    x_p, y_p = values.pop("cx") * sensor.pixel_mm, -values.pop("cy") * sensor.pixel_mm
    distortion = Agisoft(**{k: v / f if k in _SCALED else v for k, v in values.items()})
    projection = _MODELS[kind].projection
    interior = InteriorOrientation(f * sensor.pixel_mm, x_p, y_p, distortion, projection=projection)
    return CameraFile(name, sensor, jax.tree.map(on_device, interior), None, joined_notes(note, assumed))


def write_agisoft(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera that is a `PLANE` or `FISHEYE` as a calibration file; what is 0 is left out, as there."""
    root = ElementTree.Element("calibration")
    texts = {"projection": kind_of(interior), "width": str(sensor.width_px), "height": str(sensor.height_px)}
    for key, text in texts.items():
        ElementTree.SubElement(root, key).text = text
    add_values(root, sensor, interior)
    path.write_text(xml_text(root), "utf-8")


def kind_of(interior: InteriorOrientation) -> str:
    """What its files call a `PLANE` or `FISHEYE`."""
    return next(kind for kind, model in _MODELS.items() if type(model.projection) is type(interior.projection))


def add_values(calibration: ElementTree.Element, sensor: Sensor, interior: InteriorOrientation) -> None:
    """The elements f, cx, cy and coefficients of a camera with the distortion `Agisoft`, without those that are 0."""
    f, d = float(interior.c) / sensor.pixel_mm, interior.distortion
    values: dict[str, float] = {"f": f}
    values |= {"cx": float(interior.x_p) / sensor.pixel_mm, "cy": -float(interior.y_p) / sensor.pixel_mm}
    values |= {key: float(getattr(d, key)) * f for key in _SCALED}
    values |= {key: float(getattr(d, key)) for key in _COEFFICIENTS}
    for key, number in values.items():
        if number != 0:
            ElementTree.SubElement(calibration, key).text = repr(float(number))


def xml_text(root: ElementTree.Element) -> str:
    """The content of an XML file."""
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, "unicode")}\n'


def _sensors(root: ElementTree.Element) -> dict[str, tuple[ElementTree.Element, str | None]]:
    """Calibration and size of a pixel of every calibrated sensor, by its label."""
    found = {}
    for sensor in root.iter("sensor"):
        calibration, pixel = _calibration(sensor)
        if calibration is not None:
            label = sensor.get("label", sensor.get("id", ""))
            found[label if label not in found else f"{label} {sensor.get('id')}"] = (calibration, pixel)
    return found


def _calibration(sensor: ElementTree.Element) -> tuple[ElementTree.Element | None, str | None]:
    """The calibration of a <sensor>, and the size of its pixels: what was estimated goes before what was given."""
    calibrations = {c.get("class", "adjusted"): c for c in sensor.findall("calibration")}
    sizes = {p.get("name"): p.get("value") for p in sensor.iter("property")}
    return calibrations.get("adjusted", calibrations.get("initial")), sizes.get("pixel_width")


def _values(source: CameraSource, calibration: ElementTree.Element, sensor: Sensor) -> tuple[dict[str, float], str]:
    """f, cx, cy, b1, b2 and coefficients as Metashape has them, and what was assumed of an older file."""
    older = calibration.find("f") is None and calibration.find("fx") is not None
    for key in ("fx", "fy") if older else ("f",):
        if calibration.findtext(key) is None:
            raise source.error(f"<{key}> is missing; add it")
    given = {child.tag: source.number(child.tag, child.text) for child in calibration if child.tag in _KNOWN}
    for key in ("f", "fx", "fy"):
        if key in given and not given[key] > 0:
            raise source.error(f"{key} is {given[key]:g} pixels; a focal length is positive")
    values = {key: given.get(key, 0.0) for key in ("f", "cx", "cy", *Agisoft.coefficients)}
    if not older:
        return values, ""
    values |= {"f": given["fy"], "b1": given["fx"] - given["fy"], "b2": given.get("skew", 0.0)}
    values |= {
        key: given[key] - side / 2 for key, side in (("cx", sensor.width_px), ("cy", sensor.height_px)) if key in given
    }
    values |= {"p1": values["p2"], "p2": values["p1"]}
    tangential = values["p1"] != 0 or values["p2"] != 0
    return values, "fx and fy are of an old version; its p1 and p2 were taken in OpenCV's order" * tangential


def _size(source: CameraSource, calibration: ElementTree.Element) -> tuple[float, float]:
    resolution = calibration.find("resolution")
    given = [calibration.findtext(side) if resolution is None else resolution.get(side) for side in ("width", "height")]
    if None in given and source.size_px is not None:
        given = list(map(str, source.size_px))
    if None in given:
        raise source.error("<width> or <height> is missing; add both")
    return source.number("width", given[0]), source.number("height", given[1])
