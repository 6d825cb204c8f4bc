"""Folder of text files: exterior orientations, image points and a camera file.

    image X Y Z Omega Phi Kappa             header, then one row per photograph; separated by blanks, tabs, commas or
                                            semicolons, in any order

    photograph [c] X Y Z                    PATB: three rows per photograph
    a11 a12 a13 a21 a22
    a23 a31 a32 a33

    ORIA photograph X Y Z phi omega kappa   BINGO's itera.dat; other rows are ignored

    photograph [camera | c flags]           image points: header of a photograph
    point x y ...                           its image points
    -99                                     end of the photograph; an empty line in Pix4D's BINGO files

omega, phi, kappa are defined in docs/conventions.md, in degrees, or gon if a line above the rows contains gon, grads or
gradians. PATB's matrix rotates from camera axes x right, y up, z backward to object axes. BINGO's angles are
camera_from_object = R3(kappa) R1(omega) R2(phi), in gon. A comment EPSG:... names the coordinate system. If there are
several cameras, images.csv (image, camera) assigns a camera to each photograph. BINGO's image points are in mm, PATB's
in the unit of the principal distance in its headers, usually micrometres; x right, y up, from the image centre. Pix4D's
image points and image_points.csv are in our pixels. Sources: Pix4D support, articles 202977149, 202558969 ("Yaw, Pitch,
Roll and Omega, Phi, Kappa angles") and 203590305 ("What is the bingo file generated during Initial Processing?"); PCI
Geomatics, OrthoEngine, "Using Pat-B in OrthoEngine", "Exporting a project to PATB"; for BINGO, whose manual is not
public, S. Turek's bundle block adjustment for GRASS, 2014.
"""

import csv
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Literal, NamedTuple

import jax
import numpy as np
import pandas as pd
import scipy
from jaxtyping import Float, Int

from jaxphoto.arrays import to_numpy
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.extras.formats.control import Mark
from jaxphoto.extras.formats.files import Format, beginning, numbered_lines, row_numbers, warn
from jaxphoto.extras.formats.project import Project, ProjectCamera, with_system
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.camera_files import CAMERA, SeveralCamerasError, read_camera_file
from jaxphoto.io.control_table import PLACE, columns_of
from jaxphoto.io.text_files import decoded, read_bytes, read_text
from jaxphoto.io.text_tables import is_number, read_csv
from jaxphoto.io.toml import toml_text
from jaxphoto.unknowns import FIXED

EXTERIOR, IMAGES = "exterior.txt", "images.csv"
TABLE = "image_points.csv"
_ENDINGS = (".txt", ".dat", ".im", ".img", ".ima", ".pho", ".pat", ".bingo", ".patb", "")
_END = "-99"
# Maximum number of bytes searched for the end of the first photograph.
_HEAD = 1_000_000
# Micrometres per millimetre; maximum ratio of the principal distances of header and camera if both are in micrometres.
_UM, _NEAR = 1000.0, 2.0
# Maximum distance (px) between a mark and the same mark exported as tie point; they differ by rounding.
_SAME_PX = 2.0
_RENAMED = " (tie)"
_ROUNDING = 1e-12
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


def find(source: Path) -> list[Path]:
    """Return text files of orientations; in a folder only if it contains image points, too."""
    paths = [source] if source.is_file() else sorted(source.iterdir())
    texts = [p for p in paths if p.is_file() and p.suffix.lower() in _TEXTS and p.name != IMAGES and _layout(p)[0]]
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


def _layout(path: Path) -> tuple[str, int, dict[str, int]]:
    """Return angles, matrices, bingo or "" (no orientations), the index of the first nonempty line of values, and the
    columns of angles, counted from the end of a row: names may contain blanks.
    """
    lines = numbered_lines(decoded(read_bytes(path)))
    if any(line.split(maxsplit=1)[0] == _ORIA for _, line in lines):
        return "bingo", 0, {}
    cells = [_cells(line) for _, line in lines[:_BEGIN]]
    numeric = [len(row) if all(map(is_number, row)) else 0 for row in cells]
    begins = [len(row) > 3 and all(map(is_number, row[-3:])) and not row[0].startswith("#") for row in cells]
    for k in range(len(cells) - 1):
        columns = {name: place - len(cells[k]) for name, place in columns_of(cells[k], _COLUMNS).items()}
        below = cells[k + 1]
        complete = len(columns) == len(_COLUMNS) and len(below) > -min(columns.values())
        if complete and all(is_number(below[at]) for at in columns.values()):
            return "angles", k + 1, columns
        # The next photograph of PATB, if any, must follow immediately.
        follows = k + 3 >= len(cells) or begins[k + 3] or cells[k + 3] == ["-99"]
        if begins[k] and tuple(numeric[k + 1 : k + 3]) == _MATRIX and follows:
            return "matrices", k, {}
    return "", 0, {}


def _cells(line: str) -> list[str]:
    """Split a line at the first separator that occurs at least three times, otherwise at whitespace."""
    separator = next((s for s in "\t;," if line.count(s) >= 3), None)
    return [cell.strip() for cell in line.strip().split(separator)]


def read_exterior(path: Path) -> ExteriorText:
    """Read the orientations in a text file. Raise InputError with the row number if a row is invalid."""
    (kind, first, columns), lines = _layout(path), numbered_lines(read_text(path))
    if not kind:
        raise InputError(f"{path.name} has no orientations; write the header {_HEADER!r} above the rows")
    above = "\n".join(line for _, line in lines[: first or _BEGIN])
    content = [(k, _cells(line), line) for k, line in lines[first:] if not line.lstrip().startswith("#")]
    names, values = [], []
    if kind == "matrices":
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
    elif kind == "bingo":
        for k, cells, line in content:
            if cells[0] == _ORIA:
                begin = next((j for j in range(2, len(cells) - 5) if all(map(is_number, cells[j : j + 6]))), 0)
                if not begin:
                    raise _error(path, k, line, "ORIA, name, X, Y, Z, phi, omega, kappa")
                names.append(" ".join(cells[1:begin]))
                values.append(row_numbers(path, k, cells[begin : begin + 6], 6))
    else:
        most = -min(columns.values())
        for k, cells, line in content:
            if len(cells) <= most:
                raise _error(path, k, line, "name, X, Y, Z, omega, phi, kappa")
            values.append(row_numbers(path, k, [cells[columns[name]] for name in _COLUMNS], len(_COLUMNS)))
            names.append(" ".join(cells[:-most]))
    numbers = np.array(values).reshape(len(values), -1)
    angles = numbers[:, 3:6] * (_GON_DEG if kind == "bingo" or _GON.search(above) else 1.0)
    if kind == "matrices":
        rotations = np.swapaxes(numbers[:, 3:].reshape(-1, 3, 3), 1, 2)
    elif kind == "bingo":
        rotations = scipy.spatial.transform.Rotation.from_euler("YXZ", angles, degrees=True).inv().as_matrix()
    else:
        exterior = ExteriorOrientation.from_angles(numbers[:, :3], np.deg2rad(angles))  # type: ignore[arg-type]
        rotations = to_numpy(exterior.camera_from_object)
    system = _SYSTEM.search(above)
    return ExteriorText(names, numbers[:, :3], rotations, system[1] if system else "")


def _error(path: Path, row: int, line: str, expected: str) -> InputError:
    return InputError(f"{path.name}, row {row}: {quoted(line)} is not {expected}; correct it")


# Image points ------------------------------------------------------------------------------------------------


class Shown(NamedTuple):
    """Image points, and the names of their object points."""

    points: list[str]
    image: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    sigma_px: Float[np.ndarray, "n 2"]
    """NaN if unknown."""

    def frame(self) -> pd.DataFrame:
        """Return image, point name, x, y and sigma of each image point."""
        (x, y), names = self.column_row.T, np.array(self.points, object)[self.point]
        return pd.DataFrame({"image": self.image, "point": names, "x": x, "y": y, "sigma": self.sigma_px[:, 0]})


def named(
    image: Sequence[int] | np.ndarray,
    points: Sequence[str] | np.ndarray,
    column_row: Float[np.ndarray, "n 2"],
    sigma_px: Sequence[float] | np.ndarray | float = np.nan,
) -> Shown:
    """Build `Shown` from point names; object points are sorted by name."""
    ids, point = np.unique(np.array(points, object), return_inverse=True)
    sigma = np.repeat(np.broadcast_to(np.array(sigma_px, float), len(column_row))[:, None], 2, axis=1)
    return Shown(ids.tolist(), np.array(image, int), point.astype(int), column_row, sigma)


def points_beside(path: Path, files: Sequence[str], cameras: Sequence[ProjectCamera]) -> Shown:
    """Read the only file of image points in the folder of `path`; return no points if there is none.

    Points of photographs not in `files` are skipped (UserWarning). Raises InputError if there are several files.
    """
    texts = measured_texts(path)
    if len(texts) > 1:
        names = few([other.name for other in texts])
        raise InputError(f"{path.parent}: {len(texts)} files of image points ({names}); keep one")
    if not texts:
        return named([], [], np.zeros((0, 2)))
    if texts[0].name != TABLE:
        return points_of(texts[0], files, path.name, cameras)
    table = read_csv(texts[0], ("image", "point", "column_px", "row_px"), ("sigma_px",))
    images, points = table.ids("image").tolist(), table.ids("point")
    places = places_by_name(files)
    place = np.array([places.get(name, -1) for name in images], int)
    _warn_unknown(
        list(dict.fromkeys(name for name, k in zip(images, place, strict=True) if k < 0)), texts[0], path.name
    )
    at, kept = table.matrix(("column_px", "row_px")), place >= 0
    return named(place[kept], points[kept], at[kept], table.sigmas("sigma_px")[kept])


def measured_texts(path: Path) -> list[Path]:
    """Return files of image points in the folder of `path`, other than `path`."""
    near = (p for p in sorted(path.parent.iterdir()) if p.is_file() and p != path)
    return [p for p in near if p.name == TABLE or (p.suffix.lower() in _ENDINGS and _is_measured(p))]


def _is_measured(path: Path) -> bool:
    """Return True if a file starts with a header and a row of point, x, y, and contains an end marker if needed."""
    lines = [line.split() for line in beginning(path, _HEAD)]
    # Rows of BINGO's geoin.dat begin with a record name.
    if len(lines) < 3 or not _is_row(lines[1]) or lines[1][0] in ("CONT", "CHCK"):
        return False
    return not _is_row(lines[0]) or [_END] in lines


def _is_row(words: list[str]) -> bool:
    return len(words) >= 3 and is_number(words[1]) and is_number(words[2])


def points_of(text: Path, files: Sequence[str], of: str, cameras: Sequence[ProjectCamera] | None = None) -> Shown:
    """Read image points from a text file; in pixels if `cameras` is None. `of` is the name of the file that lists
    `files`.
    """
    heads, photograph, points, rows, within = list[str](), list[int](), list[str](), list[list[float]](), False
    for k, line in enumerate(read_text(text).split("\n"), 1):
        words = line.split()
        if not words or words == [_END]:
            within = False
        elif not within or (len(words) == 2 and not is_number(words[1])):
            # A header follows an end, or has an image name and a word that is not numeric.
            heads.append(line.strip())
            within = True
        elif len(words) < 3:
            raise InputError(f"{text.name}, row {k}: {quoted(line)} is not point, x, y. Complete it")
        else:
            photograph.append(len(heads) - 1)
            points.append(words[0])
            rows.append(row_numbers(text, k, words[1:3], 2))
    xy, places = np.array(rows).reshape(-1, 2), places_by_name(files)
    photographs = [_photograph(head, places) for head in heads]
    _warn_unknown([head for head, (k, _) in zip(heads, photographs, strict=True) if k < 0], text, of)
    image = np.array([k for k, _ in photographs], int)[photograph]
    centred = bool((xy < 0).any())
    scales = [_scale(None if cameras is None or k < 0 else cameras[k], rest, centred) for k, rest in photographs]
    scale, offset = np.array(scales).reshape(-1, 2, 2)[photograph].transpose(1, 0, 2)
    kept = image >= 0
    return named(image[kept], np.array(points, object)[kept], (xy * scale + offset)[kept])


def _photograph(head: str, places: dict[str, int]) -> tuple[int, list[str]]:
    """Return the index of the photograph named in a header (-1 if unknown) and the words after the name."""
    words = head.split()
    for n in range(len(words), 0, -1):
        name = head if n == len(words) else " ".join(words[:n])
        if name in places:
            return places[name], words[n:]
    return -1, []


def _scale(camera: ProjectCamera | None, rest: list[str], centred: bool) -> list[list[float]]:
    """Return factors and offsets that convert a photograph's coordinates to pixels.

    Coordinates are in pixels if the header has only a name and no coordinate in the file is negative.
    """
    if camera is None or not (rest or centred):
        return [[1.0, 1.0], [0.0, 0.0]]
    sensor, c_um = camera.sensor, float(camera.interior.c) * _UM
    c = abs(float(rest[0])) if rest and is_number(rest[0]) else 0.0
    unit_px = (1 / _UM if c_um / _NEAR < c < c_um * _NEAR else 1.0) / sensor.pixel_mm
    return [[unit_px, -unit_px], [sensor.width_px / 2, sensor.height_px / 2]]


def _warn_unknown(unknown: list[str], text: Path, of: str) -> None:
    if unknown:
        warn(
            f"{text.name}: skipped {len(unknown)} photographs that are not in {of}: "
            f"{few([quoted(name) for name in unknown])}"
        )


def with_marks(ties: Shown, rows: Sequence[Mark], files: Sequence[str], of: str) -> Shown:
    """Merge tie points and marks. A tie point with a mark's name is identical to it if they coincide in an image.

    Otherwise the tie point is renamed (UserWarning).
    """
    place = {name: k for k, name in enumerate(files)}
    there = [mark for mark in rows if mark[0] in place]
    at = np.array([mark[2] for mark in there]).reshape(-1, 2)
    marks = named([place[m[0]] for m in there], [m[1] for m in there], at, [m[3] for m in there])
    own, key = ties.frame(), ["image", "point"]
    both = marks.frame().merge(own, "left", key, suffixes=("", "_tie"))
    same = set(both.point[np.hypot(both.x - both.x_tie, both.y - both.y_tie) < _SAME_PX])
    # Marks without standard deviation take the tie point's.
    both["sigma"] = both.sigma.where(both.sigma.notna() | ~both.point.isin(same), both.sigma_tie)
    clash = set(own.point) & set(both.point) - same
    if clash:
        warn(
            f"{of}: {len(clash)} tie points have the name of a marker elsewhere ({few(sorted(clash))}); renamed by "
            f"appending {_RENAMED!r}"
        )
    own.loc[own.point.isin(clash), "point"] += _RENAMED
    rows_of = pd.concat([both[list(own)], own]).drop_duplicates(key)
    image, point, sigma = (rows_of[name].to_numpy() for name in ("image", "point", "sigma"))
    return named(image, point, rows_of[["x", "y"]].to_numpy(), sigma)


def places_by_name(files: Sequence[str]) -> dict[str, int]:
    """Return photograph indices by file name, and by name without folder or suffix where this is unique."""
    paths = [PurePosixPath(PureWindowsPath(file).as_posix()) for file in files]
    places: dict[str, int] = {}
    for names in ([path.stem for path in paths], [path.name for path in paths]):
        times = Counter(names)
        places |= {name: k for k, name in enumerate(names) if times[name] == 1}
    return places | {name: k for k, name in enumerate(files)}


def write_image_points(p: Project, folder: Path, names: Sequence[str] | None = None) -> None:
    """Write image_points.csv. `names` are the photograph names, by default the file names.

    Warns if the standard deviations of x and y differ: the table contains their root mean square.
    """
    images = names or p.files
    columns = {"image": np.array(images, object)[p.image], "point": np.array(p.points, object)[p.point]}
    columns |= {"column_px": p.column_row[:, 0], "row_px": p.column_row[:, 1]}
    if p.sigma_px is not None:
        x, y = p.sigma_px.T
        columns["sigma_px"] = np.sqrt((x**2 + y**2) / 2)
        if (np.abs(x - y) > _ROUNDING * x).any():
            warn(f"sigma_x and sigma_y differ, but {TABLE} has one column for both; writing their root mean square")
    # Quote the names if one starts with #: an unquoted first line would be a comment.
    quoting: Literal[0, 2] = csv.QUOTE_NONNUMERIC if any(n.startswith("#") for n in images) else csv.QUOTE_MINIMAL
    pd.DataFrame(columns).to_csv(folder / TABLE, index=False, quoting=quoting)


# Written -----------------------------------------------------------------------------------------------------


def write(p: Project, folder: Path) -> None:
    """Write exterior.txt, camera.toml, image_points.csv and, if there are several cameras, images.csv."""
    m = p.in_map()
    heights = "above the ellipsoid" if p.frame.vertical is None else f"of EPSG:{p.frame.vertical}"
    lines = [
        f"# coordinates of EPSG:{p.frame.code}, heights {heights}" if m.on_map else "# coordinates of the local frame",
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
