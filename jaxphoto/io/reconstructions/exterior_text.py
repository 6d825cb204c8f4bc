"""Texts of exterior orientations: omega, phi, kappa of Inpho, Pix4D and `--to opk`, and PATB's matrices.

    imageName X Y Z Omega Phi Kappa         a row a photograph, separated by blanks, tabs, commas or semicolons

    photograph [c] X Y Z                    three rows a photograph
    a11 a12 a13 a21 a22
    a23 a31 a32 a33

omega, phi, kappa are those of docs/conventions.md, in degrees, or gon where the lines above the first row say gon or
grad. PATB's matrix takes the axes of the camera, x right, y up, z backwards, to those of the object. A comment or a
.prj beside names the system.
Sources: Pix4D support, articles 202977149 and 202558969 ("Yaw, Pitch, Roll and Omega, Phi, Kappa angles"); PCI
Geomatics support, article 204186705 ("Using Pat-B in OrthoEngine").
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import still
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, quoted
from jaxphoto.io.reconstructions.numbers import row_numbers
from jaxphoto.io.text_tables import is_number
from jaxphoto.io.whole_text import LARGE, SMALL, read_text

_SEPARATORS = ("\t", ";", ",")
_GON = re.compile(r"\b(gon|grads?|gradians?)\b", re.IGNORECASE)
_SYSTEM = re.compile(r"\b(EPSG:\s*\d{4,6}(?:\s*\+\s*\d{4,6})?)", re.IGNORECASE)
_COLUMNS = ("x", "y", "z", "omega", "phi", "kappa")
_FIRST, _MATRIX = 3, (5, 4)
# Lines of a file among which its first row stands, and their characters.
_BEGIN, _HEAD = 40, 20_000


_Row = tuple[int, list[str], str]
"""Its number, its cells, and the line itself."""
_Read = tuple[list[str], Float[np.ndarray, "images 3"], Float[np.ndarray, "images 3 3"]]
"""Names, positions, and rotations from the object to the camera."""


class ExteriorText(NamedTuple):
    """What a file says."""

    names: list[str]
    positions: Float[np.ndarray, "images 3"]
    camera_from_object: Float[np.ndarray, "images 3 3"]
    matrices: bool
    """Whether these were PATB's matrices."""
    system: str
    """The words that name the coordinate system; "" for none."""


def is_exterior(path: Path) -> bool:
    """Whether a file begins as one of these."""
    with path.open("rb") as file:
        lines = file.read(_HEAD).decode("utf-8", "replace").splitlines()[:_BEGIN]
    rows = [_cells(line) for line in lines if line.strip()]
    return _first_of_angles(rows) is not None or _first_of_matrices(rows) is not None


def read_exterior(path: Path) -> ExteriorText:
    """The orientations in a file. Raises InputError for rows that are none."""
    numbered = [(k, line) for k, line in enumerate(read_text(path, LARGE).split("\n"), 1) if line.strip()]
    begin = [_cells(line) for _, line in numbered[:_BEGIN]]
    first = _first_of_angles(begin)
    matrices = first is None
    if first is None:
        first = _first_of_matrices(begin)
    if first is None:
        raise InputError(f"{path.name} has no row of name, X, Y, Z, omega, phi, kappa; export the orientations anew")
    head = "\n".join(line for _, line in numbered[:first])
    said = _SYSTEM.search(head)
    rows = [(k, _cells(line), line) for k, line in numbered[first:] if not line.lstrip().startswith("#")]
    if matrices:
        names, positions, rotations = _of_matrices(path, rows)
    else:
        order = _order(numbered[first - 1][1]) if first else list(range(len(_COLUMNS)))
        names, positions, rotations = _of_angles(path, rows, order, 0.9 if _GON.search(head) else 1.0)
    return ExteriorText(names, positions, rotations, matrices, said[1] if said else _beside(path))


def _beside(path: Path) -> str:
    """The words of a .prj file of the same name, or of the only one in the folder."""
    own = path.with_suffix(".prj")
    found = [own] if own.is_file() else sorted(path.parent.glob("*.prj"))
    return read_text(found[0], SMALL).strip() if len(found) == 1 else ""


def _cells(line: str) -> list[str]:
    """The cells between the first separator that makes enough of a row, else between blanks."""
    for separator in _SEPARATORS:
        if line.count(separator) >= _FIRST:
            return [cell.strip() for cell in line.strip().split(separator)]
    return line.split()


def _is_angles(row: list[str]) -> bool:
    """Whether it is a name and numbers; a name of several words is no number."""
    surplus = len(row) - len(_COLUMNS)
    return surplus > 0 and all(map(is_number, row[surplus:])) and (surplus == 1 or not is_number(row[0]))


def _first_of_angles(rows: list[list[str]]) -> int | None:
    found = [k for k, row in enumerate(rows) if _is_angles(row) and not row[0].startswith("#")]
    # Most rows below the first one are of the same kind: those of other files are so by chance.
    return found[0] if found and 2 * sum(map(_is_angles, rows[found[0] :])) > len(rows) - found[0] else None


def _first_of_matrices(rows: list[list[str]]) -> int | None:
    widths = [len(row) if all(map(is_number, row)) else 0 for row in rows]
    for k in range(len(rows) - 2):
        above = len(rows[k]) > _FIRST and all(map(is_number, rows[k][-_FIRST:]))
        if above and tuple(widths[k + 1 : k + 3]) == _MATRIX and not rows[k][0].startswith("#"):
            return k
    return None


def _order(head: str) -> list[int]:
    """Where each of `_COLUMNS` stands among the last ones, by the words above them; in this order without such."""
    words = [word[0].lower() if (word := re.findall(r"[A-Za-z]+", cell)) else "" for cell in _cells(head)]
    last = words[-len(_COLUMNS) :]
    return [last.index(name) for name in _COLUMNS] if set(last) == set(_COLUMNS) else list(range(len(_COLUMNS)))


def _of_angles(path: Path, rows: list[_Row], order: list[int], degrees: float) -> _Read:
    names, values = [], []
    for k, cells, line in rows:
        if len(cells) <= len(_COLUMNS):
            raise InputError(
                f"{path.name}, row {k}: {quoted(line)} is not name, X, Y, Z, omega, phi, kappa; complete the row"
            )
        values.append(row_numbers(path, k, cells[-len(_COLUMNS) :], len(_COLUMNS)))
        names.append(" ".join(cells[: -len(_COLUMNS)]))
    numbers = np.array(values).reshape(-1, len(_COLUMNS))[:, order]
    exterior = ExteriorOrientation.from_angles(numbers[:, :3], np.deg2rad(numbers[:, 3:] * degrees))  # type: ignore[arg-type]
    return names, numbers[:, :3], still(exterior.camera_from_object)


def _of_matrices(path: Path, rows: list[_Row]) -> _Read:
    names, values = [], []
    rows = [row for row in rows if row[1] != ["-99"]]
    for at in range(0, len(rows), 3):
        (k, cells, line), below = rows[at], rows[at + 1 : at + 3]
        if len(cells) <= _FIRST or len(below) < 2:
            raise InputError(
                f"{path.name}, row {k}: {quoted(line)} is not the first of three rows of a photograph; export it anew"
            )
        matrix = [x for (n, own, _), many in zip(below, _MATRIX, strict=True) for x in row_numbers(path, n, own, many)]
        values.append(row_numbers(path, k, cells[-_FIRST:], _FIRST) + matrix)
        # The principal distance may stand before the position.
        name = cells[:-_FIRST]
        names.append(" ".join(name[:-1] if len(name) > 1 and is_number(name[-1]) else name))
    numbers = np.array(values).reshape(-1, 12)
    return names, numbers[:, :3], np.swapaxes(numbers[:, 3:].reshape(-1, 3, 3), 1, 2)
