"""Declarations of formats, and reading of their files: text, trees and numbers with the place of an error."""

import json
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation, Perspective, Sensor
from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.camera_models import CameraModel
from jaxphoto.extras.formats.project import Project
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.camera_files import CameraReader
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.io.text_tables import LARGEST, Table
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints

Find = Callable[[Path], list[Path]]


class Format(NamedTuple):
    """A format of oriented projects, to be read, written or both."""

    name: str
    about: str
    find: Find | None = None
    """Its main files in a folder, or the file itself; the format is recognised if there is one."""
    read: Callable[[Path], Project | BlockTables] | None = None
    fallback: bool = False
    """True if other formats' files may look alike: recognised only if no other format is."""
    write: Callable[[Project, Path], None] | None = None
    plane: CameraModel | None = None
    """The model of its perspective cameras; None, as `fisheye`, if it has no such."""
    fisheye: CameraModel | None = None
    endings: tuple[str, ...] = ()
    """Endings of the files that it writes."""
    in_map: bool = False
    """True if written coordinates are those of the map, where collinearity holds approximately."""
    keeps_rays: bool = False
    """True if image points move to where the fitted camera sees the same rays."""
    lacks: tuple[str, ...] = ()
    """What it has no place for: cameras, points, image points."""


class CameraFormat(NamedTuple):
    """A format of camera files, to be read, written or both."""

    name: str
    reader: CameraReader | None = None
    write: Callable[[Path, str, Sensor, InteriorOrientation], None] | None = None
    plane: CameraModel | None = None
    """The model of its perspective cameras; if this and `fisheye` are None, it holds any camera."""
    fisheye: CameraModel | None = None
    suffixes: tuple[str, ...] = ()
    comment: str = ""
    """A comment line; "" if the format has none."""
    models: Mapping[str, CameraModel] = {}
    """Models that may be requested, by the format's own names."""

    def model_of(self, interior: InteriorOrientation) -> CameraModel | None:
        """Return the model in which a camera is written."""
        return self.plane if type(interior.projection) is Perspective else self.fisheye


class ControlFormat(NamedTuple):
    """A format of control points or marks; `recognise` and `read` take the path and the text ("" if binary)."""

    name: str
    about: str
    recognise: Callable[[Path, str], bool]
    read: Callable[[Path, str], GivenControl | SurveyedPoints | Marks]


def by_content(pattern: str, is_file: Callable[[Path], bool]) -> Find:
    """Return the function that finds files of a folder which match `pattern` and `is_file`."""

    def find(source: Path) -> list[Path]:
        paths = sorted(source.glob(pattern)) if source.is_dir() else [source]
        return [path for path in paths if path.is_file() and is_file(path)]

    return find


def warn(message: str) -> None:
    """Warn the user."""
    warnings.warn(message, UserWarning, stacklevel=3)


def begins_with(path: Path, words: str) -> bool:
    """Return True if a file begins with `words`."""
    with path.open("rb") as file:
        return file.read(len(words)) == words.encode()


def beginning(path: Path, n_bytes: int) -> list[str]:
    """Return the lines that are not empty among the first `n_bytes` of a file."""
    with path.open("rb") as file:
        return [line for line in file.read(n_bytes).decode("utf-8", "replace").splitlines() if line.strip()]


def content_rows(path: Path) -> list[tuple[int, str]]:
    """Return numbered lines that are neither empty nor comments."""
    rows = enumerate(read_legacy_text(path).split("\n"), 1)
    return [(row, line) for row, line in rows if line.strip() and not line.lstrip().startswith("#")]


def read_columns(path: Path, columns: Sequence[str], separator: str | None = ",") -> Table:
    """Return a file without a header in named columns; `separator` None means blanks."""
    rows = [(row, [cell.strip() for cell in line.split(separator)]) for row, line in content_rows(path)]
    for row, cells in rows:
        if len(cells) != len(columns):
            raise InputError(
                f"{path.name}, row {row}: {len(cells)} cells instead of {len(columns)} ({', '.join(columns)}). "
                "Complete the row or correct the format"
            )
    values = {name: np.array([cells[j] for _, cells in rows], object) for j, name in enumerate(columns)}
    return Table.of(path.name, values, np.array([row for row, _ in rows], int))


def read_json(path: Path) -> Any:
    """Return the content of a JSON file."""
    return json.loads(read_legacy_text(path))


def add(parent: ElementTree.Element, tag: str, content: Any = None, **attributes: str) -> ElementTree.Element:
    """Add an element with text, or with numbers in full precision."""
    element = ElementTree.SubElement(parent, tag, attributes)
    if content is not None:
        numbers = not isinstance(content, str)
        element.text = " ".join(map(repr, np.ravel(content).astype(float).tolist())) if numbers else content
    return element


def xml_text(root: ElementTree.Element) -> str:
    """Return the content of an XML file."""
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, "unicode")}\n'


def number_rows(
    values: Sequence[Any], shape: tuple[int, ...], place: Callable[[int], str]
) -> Float[np.ndarray, "n *shape"]:
    """Return values of one shape each as an array. Raise InputError at `place(k)` for the first of another shape."""
    try:
        rows = np.array(values, float).reshape(-1, *shape)
        if len(rows) == len(values) and np.shape(values)[1:] in (shape, ()) and (np.abs(rows) <= LARGEST).all():
            return rows
    except (TypeError, ValueError, OverflowError):
        pass
    for k, value in enumerate(values):
        try:
            row = np.array(value, float)
        except (TypeError, ValueError, OverflowError):
            row = np.array(np.nan)
        if row.shape != shape or not (np.abs(row) <= LARGEST).all():
            many = " x ".join(map(str, shape))
            raise InputError(f"{place(k)}: {quoted(value)} is not {many} finite numbers. Correct it or export it again")
    raise InputError(f"{place(0)}: numbers of one shape are expected. Export the file again")


def row_numbers(path: Path, row: int, words: Sequence[str], many: int) -> list[float]:
    """Return `many` numbers of a row of text. Raise InputError with the row for anything else."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != many or not all(abs(value) <= LARGEST for value in values):
        raise InputError(f"{path.name}, row {row}: {quoted(' '.join(words))} is not {many} numbers")
    return values
