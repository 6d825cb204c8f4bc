"""Image points in the folder of the orientations: image_points.csv, texts of BINGO, PATB and Pix4D, and marks.

    IMAGE [CAMERA | c flags]            header of a photograph
    point x y ...                       its image points
    -99                                 end of the photograph; an empty line in Pix4D's BINGO files

BINGO's coordinates are in millimetres, PATB's in the unit of the principal distance in its headers, usually
micrometres; x right, y up, from the image centre. Pix4D's coordinates and image_points.csv are in our pixels.

Sources: Pix4D support, articles 203590305 ("What is the bingo file generated during Initial Processing?") and
202977149; PCI Geomatics, OrthoEngine, "Exporting a project to PATB".
"""

import csv
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from jaxphoto.errors import InputError, few, quoted
from jaxphoto.extras.formats.camera_models import ProjectCamera
from jaxphoto.extras.formats.control import Mark
from jaxphoto.extras.formats.files import beginning, row_numbers, warn
from jaxphoto.extras.formats.project import Project
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.io.text_tables import is_number, read_csv

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
    for k, line in enumerate(read_legacy_text(text).split("\n"), 1):
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
