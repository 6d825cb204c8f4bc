"""Folder of text files: exterior orientations, image points (`points_beside`) and a camera file.

    image X Y Z Omega Phi Kappa             header, then one row per photograph; separated by blanks, tabs, commas or
                                            semicolons, in any order

    photograph [c] X Y Z                    PATB: three rows per photograph
    a11 a12 a13 a21 a22
    a23 a31 a32 a33

    ORIA photograph X Y Z phi omega kappa   BINGO's itera.dat; other rows are ignored

omega, phi, kappa are defined in docs/conventions.md, in degrees, or gon if a line above the rows contains gon, grads or
gradians. PATB's matrix rotates from camera axes x right, y up, z backward to object axes. BINGO's angles are
camera_from_object = R3(kappa) R1(omega) R2(phi), in gon. A comment EPSG:... names the coordinate system. If there are
several cameras, images.csv (image, camera) assigns a camera to each photograph. Sources: Pix4D support, articles
202977149 and 202558969 ("Yaw, Pitch, Roll and Omega, Phi, Kappa angles"); PCI Geomatics support, article 204186705
("Using Pat-B in OrthoEngine"); for BINGO, whose manual is not public, S. Turek's bundle adjustment for GRASS, 2014.
"""

import csv
import re
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pandas as pd
import scipy
from jaxtyping import Float

from jaxphoto.arrays import to_numpy
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.extras.formats.camera_models import ProjectCamera
from jaxphoto.extras.formats.files import Format, numbered_lines, row_numbers
from jaxphoto.extras.formats.points_beside import measured_texts, places_by_name, points_beside, write_image_points
from jaxphoto.extras.formats.project import Project, with_system
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.camera_files import CAMERA, SeveralCamerasError, read_camera_file
from jaxphoto.io.control_table import PLACE, columns_of
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.io.text_tables import is_number, read_csv
from jaxphoto.io.toml import toml_text
from jaxphoto.unknowns import FIXED

EXTERIOR, IMAGES = "exterior.txt", "images.csv"
_TEXTS = (".txt", ".csv", ".dat", ".ori", ".eo", ".opk", ".pat", ".out", "")
_CAMERAS = (".toml", ".xml", ".yml", ".yaml", ".json", ".cameramodel")
_GON = re.compile(r"\b(gons?|grads|gradians?)\b", re.IGNORECASE)
_SYSTEM = re.compile(r"\b(EPSG:\s*\d{4,6}(?:\s*\+\s*\d{4,6})?)", re.IGNORECASE)
_COLUMNS = {name: PLACE[name] for name in "xyz"} | {name: (name,) for name in ("omega", "phi", "kappa")}
_HEADER = "image X Y Z Omega Phi Kappa"
# Number of values in the second and third row of a photograph in PATB.
_MATRIX = (5, 4)
_ORIA = "ORIA"
_GON_DEG = 0.9
# Maximum number of lines searched for the first row.
_BEGIN = 40


class ExteriorText(NamedTuple):
    """Orientations read from a text file."""

    names: list[str]
    positions: Float[np.ndarray, "images 3"]
    camera_from_object: Float[np.ndarray, "images 3 3"]
    system: str
    """EPSG code, or "" if the file names none."""


class _Lines(NamedTuple):
    """Row numbers and lines of a file that are not empty; kind and index of the first row of values."""

    numbered: list[tuple[int, str]]
    kind: str
    """angles, matrices, bingo, or "" if the file has no orientations."""
    first: int
    columns: dict[str, int]
    """Indices of the columns of angles, counted from the end of a row: names may contain blanks."""


def find(source: Path) -> list[Path]:
    """Return text files of orientations; in a folder only if it contains image points, too."""
    paths = [source] if source.is_file() else sorted(source.iterdir())
    texts = [p for p in paths if p.is_file() and p.suffix.lower() in _TEXTS and p.name != IMAGES and _lines(p).kind]
    return texts if texts and (source.is_file() or measured_texts(texts[0])) else []


def read(path: Path) -> Project:
    """Read orientations, and image points and cameras of the same folder; cameras have free nonzero parameters."""
    names, positions, rotations, system = read_exterior(path)
    cameras, camera_of = _cameras(path, names)
    shown = points_beside(path, names, [cameras[name] for name in camera_of])
    if not len(shown.image):
        raise InputError(f"{path.name} has no image points; write BINGO, PATB or image_points.csv into its folder")
    project = Project(
        path.resolve().parent.name, cameras, (), names, camera_of, ExteriorOrientation(positions, rotations),  # type: ignore[arg-type]
        shown.points, None, shown.image, shown.point, shown.column_row, sigma_px=shown.sigma_px, file=path.name,
    )  # fmt: skip
    return with_system(project, system)


def _cameras(path: Path, names: list[str]) -> tuple[dict[str, ProjectCamera], list[str]]:
    """Return the cameras of the folder, and each photograph's camera."""
    near = (p for p in sorted(path.parent.iterdir()) if p.is_file() and not p.name.startswith("."))
    files = [p for p in near if p.suffix.lower() in _CAMERAS]
    if len(files) != 1:
        raise InputError(f"{path.parent}: {len(files)} camera files, not 1; keep one (docs/formats.md)")
    file, beside = files[0], path.with_name(IMAGES)
    if not beside.is_file():
        try:
            camera = read_camera_file(file)
        except SeveralCamerasError:
            raise InputError(f"{file.name} has several cameras; write {IMAGES} into its folder") from None
        return {camera.name: ProjectCamera.estimated(camera.sensor, camera.interior)}, [camera.name] * len(names)
    table, places = read_csv(beside, ("image", "camera")), places_by_name(names)
    of = {places.get(image, -1): name for image, name in zip(table.ids("image"), table.ids("camera"), strict=True)}
    if missing := [name for k, name in enumerate(names) if k not in of]:
        raise InputError(f"{IMAGES} has no camera for {len(missing)} photographs ({few(missing)}); add a row for each")
    chosen = [of[k] for k in range(len(names))]
    read_files = {name: read_camera_file(file, camera=name) for name in dict.fromkeys(chosen)}
    return {name: ProjectCamera.estimated(c.sensor, c.interior) for name, c in read_files.items()}, chosen


# Exterior orientations ----------------------------------------------------------------------------------------


def _lines(path: Path) -> _Lines:
    """Read the lines of a file, and recognise its kind."""
    lines = _Lines(numbered_lines(read_legacy_text(path)), "", 0, {})
    if any(line.split(maxsplit=1)[0] == _ORIA for _, line in lines.numbered):
        return lines._replace(kind="bingo")
    cells = [_cells(line) for _, line in lines.numbered[:_BEGIN]]
    numeric = [len(row) if all(map(is_number, row)) else 0 for row in cells]
    begins = [len(row) > 3 and all(map(is_number, row[-3:])) and not row[0].startswith("#") for row in cells]
    for k in range(len(cells) - 1):
        columns = {name: place - len(cells[k]) for name, place in columns_of(cells[k], _COLUMNS).items()}
        below = cells[k + 1]
        complete = len(columns) == len(_COLUMNS) and len(below) > -min(columns.values())
        if complete and all(is_number(below[at]) for at in columns.values()):
            return lines._replace(kind="angles", first=k + 1, columns=columns)
        # The next photograph of PATB, if any, must follow immediately.
        follows = k + 3 >= len(cells) or begins[k + 3] or cells[k + 3] == ["-99"]
        if begins[k] and tuple(numeric[k + 1 : k + 3]) == _MATRIX and follows:
            return lines._replace(kind="matrices", first=k)
    return lines


def _cells(line: str) -> list[str]:
    """Split a line at the first separator that occurs at least three times, otherwise at whitespace."""
    separator = next((s for s in "\t;," if line.count(s) >= 3), None)
    return [cell.strip() for cell in line.strip().split(separator)]


def read_exterior(path: Path) -> ExteriorText:
    """Read the orientations in a text file. Raise InputError with the row number if a row is invalid."""
    lines = _lines(path)
    if not lines.kind:
        raise InputError(f"{path.name} has no orientations; write the header {_HEADER!r} above the rows")
    above = "\n".join(line for _, line in lines.numbered[: lines.first or _BEGIN])
    rows = lines.numbered[lines.first :]
    content = [(k, _cells(line), line) for k, line in rows if not line.lstrip().startswith("#")]
    names, values = [], []
    if lines.kind == "matrices":
        content = [row for row in content if row[1] != ["-99"]]
        for at in range(0, len(content), 3):
            (k, cells, line), below = content[at], content[at + 1 : at + 3]
            if len(cells) <= 3 or len(below) < 2:
                raise _error(path, k, line, "the start of a three-row photograph")
            matrix = [
                x for (n, row, _), many in zip(below, _MATRIX, strict=True) for x in row_numbers(path, n, row, many)
            ]
            values.append(row_numbers(path, k, cells[-3:], 3) + matrix)
            # A principal distance may precede the position.
            name = cells[:-3]
            names.append(" ".join(name[:-1] if len(name) > 1 and is_number(name[-1]) else name))
    elif lines.kind == "bingo":
        for k, cells, line in content:
            if cells[0] == _ORIA:
                begin = next((j for j in range(2, len(cells) - 5) if all(map(is_number, cells[j : j + 6]))), 0)
                if not begin:
                    raise _error(path, k, line, "ORIA, name, X, Y, Z, phi, omega, kappa")
                names.append(" ".join(cells[1:begin]))
                values.append(row_numbers(path, k, cells[begin : begin + 6], 6))
    else:
        most = -min(lines.columns.values())
        for k, cells, line in content:
            if len(cells) <= most:
                raise _error(path, k, line, "name, X, Y, Z, omega, phi, kappa")
            values.append(row_numbers(path, k, [cells[lines.columns[name]] for name in _COLUMNS], len(_COLUMNS)))
            names.append(" ".join(cells[:-most]))
    numbers = np.array(values).reshape(len(values), -1)
    angles = numbers[:, 3:6] * (_GON_DEG if lines.kind == "bingo" or _GON.search(above) else 1.0)
    if lines.kind == "matrices":
        rotations = np.swapaxes(numbers[:, 3:].reshape(-1, 3, 3), 1, 2)
    elif lines.kind == "bingo":
        rotations = scipy.spatial.transform.Rotation.from_euler("YXZ", angles, degrees=True).inv().as_matrix()
    else:
        exterior = ExteriorOrientation.from_angles(numbers[:, :3], np.deg2rad(angles))  # type: ignore[arg-type]
        rotations = to_numpy(exterior.camera_from_object)
    system = _SYSTEM.search(above)
    return ExteriorText(names, numbers[:, :3], rotations, system[1] if system else "")


def _error(path: Path, row: int, line: str, expected: str) -> InputError:
    return InputError(f"{path.name}, row {row}: {quoted(line)} is not {expected}; correct it")


def write(p: Project, folder: Path) -> None:
    """Write exterior.txt, camera.toml, image_points.csv and, if there are several cameras, images.csv."""
    m = p.in_map()
    heights = "above the ellipsoid" if p.frame.vertical is None else f"of EPSG:{p.frame.vertical}"
    lines = [
        f"# coordinates of {m.system}, heights {heights}" if m.system else "# coordinates of the block's local frame",
        "# omega phi kappa in degrees: camera = Rz(kappa) Ry(phi) Rx(omega) object, camera x right, y up, z backwards",
        "imageName\tX\tY\tZ\tOmega\tPhi\tKappa",
    ]
    values = np.hstack([np.asarray(m.exterior.position), np.rad2deg(to_numpy(m.exterior.omega_phi_kappa))])
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
        "opk", "text of positions and omega, phi, kappa", write=write, endings=(".txt", ".toml", ".csv"),
        lacks=("points",),
    ),
)  # fmt: skip
