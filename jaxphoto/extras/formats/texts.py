"""A folder of texts: exterior orientations, image points (`points_beside`) and a camera file.

    imageName X Y Z Omega Phi Kappa         a row a photograph, separated by blanks, tabs, commas or semicolons

    photograph [c] X Y Z                    PATB: three rows a photograph
    a11 a12 a13 a21 a22
    a23 a31 a32 a33

    ORIA photograph X Y Z phi omega kappa   BINGO's itera.dat: among rows that begin with other words

omega, phi, kappa are those of docs/conventions.md, in degrees, or gon if the lines above the first row say gon, grads
or gradians. Other columns and orders are read if the last line above the first row names them. PATB's matrix takes the
axes of the camera, x right, y up, z backwards, to those of the object. BINGO's angles are camera_from_object =
R3(kappa) R1(omega) R2(phi), in gon. A comment or a .prj beside names the system. With several cameras, images.csv says
which photograph has which (image, camera). Sources: Pix4D support, articles 202977149 and 202558969 ("Yaw, Pitch, Roll
and Omega, Phi, Kappa angles"); PCI Geomatics support, article 204186705 ("Using Pat-B in OrthoEngine"); for BINGO,
whose manual is not public, S. Turek's bundle block adjustment for GRASS, 2014.
"""

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pandas as pd
import scipy
from jaxtyping import Float, Int

from jaxphoto.arrays import to_numpy
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.extras.formats.camera_models import ProjectCamera
from jaxphoto.extras.formats.control import is_geoin
from jaxphoto.extras.formats.files import Format, beginning, row_numbers
from jaxphoto.extras.formats.points_beside import (
    Shown,
    measured_texts,
    places_by_name,
    points_beside,
    write_image_points,
)
from jaxphoto.extras.formats.project import Project, with_system
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.camera_files import CAMERA, SeveralCamerasError, read_camera_file
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.io.text_tables import is_number, read_csv
from jaxphoto.io.toml import toml_text
from jaxphoto.unknowns import FIXED

EXTERIOR, IMAGES = "exterior.txt", "images.csv"
_TEXTS = (".txt", ".csv", ".dat", ".ori", ".eo", ".opk", ".pat", ".out", "")
_CAMERAS = (".toml", ".xml", ".yml", ".yaml", ".json", ".cameramodel")
# Another reading of the rotations is taken if rays then miss by so many times less.
_WORSE = 3.0
_GON = re.compile(r"\b(gons?|grads|gradians?)\b", re.IGNORECASE)
# Gon in English, degrees in German.
_GRAD = re.compile(r"\bgrad\b", re.IGNORECASE)
_UNIT = re.compile(r"[\[(][^\])]*[\])]")
_SYSTEM = re.compile(r"\b(EPSG:\s*\d{4,6}(?:\s*\+\s*\d{4,6})?)", re.IGNORECASE)
_MEANINGS = {
    word: meaning
    for meaning, words in {
        "x": ("x", "easting", "east", "e", "longitude", "lon"),
        "y": ("y", "northing", "north", "n", "latitude", "lat"),
        "z": ("z", "altitude", "height", "elevation", "h"),
        "omega": ("omega",), "phi": ("phi",), "kappa": ("kappa",),
    }.items()
    for word in words
}  # fmt: skip
_COLUMNS = ("x", "y", "z", "omega", "phi", "kappa")
# Numbers of the rows below the first of a photograph in PATB.
_MATRIX = (5, 4)
_ORIA, _ORIA_ROW = "ORIA", re.compile(rb"(?:\A|\n)[ \t]{0,20}ORIA[ \t]")
_GON_DEG = 0.9
# Lines of a file among which its first row stands, and their bytes.
_BEGIN, _HEAD = 40, 20_000

_Row = tuple[int, list[str], str]
"""Number, cells, and the line."""


class ExteriorText(NamedTuple):
    """The orientations in a text."""

    names: list[str]
    positions: Float[np.ndarray, "images 3"]
    camera_from_object: Float[np.ndarray, "images 3 3"]
    others: tuple[Float[np.ndarray, "images 3 3"], ...] = ()
    """Other readings of the same numbers: transposes of matrices, BINGO's angles in another order or unit."""
    system: str = ""
    """Words that name the coordinate system."""


def find(source: Path) -> list[Path]:
    """Return the texts of orientations; in a folder, which then has image points beside them."""
    if source.is_file():
        return [source] if source.suffix.lower() in _TEXTS and is_exterior(source) else []
    paths = sorted(source.iterdir()) if source.is_dir() else []
    texts = [p for p in paths if p.is_file() and p.suffix.lower() in _TEXTS and p.name != IMAGES and is_exterior(p)]
    return texts if texts and measured_texts(texts[0]) else []


def read(path: Path) -> Project:
    """Read orientations with image points and cameras beside them; cameras are free in terms that are not zero."""
    exterior = read_exterior(path)
    cameras, camera_of = _cameras(path, exterior.names)
    of_image = [cameras[name] for name in camera_of]
    shown = points_beside(path, exterior.names, of_image)
    rotations = _best_rotations(exterior, of_image, shown)
    pose = ExteriorOrientation(exterior.positions, rotations)  # type: ignore[arg-type]
    return oriented_project(path, cameras, exterior.names, camera_of, pose, shown, exterior.system)


def oriented_project(
    path: Path,
    cameras: dict[str, ProjectCamera],
    files: Sequence[str],
    image_camera: Sequence[str],
    exterior: ExteriorOrientation,
    shown: Shown,
    system: str = "",
) -> Project:
    """Return the project of orientations in the system named by words, and of the image points beside them."""
    if not len(shown.image):
        raise InputError(f"{path.name} has no image points; write BINGO, PATB or image_points.csv beside it")
    project = Project(
        path.resolve().parent.name, cameras, (), files, image_camera, exterior, shown.points, None, shown.image,
        shown.point, shown.column_row, sigma_px=shown.sigma_px, file=path.name,
    )  # fmt: skip
    return with_system(project, system)


def _cameras(path: Path, names: list[str]) -> tuple[dict[str, ProjectCamera], list[str]]:
    """The cameras of the folder, and the camera of each photograph."""
    near = (p for p in sorted(path.parent.iterdir()) if p.is_file() and not p.name.startswith("."))
    files = [p for p in near if p.suffix.lower() in _CAMERAS]
    if len(files) != 1:
        raise InputError(f"{path.parent} holds {len(files)} camera files and needs one (docs/formats.md)")
    file, beside = files[0], path.with_name(IMAGES)
    if not beside.is_file():
        try:
            camera = read_camera_file(file)
        except SeveralCamerasError:
            raise InputError(f"{file.name} holds several cameras; write {IMAGES} beside it") from None
        return {camera.name: ProjectCamera.estimated(camera.sensor, camera.interior)}, [camera.name] * len(names)
    table, places, camera_of = read_csv(beside, ("image", "camera")), places_by_name(names), dict[int, str]()
    for row, (image, name) in enumerate(zip(table.ids("image"), table.ids("camera"), strict=True)):
        if camera_of.setdefault(place := places.get(image, -1), name) != name and place >= 0:
            raise table.bad(row, f"photograph {quoted(image)} has another camera in a row above; keep one of the two")
    if missing := [name for k, name in enumerate(names) if k not in camera_of]:
        raise InputError(f"{IMAGES} says no camera of {len(missing)} photographs ({few(missing)}); add a row for each")
    chosen = [camera_of[k] for k in range(len(names))]
    read_files = {name: read_camera_file(file, camera=name) for name in dict.fromkeys(chosen)}
    return {name: ProjectCamera.estimated(c.sensor, c.interior) for name, c in read_files.items()}, chosen


def _best_rotations(exterior: ExteriorText, cameras: list[ProjectCamera], shown: Shown) -> np.ndarray:
    """Rotations from the object to the camera, in the reading by which rays meet best."""
    if not exterior.others:
        return exterior.camera_from_object
    rays = np.zeros((len(shown.image), 3))
    for k, (sensor, interior, _) in enumerate(cameras):
        rows = shown.image == k
        rays[rows, :2] = sensor.mm_from_px(shown.column_row[rows]) - [float(interior.x_p), float(interior.y_p)]
        rays[rows, 2] = -float(interior.c)
    readings = (exterior.camera_from_object, *exterior.others)
    misfit = [ray_misfit(exterior.positions, r, rays, shown.image, shown.point) for r in readings]
    best = int(np.argmin(misfit))
    return readings[best] if misfit[best] * _WORSE < misfit[0] else readings[0]


def ray_misfit(
    centres: Float[np.ndarray, "images 3"],
    camera_from_object: Float[np.ndarray, "images 3 3"],
    rays: Float[np.ndarray, "n 3"],
    image: Int[np.ndarray, "n"],
    point: Int[np.ndarray, "n"],
) -> float:
    """Return the median angle (rad) between rays, in camera axes, and the point nearest to all rays of their point.

    NaN if no point has two rays.
    """
    several = np.bincount(point, minlength=1)[point] >= 2
    image, point, rays = image[several], point[several], rays[several]
    if not len(image):
        return np.nan
    along = np.einsum("nji,nj->ni", camera_from_object[image], rays)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    start = centres[image] - centres.mean(axis=0)
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    normal, right = np.zeros((point.max() + 1, 3, 3)), np.zeros((point.max() + 1, 3))
    np.add.at(normal, point, across)
    np.add.at(right, point, np.einsum("nij,nj->ni", across, start))
    # Regularised by more than rounding, for parallel rays.
    normal += 1e-12 * np.maximum(np.einsum("pii->p", normal), 1.0)[:, None, None] * np.eye(3)
    to = np.linalg.solve(normal, right[:, :, None])[point, :, 0] - start
    off = np.linalg.norm(np.einsum("nij,nj->ni", across, to), axis=1)
    return float(np.median(np.arctan2(off, np.einsum("ni,ni->n", along, to))))


# Exterior orientations ----------------------------------------------------------------------------------------


def is_exterior(path: Path) -> bool:
    """Return True if a file begins as a text of orientations, or has a row of BINGO's."""
    if _ORIA_ROW.search(path.read_bytes()):
        return True
    lines = beginning(path, _HEAD)
    begin = lines[:_BEGIN]
    return (_first_of_angles(begin) is not None or _first_of_matrices(begin) is not None) and not is_geoin(lines)


def read_exterior(path: Path) -> ExteriorText:
    """Read the orientations in a text. Raise InputError with the row that is invalid."""
    numbered = [(k, line) for k, line in enumerate(read_legacy_text(path).split("\n"), 1) if line.strip()]
    begin = [line for _, line in numbered[:_BEGIN]]
    if any(_oria(line.split()) is not None for _, line in numbered):
        return _of_bingo(path, numbered)._replace(system=_system(path, "\n".join(begin)))
    first = _first_of_angles(begin)
    matrices = first is None
    first = _first_of_matrices(begin) if first is None else first
    if first is None:
        raise InputError(f"{path.name} has no row of name, X, Y, Z, omega, phi, kappa. Export the orientations again")
    head = "\n".join(line for _, line in numbered[:first])
    rows = [(k, _cells(line), line) for k, line in numbered[first:] if not line.lstrip().startswith("#")]
    if matrices:
        return _of_matrices(path, rows)._replace(system=_system(path, head))
    if _GRAD.search(head) and not _GON.search(head):
        raise InputError(f"{path.name} has angles in grad, degrees to some and gon to others; write one")
    row, above = numbered[first - 1] if first else (0, "")
    places = _places(above)
    if places is None and set(_COLUMNS[3:]) & set(_meanings(above)):
        raise InputError(
            f"{path.name}, row {row}: {quoted(above)} does not name X, Y, Z, Omega, Phi and Kappa once each; call the "
            "columns so"
        )
    places = places or dict(zip(_COLUMNS, range(-len(_COLUMNS), 0), strict=True))
    exterior = _of_angles(path, rows, places, _GON_DEG if _GON.search(head) else 1.0)
    return exterior._replace(system=_system(path, head))


def _system(path: Path, head: str) -> str:
    """An EPSG code in the head, else the content of a .prj of the same name or of the only one in the folder."""
    if named := _SYSTEM.search(head):
        return named[1]
    same = path.with_suffix(".prj")
    files = [same] if same.is_file() else sorted(path.parent.glob("*.prj"))
    return read_legacy_text(files[0]).strip() if len(files) == 1 else ""


def _cells(line: str) -> list[str]:
    """The cells between the first separator that is frequent enough, else between blanks."""
    for separator in ("\t", ";", ","):
        if line.count(separator) >= 3:
            return [cell.strip() for cell in line.strip().split(separator)]
    return line.split()


def _is_angles(row: list[str]) -> bool:
    """Return True for a name and six numbers; a name of several words has no three numbers in it."""
    surplus = len(row) - len(_COLUMNS)
    if surplus < 1 or not all(map(is_number, row[surplus:])):
        return False
    return surplus == 1 or (not is_number(row[0]) and sum(map(is_number, row[1:surplus])) < 3)


def _first_of_angles(lines: list[str]) -> int | None:
    rows = [_cells(line) for line in lines]
    for k, line in enumerate(lines[:-1]):
        places, below = _places(line), rows[k + 1]
        if places and len(below) > -min(places.values()) and all(is_number(below[at]) for at in places.values()):
            return k + 1
    first = next((k for k, row in enumerate(rows) if _is_angles(row) and not row[0].startswith("#")), None)
    # Most rows below the first one are of the same kind; in other files one may be so by chance.
    return first if first is not None and 2 * sum(map(_is_angles, rows[first:])) > len(rows) - first else None


def _first_of_matrices(lines: list[str]) -> int | None:
    rows = [_cells(line) for line in lines]
    widths = [len(row) if all(map(is_number, row)) else 0 for row in rows]
    begins = [len(row) > 3 and all(map(is_number, row[-3:])) and not row[0].startswith("#") for row in rows]
    for k in range(len(rows) - 2):
        # The next photograph, if there is one, follows at once.
        next_begins = k + 3 >= len(rows) or begins[k + 3] or rows[k + 3] == ["-99"]
        if begins[k] and tuple(widths[k + 1 : k + 3]) == _MATRIX and next_begins:
            return k
    return None


def _meanings(head: str) -> list[str]:
    """Meanings of the words of a header, "" for other words; units are no words."""
    words = [re.findall(r"[A-Za-z]+", cell) for cell in _cells(_UNIT.sub("", head))]
    return [_MEANINGS.get(word[0].lower(), "") if word else "" for word in words]


def _places(head: str) -> dict[str, int] | None:
    """Places of the columns, counted from the end of a row; None if the header does not name each once."""
    meanings = _meanings(head)
    if any(meanings.count(name) != 1 for name in _COLUMNS):
        return None
    return {name: meanings.index(name) - len(meanings) for name in _COLUMNS}


def _of_angles(path: Path, rows: list[_Row], places: dict[str, int], degrees: float) -> ExteriorText:
    names, values, most = [], [], -min(places.values())
    for k, cells, line in rows:
        if len(cells) <= most:
            raise InputError(f"{path.name}, row {k}: {quoted(line)} is not name, X, Y, Z, omega, phi, kappa")
        values.append(row_numbers(path, k, [cells[places[name]] for name in _COLUMNS], len(_COLUMNS)))
        names.append(" ".join(cells[:-most]))
    numbers = np.array(values).reshape(-1, len(_COLUMNS))
    exterior = ExteriorOrientation.from_angles(numbers[:, :3], np.deg2rad(numbers[:, 3:] * degrees))  # type: ignore[arg-type]
    return ExteriorText(names, numbers[:, :3], to_numpy(exterior.camera_from_object))


def _of_matrices(path: Path, rows: list[_Row]) -> ExteriorText:
    names, values = [], []
    rows = [row for row in rows if row[1] != ["-99"]]
    for at in range(0, len(rows), 3):
        (k, cells, line), below = rows[at], rows[at + 1 : at + 3]
        if len(cells) <= 3 or len(below) < 2:
            raise InputError(f"{path.name}, row {k}: {quoted(line)} is not the first of three rows of a photograph.")
        matrix = [
            x for (n, words, _), many in zip(below, _MATRIX, strict=True) for x in row_numbers(path, n, words, many)
        ]
        values.append(row_numbers(path, k, cells[-3:], 3) + matrix)
        # The principal distance may precede the position.
        name = cells[:-3]
        names.append(" ".join(name[:-1] if len(name) > 1 and is_number(name[-1]) else name))
    numbers = np.array(values).reshape(-1, 12)
    matrices = numbers[:, 3:].reshape(-1, 3, 3)
    return ExteriorText(names, numbers[:, :3], np.swapaxes(matrices, 1, 2), (matrices,))


def _oria(words: list[str]) -> int | None:
    """Where the six numbers of a row of BINGO's orientations begin; None for another row."""
    if not words or words[0] != _ORIA:
        return None
    return next((k for k in range(2, len(words) - 5) if all(map(is_number, words[k : k + 6]))), None)


def _of_bingo(path: Path, numbered: list[tuple[int, str]]) -> ExteriorText:
    names, values = [], []
    for k, line in numbered:
        words = line.split()
        begin = _oria(words)
        if words[0] == _ORIA and begin is None:
            raise InputError(f"{path.name}, row {k}: {quoted(line)} is not ORIA, name, X, Y, Z, phi, omega, kappa")
        if begin is not None:
            names.append(" ".join(words[1:begin]))
            values.append(row_numbers(path, k, words[begin : begin + 6], 6))
    numbers = np.array(values).reshape(-1, 6)
    readings = [
        scipy.spatial.transform.Rotation.from_euler(axes, numbers[:, 3:] * degrees, degrees=True).inv().as_matrix()
        for axes in ("YXZ", "XYZ")
        for degrees in (_GON_DEG, 1.0)
    ]
    return ExteriorText(names, numbers[:, :3], readings[0], tuple(readings[1:]))


def angles_deg(exterior: ExteriorOrientation) -> Float[np.ndarray, "images 3"]:
    """Return omega, phi, kappa in degrees."""
    return np.rad2deg(to_numpy(exterior.omega_phi_kappa))


def write(p: Project, folder: Path) -> None:
    """Write exterior.txt, camera.toml, image_points.csv, and images.csv if there are several cameras."""
    m = p.in_map()
    place = "longitude and latitude (degrees) and height (m)" if m.geographic else "X Y Z (m)"
    heights = "above the ellipsoid" if p.frame.vertical is None else f"of EPSG:{p.frame.vertical}"
    system = f"of {m.system}, heights {heights}" if m.system else "of the block's local frame"
    lines = [
        f"# {place} {system}",
        "# omega phi kappa in degrees: camera = Rz(kappa) Ry(phi) Rx(omega) object, camera x right, y up, z backwards",
        "imageName\tX\tY\tZ\tOmega\tPhi\tKappa",
    ]
    values = np.hstack([np.asarray(m.exterior.position), angles_deg(m.exterior)])
    lines += ["\t".join([file, *map(repr, row)]) for file, row in zip(p.files, values.tolist(), strict=True)]
    (folder / EXTERIOR).write_text("\n".join(lines) + "\n", encoding="utf-8")
    fixed = {name: jax.tree.map(lambda _: FIXED, c.interior) for name, c in p.cameras.items()}
    sections = {name: camera_section(Camera(c.sensor, c.interior, fixed[name])) for name, c in p.cameras.items()}
    (folder / CAMERA).write_text(toml_text({"cameras": sections}), encoding="utf-8")
    if len(p.cameras) > 1:
        table = pd.DataFrame({"image": p.files, "camera": p.image_camera})
        table.to_csv(folder / IMAGES, index=False, quoting=csv.QUOTE_NONNUMERIC)
    write_image_points(p, folder)


FORMATS = (
    Format(
        "texts",
        "folder of texts: omega, phi, kappa or PATB's matrices, image points of BINGO or PATB, and a camera file",
        find, read, fallback=True,
    ),
    Format(
        "opk", "text of positions and omega, phi, kappa", write=write, in_map=True, endings=(".txt", ".toml", ".csv"),
        lacks=("points",),
    ),
)  # fmt: skip
