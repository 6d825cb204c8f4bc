"""Texts of exterior orientations: omega, phi, kappa of Inpho, Pix4D and `--to opk`, PATB's matrices, BINGO's itera.dat.

    imageName X Y Z Omega Phi Kappa         a row a photograph, separated by blanks, tabs, commas or semicolons

    photograph [c] X Y Z                    three rows a photograph
    a11 a12 a13 a21 a22
    a23 a31 a32 a33

    ORIA photograph X Y Z phi omega kappa   among rows that begin with other words

omega, phi, kappa are those of docs/conventions.md, in degrees, or gon where the lines above the first row say gon,
grads or gradians. Other columns and another order are read where the last line above the first row names them. PATB's
matrix takes the axes of the camera, x right, y up, z backwards, to those of the object. BINGO's angles are
camera_from_object = R3(kappa) R1(omega) R2(phi), in gon. A comment or a .prj beside names the system.
Sources: Pix4D support, articles 202977149 and 202558969 ("Yaw, Pitch, Roll and Omega, Phi, Kappa angles"); PCI
Geomatics support, article 204186705 ("Using Pat-B in OrthoEngine"); of BINGO a program that reads its files (S. Turek's
bundle block adjustment for GRASS, 2014), as its manual is not public.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.arrays import still
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, quoted
from jaxphoto.io.control_files.bingo import recognises as is_geoin
from jaxphoto.io.reconstructions.numbers import beginning, row_numbers
from jaxphoto.io.text_tables import is_number
from jaxphoto.io.whole_text import LARGE, SMALL, read_text

_SEPARATORS = ("\t", ";", ",")
_GON = re.compile(r"\b(gons?|grads|gradians?)\b", re.IGNORECASE)
# Gon in English, degrees in German.
_GRAD = re.compile(r"\bgrad\b", re.IGNORECASE)
_UNIT = re.compile(r"[\[(][^\])]*[\])]")
_SYSTEM = re.compile(r"\b(EPSG:\s*\d{4,6}(?:\s*\+\s*\d{4,6})?)", re.IGNORECASE)
# Words of a header, by what they mean.
_WORDS = {
    "x": ("x", "easting", "east", "e", "longitude", "lon"),
    "y": ("y", "northing", "north", "n", "latitude", "lat"),
    "z": ("z", "altitude", "height", "elevation", "h"),
    "omega": ("omega",),
    "phi": ("phi",),
    "kappa": ("kappa",),
}
_COLUMNS = tuple(_WORDS)
_ANGLES = _COLUMNS[3:]
_FIRST, _MATRIX = 3, (5, 4)
_ORIA = "ORIA"
_ORIA_ROW = re.compile(rb"\n[ \t]{0,20}ORIA[ \t]")
# Bytes that are searched at a time, and of one piece those that may begin a row of the next.
_PIECE, _PIECE_END = 1 << 20, 32
_GON_DEG = 0.9
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
    others: tuple[Float[np.ndarray, "images 3 3"], ...]
    """What the same numbers may mean besides: transposes of matrices, BINGO's angles in another order or unit."""
    system: str
    """The words that name the coordinate system; "" for none."""


def is_exterior(path: Path) -> bool:
    """Whether a file begins as one of these."""
    if _has_oria(path):
        return True
    lines = beginning(path, _HEAD)
    begin = lines[:_BEGIN]
    angles = _first_of_angles(begin) is not None or _first_of_matrices(begin) is not None
    return angles and not is_geoin(lines)


def _has_oria(path: Path) -> bool:
    """Whether a row of a file begins with ORIA, wherever: points may stand before."""
    before = b"\n"
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            if _ORIA_ROW.search(before + piece):
                return True
            before = piece[-_PIECE_END:]
    return False


def read_exterior(path: Path) -> ExteriorText:
    """The orientations in a file. Raises InputError for rows that are none."""
    numbered = [(k, line) for k, line in enumerate(read_text(path, LARGE).split("\n"), 1) if line.strip()]
    begin = [line for _, line in numbered[:_BEGIN]]
    if _is_of_bingo([line for _, line in numbered]):
        said = _SYSTEM.search("\n".join(begin))
        return _of_bingo(path, numbered, said[1] if said else _beside(path))
    first = _first_of_angles(begin)
    matrices = first is None
    if first is None:
        first = _first_of_matrices(begin)
    if first is None:
        raise InputError(f"{path.name} has no row of name, X, Y, Z, omega, phi, kappa; export the orientations anew")
    head = "\n".join(line for _, line in numbered[:first])
    said, above = _SYSTEM.search(head), numbered[first - 1] if first else (0, "")
    rows = [(k, _cells(line), line) for k, line in numbered[first:] if not line.lstrip().startswith("#")]
    if matrices:
        names, positions, rotations = _of_matrices(path, rows)
    else:
        if _GRAD.search(head) and not _GON.search(head):
            raise InputError(
                f"{path.name} has angles in grad, which are degrees to some and gon to others; write degrees or gon"
            )
        places = _places(above[1])
        if places is None and set(_ANGLES) & set(_meanings(above[1])):
            raise InputError(
                f"{path.name}, row {above[0]}: {quoted(above[1])} does not name X, Y, Z, Omega, Phi and Kappa once "
                "each; call the columns so"
            )
        places = places or dict(zip(_COLUMNS, range(-len(_COLUMNS), 0), strict=True))
        names, positions, rotations = _of_angles(path, rows, places, _GON_DEG if _GON.search(head) else 1.0)
    others = (np.swapaxes(rotations, 1, 2),) if matrices else ()
    return ExteriorText(names, positions, rotations, others, said[1] if said else _beside(path))


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
    """Whether it is a name and numbers; a name of several words is no number, and has no three numbers in it."""
    surplus = len(row) - len(_COLUMNS)
    if surplus < 1 or not all(map(is_number, row[surplus:])):
        return False
    return surplus == 1 or (not is_number(row[0]) and sum(map(is_number, row[1:surplus])) < _FIRST)


def _first_of_angles(lines: list[str]) -> int | None:
    rows = [_cells(line) for line in lines]
    for k, line in enumerate(lines[:-1]):
        places = _places(line)
        below = rows[k + 1]
        if places and len(below) > -min(places.values()) and all(is_number(below[at]) for at in places.values()):
            return k + 1
    found = [k for k, row in enumerate(rows) if _is_angles(row) and not row[0].startswith("#")]
    # Most rows below the first one are of the same kind: those of other files are so by chance.
    return found[0] if found and 2 * sum(map(_is_angles, rows[found[0] :])) > len(rows) - found[0] else None


def _first_of_matrices(lines: list[str]) -> int | None:
    rows = [_cells(line) for line in lines]
    widths = [len(row) if all(map(is_number, row)) else 0 for row in rows]
    for k in range(len(rows) - 2):
        above = len(rows[k]) > _FIRST and all(map(is_number, rows[k][-_FIRST:]))
        if above and tuple(widths[k + 1 : k + 3]) == _MATRIX and not rows[k][0].startswith("#"):
            return k
    return None


def _meanings(head: str) -> list[str]:
    """What the words of a header mean, "" for other words; its units are no words."""
    known = {word: meaning for meaning, words in _WORDS.items() for word in words}
    cells = _cells(_UNIT.sub("", head))
    words = [word[0].lower() if (word := re.findall(r"[A-Za-z]+", cell)) else "" for cell in cells]
    return [known.get(word, "") for word in words]


def _places(head: str) -> dict[str, int] | None:
    """Where each of `_COLUMNS` stands, counted from the end of a row, by the words above it; None where not all do, or
    one does twice.
    """
    found = _meanings(head)
    if any(found.count(name) != 1 for name in _COLUMNS):
        return None
    return {name: found.index(name) - len(found) for name in _COLUMNS}


def _of_angles(path: Path, rows: list[_Row], places: dict[str, int], degrees: float) -> _Read:
    names, values, most = [], [], -min(places.values())
    for k, cells, line in rows:
        if len(cells) <= most:
            raise InputError(
                f"{path.name}, row {k}: {quoted(line)} is not name, X, Y, Z, omega, phi, kappa; complete the row"
            )
        values.append(row_numbers(path, k, [cells[places[name]] for name in _COLUMNS], len(_COLUMNS)))
        names.append(" ".join(cells[:-most]))
    numbers = np.array(values).reshape(-1, len(_COLUMNS))
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


def _oria(words: list[str]) -> int | None:
    """Where the six numbers of a row of BINGO's orientations begin, after ORIA and a name; None for another row."""
    if words[0] != _ORIA:
        return None
    return next((k for k in range(2, len(words) - 5) if all(map(is_number, words[k : k + 6]))), None)


def _is_of_bingo(lines: list[str]) -> bool:
    return any(_oria(line.split()) is not None for line in lines)


def _of_bingo(path: Path, numbered: list[tuple[int, str]], system: str) -> ExteriorText:
    names, values = [], []
    for k, line in numbered:
        words = line.split()
        begin = _oria(words)
        if words[0] == _ORIA and begin is None:
            raise InputError(
                f"{path.name}, row {k}: {quoted(line)} is not ORIA, name, X, Y, Z, phi, omega, kappa; complete the row"
            )
        if begin is not None:
            names.append(" ".join(words[1:begin]))
            values.append(row_numbers(path, k, words[begin : begin + 6], 6))
    numbers = np.array(values).reshape(-1, 6)
    # Axes turned one after the other; Rotation goes from the camera to the object.
    read = [
        scipy.spatial.transform.Rotation.from_euler(axes, numbers[:, 3:] * degrees, degrees=True).inv().as_matrix()
        for axes in ("YXZ", "XYZ")
        for degrees in (_GON_DEG, 1.0)
    ]
    return ExteriorText(names, numbers[:, :3], read[0], tuple(read[1:]), system)
