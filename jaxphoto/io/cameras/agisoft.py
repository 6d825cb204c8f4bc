"""Agisoft's calibration XML: f, cx, cy, b1, b2 in pixels and k1-k4, p1-p4 of Metashape and PhotoScan.

cx and cy run from the image centre, y down. Exported cameras (<document>) hold the same per sensor, with the size of a
pixel. Files with fx, fy and skew are older; which of p1 and p2 is which depended on the version then.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax

from jaxphoto.arrays import on_device
from jaxphoto.camera import Agisoft, InteriorOrientation, Sensor
from jaxphoto.io.cameras.camera_file import CameraFile, Source

_SCALED = ("b1", "b2")
_COEFFICIENTS = tuple(name for name in Agisoft.coefficients if name not in _SCALED)


def recognises(path: Path, text: str) -> bool:
    """Whether `text` is XML with a <calibration>."""
    return "<calibration" in text and "<opencv_storage" not in text


def read_agisoft(source: Source) -> CameraFile:
    """The frame camera of a calibration file, or one sensor of exported cameras.

    Raises InputError for a file that is cut off, other projections than "frame", missing or old elements.
    """
    try:
        root = ElementTree.fromstring(source.text())
    except ElementTree.ParseError as error:
        raise source.error(f"the XML is broken ({error}); it is cut off or was changed, so export it anew") from None
    found = {source.path.stem: (root, None)} if root.tag == "calibration" else _sensors(root)
    name = source.chosen(list(found))
    calibration, pixel = found[name]
    kind = calibration.findtext("projection") or calibration.get("type") or "frame"
    if kind.strip() != "frame":
        raise source.error(f'the projection {kind.strip()!r} is not known here; only "frame" is')
    if calibration.find("f") is None and calibration.find("fx") is not None:
        raise source.error("fx, fy and skew are of old versions, which differ in p1 and p2; export it from Metashape")
    pixel_mm = source.number("pixel_width", pixel) if pixel is not None else None
    sensor, assumed = source.sensor(*_size(source, calibration), pixel_mm)
    f = source.number("f", _needed(source, calibration, "f"))
    if not f > 0:
        raise source.error(f"f is {f:g} pixels; a focal length is positive")
    value = lambda key: source.number(key, calibration.findtext(key, "0"))  # noqa: E731
    coefficients = {k: value(k) for k in _COEFFICIENTS} | {k: value(k) / f for k in _SCALED}
    x_p, y_p = value("cx") * sensor.pixel_mm, -value("cy") * sensor.pixel_mm
    interior = InteriorOrientation(f * sensor.pixel_mm, x_p, y_p, Agisoft(**coefficients))
    return CameraFile(name, sensor, jax.tree.map(on_device, interior), None, assumed)


def write_agisoft(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera with the distortion `Agisoft` as a calibration file; what is 0 is left out, as there."""
    f, d = float(interior.c) / sensor.pixel_mm, interior.distortion
    values: dict[str, float] = {"f": f}
    values |= {"cx": float(interior.x_p) / sensor.pixel_mm, "cy": -float(interior.y_p) / sensor.pixel_mm}
    values |= {key: float(getattr(d, key)) * f for key in _SCALED}
    values |= {key: float(getattr(d, key)) for key in _COEFFICIENTS}
    root = ElementTree.Element("calibration")
    for key, text in (("projection", "frame"), ("width", str(sensor.width_px)), ("height", str(sensor.height_px))):
        ElementTree.SubElement(root, key).text = text
    for key, number in values.items():
        if number != 0:
            ElementTree.SubElement(root, key).text = repr(number)
    ElementTree.indent(root)
    path.write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, "unicode")}\n', "utf-8")


def _sensors(root: ElementTree.Element) -> dict[str, tuple[ElementTree.Element, str | None]]:
    """Calibration and size of a pixel of every calibrated sensor, by its label."""
    found = {}
    for sensor in root.iter("sensor"):
        calibrations = {c.get("class", "adjusted"): c for c in sensor.findall("calibration")}
        # What was estimated goes before what was given.
        best = calibrations.get("adjusted", calibrations.get("initial"))
        sizes = {p.get("name"): p.get("value") for p in sensor.iter("property")}
        if best is not None:
            label = sensor.get("label", sensor.get("id", ""))
            found[label if label not in found else f"{label} {sensor.get('id')}"] = (best, sizes.get("pixel_width"))
    return found


def _size(source: Source, calibration: ElementTree.Element) -> tuple[float, float]:
    resolution = calibration.find("resolution")
    given = [calibration.findtext(side) if resolution is None else resolution.get(side) for side in ("width", "height")]
    if None in given and source.size_px is not None:
        given = list(map(str, source.size_px))
    if None in given:
        raise source.error("<width> or <height> is missing; add both")
    return source.number("width", given[0]), source.number("height", given[1])


def _needed(source: Source, calibration: ElementTree.Element, key: str) -> str:
    text = calibration.findtext(key)
    if text is None:
        raise source.error(f"<{key}> is missing; add it")
    return text
