"""Markers of Agisoft Metashape as XML, with their reference coordinates and projections.

    document/chunk/cameras//camera        id, label: the photographs
    document/chunk/markers//marker        id, label; reference: x, y, z [sx, sy, sz] enabled
    document/chunk/frames/frame/markers/marker/location     camera_id, pinned, x, y
    document/chunk/reference              WKT of the system of cameras, or of markers where that is not told apart

Only pinned projections were measured. A marker whose reference is not enabled is a check point, as there. Pixels are
counted as here: the centre of the upper-left one is (0.5, 0.5). x is the easting or longitude.
Source: Agisoft Metashape User Manual, "Supported formats" and Appendix; exported files.
"""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.control_files.rows import Mark, SurveyRows, read_marks
from jaxphoto.io.text_tables import finite
from jaxphoto.procedures.control.surveyed import GivenControl

_TRUE, _FALSE = ("true", "1"), ("false", "0")
_WKT = re.compile(r"\s*[A-Z_]{5,}\[")


def recognises(text: str) -> bool:
    """Whether `text` is XML with markers."""
    return text.lstrip().startswith("<") and "<marker" in text


def read_metashape_markers(path: Path, text: str) -> GivenControl:
    """Markers with reference coordinates and their pinned projections.

    Raises InputError for broken XML, and for numbers, cameras or markers that are none.
    """
    chunk = only_chunk(path, text)
    rows, marks = markers_of(path.name, chunk)
    return GivenControl(rows.surveyed(system_words(chunk)), read_marks(marks))


def only_chunk(path: Path, text: str) -> ElementTree.Element:
    """The <chunk> of an exported file. Raises InputError for broken XML, and where there is none."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(
            f"{path.name}: the XML is broken ({error}); it is cut off or was changed, export it anew"
        ) from None
    chunk = root if root.tag == "chunk" else root.find("chunk")
    if chunk is None:
        raise InputError(
            f"{path.name}: there is no <chunk>; export the markers or cameras of a chunk (File, Export, Export "
            "Markers, Export Cameras)"
        )
    return chunk


def system_words(chunk: ElementTree.Element) -> str:
    """What a chunk says of its coordinate system: WKT, or nothing."""
    words = (chunk.findtext("reference") or "").strip()
    return words if _WKT.match(words) else ""


def markers_of(file: str, chunk: ElementTree.Element) -> tuple[SurveyRows, list[Mark]]:
    """Markers with reference coordinates, and the pinned projections of all markers, by the labels of cameras."""
    cameras = _labels(chunk.iterfind("cameras//camera"), file, "camera")
    labels = _labels(chunk.iterfind("markers//marker"), file, "marker")
    points = SurveyRows(file)
    for marker in chunk.iterfind("markers//marker"):
        reference = marker.find("reference")
        if reference is None or reference.get("x") is None or reference.get("y") is None:
            continue
        name = labels[marker.get("id", "")]
        place = f"{file}, marker {quoted(name)}"
        xyz = [_number(reference, key, place) for key in "xyz"]
        sigma = [_sigma(reference, key, place) for key in ("sx", "sy", "sz")]
        check = reference.get("enabled", "true").lower() in _FALSE
        points.add(name, xyz, place, "rename one of the two markers", sigma, check, once=True)
    marks: list[Mark] = []
    for marker in chunk.iterfind("frames/frame/markers/marker"):
        number = marker.get("marker_id", "")
        for location in marker.iterfind("location"):
            if location.get("pinned", "true").lower() not in _TRUE:
                continue
            place = f"{file}, marker {quoted(labels.get(number, number))}, camera {quoted(location.get('camera_id'))}"
            image = cameras.get(location.get("camera_id", ""))
            if image is None or number not in labels:
                raise InputError(
                    f"{place}: the file has no such {'camera' if image is None else 'marker'}; export it anew"
                )
            column_row = [_number(location, key, place) for key in "xy"]
            marks.append((image, labels[number], column_row, np.nan, place))
    return points, marks


def _labels(elements, file: str, what: str) -> dict[str, str]:
    """The label of each by its id."""
    found: dict[str, str] = {}
    for element in elements:
        number, label = element.get("id"), element.get("label")
        if number is None or not label:
            raise InputError(f"{file}: a <{what}> has no id or no label; export the markers anew")
        found[number] = label.strip()
    return found


def _number(element: ElementTree.Element, key: str, place: str) -> float:
    text = element.get(key)
    if text is None and key == "z":
        return np.nan
    value = finite(text or "")
    if value is None:
        raise InputError(f"{place}: {key} is {quoted(text)}, not a number; export the markers anew")
    return value


def _sigma(reference: ElementTree.Element, key: str, place: str) -> float:
    """Of its own, or of all three; NaN where there is none. Metashape writes 0 for one that is not given."""
    own = key if reference.get(key) is not None else "sxyz"
    value = _number(reference, own, place) if reference.get(own) is not None else np.nan
    if value < 0:
        raise InputError(f"{place}: {own} is {value:g}; a standard deviation is positive, so correct it")
    return value if value > 0 else np.nan
