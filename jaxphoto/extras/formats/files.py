"""Format declarations; readers of text, XML, JSON and numeric rows with error locations."""

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.project import CameraModel, Project
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.camera_files import CameraReader
from jaxphoto.io.text_files import decoded, read_text
from jaxphoto.io.text_tables import LARGEST, Table
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints

Find = Callable[[Path], list[Path]]


class Format(NamedTuple):
    """Format of oriented projects that can be read, written or both."""

    name: str
    about: str
    find: Find | None = None
    """Return the main files of the format in a folder, or the file given; exactly one means that the format is
    recognised.
    """
    read: Callable[[Path], Project | BlockTables] | None = None
    fallback: bool = False
    """True if files of other formats may match, too: recognised only if no other format matches."""
    write: Callable[[Project, Path], None] | None = None
    plane: CameraModel | None = None
    """Camera model for perspective cameras. `plane` or `fisheye` is None if not supported."""
    fisheye: CameraModel | None = None
    endings: tuple[str, ...] = ()
    """Suffixes of the exported files."""
    keeps_rays: bool = False
    """True if image points are recomputed so that the fitted camera has the same rays."""
    lacks: tuple[str, ...] = ()
    """Content that the format does not support: cameras, points, image points."""


class CameraFormat(NamedTuple):
    """Format of camera files that can be read, written or both."""

    name: str
    reader: CameraReader | None = None
    write: Callable[[Path, str, Sensor, InteriorOrientation], None] | None = None
    plane: CameraModel | None = None
    """Camera model for perspective cameras; if `plane` and `fisheye` are None, the format supports all cameras."""
    fisheye: CameraModel | None = None
    suffixes: tuple[str, ...] = ()
    comment: str = ""
    """Template of a comment line; "" if the format has no comments."""


class ControlFormat(NamedTuple):
    """Format of control points or marks; `recognise` and `read` take path and text."""

    name: str
    about: str
    recognise: Callable[[Path, str], bool]
    read: Callable[[Path, str], GivenControl | SurveyedPoints | Marks]


def by_content(pattern: str, is_file: Callable[[Path], bool]) -> Find:
    """Return a function that finds the files in a folder that match `pattern` and `is_file`."""

    def find(source: Path) -> list[Path]:
        paths = sorted(source.glob(pattern)) if source.is_dir() else [source]
        return [path for path in paths if path.is_file() and is_file(path)]

    return find


def warn(message: str) -> None:
    """Issue a UserWarning."""
    warnings.warn(message, UserWarning, stacklevel=3)


def beginning(path: Path, n_bytes: int) -> list[str]:
    """Return the nonempty lines in the first `n_bytes` of a file."""
    with path.open("rb") as file:
        return [line for line in decoded(file.read(n_bytes)).splitlines() if line.strip()]


def numbered_lines(text: str) -> list[tuple[int, str]]:
    """Return (row number, line) for each line that is not empty."""
    return [(row, line) for row, line in enumerate(text.split("\n"), 1) if line.strip()]


def content_rows(path: Path) -> list[tuple[int, str]]:
    """Return (row number, line) for each line that is neither empty nor a comment."""
    return [(row, line) for row, line in numbered_lines(read_text(path)) if not line.lstrip().startswith("#")]


def read_columns(path: Path, columns: Sequence[str]) -> Table:
    """Read a comma-separated file without a header into named columns."""
    rows = [(row, [cell.strip() for cell in line.split(",")]) for row, line in content_rows(path)]
    for row, cells in rows:
        if len(cells) != len(columns):
            raise InputError(
                f"{path.name}, row {row}: {len(cells)} cells instead of {len(columns)} ({', '.join(columns)}). "
                "Complete the row or correct the format"
            )
    values = {name: np.array([cells[j] for _, cells in rows], object) for j, name in enumerate(columns)}
    return Table.of(path.name, values, np.array([row for row, _ in rows], int))


def add(parent: ElementTree.Element, tag: str, content: Any = None, **attributes: str) -> ElementTree.Element:
    """Add an element with text, or with numeric content in full precision."""
    element = ElementTree.SubElement(parent, tag, attributes)
    if content is not None:
        numbers = not isinstance(content, str)
        element.text = " ".join(map(repr, np.ravel(content).astype(float).tolist())) if numbers else content
    return element


def xml_text(root: ElementTree.Element) -> str:
    """Format an element as the text of an XML file."""
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, "unicode")}\n'


def number_rows(
    values: Sequence[Any], shape: tuple[int, ...], place: Callable[[int], str]
) -> Float[np.ndarray, "n *shape"]:
    """Convert equally shaped values to an array. Raise InputError at `place(k)` for the first deviating shape."""

    def parsed(some: Sequence[Any]) -> np.ndarray | None:
        try:
            rows = np.array(some, float).reshape(-1, *shape)
            return rows if np.shape(some) == (len(some), *shape) and (np.abs(rows) <= LARGEST).all() else None
        except (TypeError, ValueError, OverflowError):
            return None

    if not len(values):
        return np.zeros((0, *shape))
    if (rows := parsed(values)) is not None:
        return rows
    k = next(k for k, value in enumerate(values) if parsed([value]) is None)
    many = " x ".join(map(str, shape))
    raise InputError(f"{place(k)}: {quoted(values[k])} is not {many} finite numbers. Correct it or export it again")


def row_numbers(path: Path, row: int, words: Sequence[str], many: int) -> list[float]:
    """Parse `many` numeric cells of a text row. Raise InputError with the row number for anything else."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != many or not all(abs(value) <= LARGEST for value in values):
        raise InputError(f"{path.name}, row {row}: {quoted(' '.join(words))} is not {many} numbers; correct it")
    return values
