"""Image points in a file beside the orientations: image_points.csv, texts of BINGO, PATB and Pix4D, and marks.

    IMAGE [CAMERA | c flags]            the head of a photograph
    point x y ...                       its points
    -99                                 its end; in BINGO's of Pix4D an empty line

BINGO's coordinates are millimetres, PATB's in the unit of the principal distance in its heads, mostly micrometres; x
right, y up, from the middle of the photograph. Pix4D's and those of image_points.csv are our pixels.
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
from jaxphoto.extras.formats.control import Mark, is_geoin
from jaxphoto.extras.formats.files import beginning, row_numbers, warn
from jaxphoto.extras.formats.project import Project
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.io.text_tables import is_number, read_csv

TABLE = "image_points.csv"
_ENDINGS = (".txt", ".dat", ".im", ".img", ".ima", ".pho", ".pat", ".bingo", ".patb", "")
_END = "-99"
# Bytes with the end of the first photograph.
_HEAD = 1_000_000
# A principal distance in micrometres is 1000 times that in millimetres, up to the difference of two calibrations.
_UM, _NEAR = 1000.0, 2.0
# A mark that was exported as tie point too differs by rounding only.
_SAME_PX = 2.0
_RENAMED = " (tie)"
_ROUNDING = 1e-12


class Shown(NamedTuple):
    """Image points by the names of their object points."""

    points: list[str]
    image: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    sigma_px: Float[np.ndarray, "n 2"]
    """NaN if unknown."""


def points_beside(path: Path, files: Sequence[str], cameras: Sequence[ProjectCamera]) -> Shown:
    """Read the one file of image points in the folder of `path`; nothing if there is none.

    Points of photographs other than `files` are skipped (UserWarning). Raises InputError for several files.
    """
    texts = measured_texts(path)
    if len(texts) > 1:
        names = few([other.name for other in texts])
        raise InputError(f"{path.parent} holds {len(texts)} files of image points ({names}); leave one")
    if not texts:
        return named([], [], np.zeros((0, 2)))
    if texts[0].name == TABLE:
        return _read_table(texts[0], files, path.name)
    return points_of(texts[0], files, path.name, cameras)


def measured_texts(path: Path) -> list[Path]:
    """Return the files of image points in the folder of `path`, other than `path`."""
    near = (p for p in sorted(path.parent.iterdir()) if p.is_file() and p != path)
    return [p for p in near if p.name == TABLE or (p.suffix.lower() in _ENDINGS and _is_measured(p))]


def points_of(text: Path, files: Sequence[str], of: str, cameras: Sequence[ProjectCamera] | None = None) -> Shown:
    """Read a text of image points; in pixels without `cameras`. `of` names the file that lists `files`."""
    heads, photograph, points, xy = _read_measured(text)
    places = places_by_name(files)
    photographs = [_photograph(head, places) for head in heads]
    _warn_unknown([head for head, (k, _) in zip(heads, photographs, strict=True) if k < 0], text, of)
    image = np.array([k for k, _ in photographs], int)[photograph]
    centred = bool((xy < 0).any())
    scales = [_scale(None if cameras is None or k < 0 else cameras[k], rest, centred) for k, rest in photographs]
    scale, offset = np.array(scales).reshape(-1, 2, 2)[photograph].transpose(1, 0, 2)
    kept = image >= 0
    return named(image[kept], [points[k] for k in np.flatnonzero(kept).tolist()], (xy * scale + offset)[kept])


def named(
    image: Sequence[int] | np.ndarray,
    points: Sequence[str],
    column_row: Float[np.ndarray, "n 2"],
    sigma_px: Float[np.ndarray, "n 2"] | None = None,
) -> Shown:
    """Return image points, whose object points are numbered by name."""
    ids, point = np.unique(np.array(points, object), return_inverse=True)
    sigma = np.full((len(column_row), 2), np.nan) if sigma_px is None else sigma_px
    return Shown(ids.tolist(), np.array(image, int), point.astype(int), column_row, sigma)


def marks_shown(marks: Sequence[Mark], files: Sequence[str]) -> Shown:
    """Return the marks in the photographs `files`."""
    place = {name: k for k, name in enumerate(files)}
    there = [mark for mark in marks if mark[0] in place]
    at, sigma = np.array([mark[2] for mark in there]).reshape(-1, 2), np.array([[mark[3]] * 2 for mark in there])
    return named([place[mark[0]] for mark in there], [mark[1] for mark in there], at, sigma.reshape(-1, 2))


def joined(ties: Shown, marks: Shown, of: str) -> Shown:
    """Return tie points and marks; a tie point with a mark's name is the mark if they coincide in an image.

    Otherwise it is renamed (UserWarning).
    """
    names = [[shown.points[k] for k in shown.point.tolist()] for shown in (ties, marks)]
    marked = dict(zip(zip(marks.image.tolist(), names[1], strict=True), marks.column_row, strict=True))
    where = list(zip(ties.image.tolist(), names[0], strict=True))
    same = {
        key[1]
        for key, at in zip(where, ties.column_row, strict=True)
        if key in marked and float(np.hypot(*(marked[key] - at))) < _SAME_PX
    }
    clash = set(names[0]) & set(names[1]) - same
    if clash:
        warn(
            f"{of}: {len(clash)} tie points have the name of a marker but lie elsewhere ({few(sorted(clash))}); they "
            f"get another, with {_RENAMED!r} behind"
        )
    kept = np.array([key[1] not in same or key not in marked for key in where], bool)
    tie_names = [n + _RENAMED if n in clash else n for n, keep in zip(names[0], kept.tolist(), strict=True) if keep]
    # A mark without standard deviation gets that of its tie point.
    of_ties = dict(zip(where, ties.sigma_px.tolist(), strict=True))
    sigma = [
        of_ties.get(key, s) if key[1] in same and np.isnan(s[0]) else s
        for key, s in zip(zip(marks.image.tolist(), names[1], strict=True), marks.sigma_px.tolist(), strict=True)
    ]
    return named(
        np.concatenate([ties.image[kept], marks.image]),
        tie_names + names[1],
        np.concatenate([ties.column_row[kept], marks.column_row]),
        np.concatenate([ties.sigma_px[kept], np.array(sigma).reshape(-1, 2)]),
    )


def places_by_name(files: Sequence[str]) -> dict[str, int]:
    """Return photographs by their names, and by those without folder or ending if they are unique."""
    paths = [PurePosixPath(PureWindowsPath(file).as_posix()) for file in files]
    places: dict[str, int] = {}
    for names in ([path.stem for path in paths], [path.name for path in paths]):
        times = Counter(names)
        places |= {name: k for k, name in enumerate(names) if times[name] == 1}
    return places | {name: k for k, name in enumerate(files)}


def write_image_points(p: Project, folder: Path, names: Sequence[str] | None = None) -> None:
    """Write image_points.csv; `names` are those of photographs, by default of their files.

    Warns if the standard deviations of x and y differ, of which the table has the root of their mean square.
    """
    images = names or p.files
    columns = {"image": np.array(images, object)[p.image], "point": np.array(p.points, object)[p.point]}
    columns |= {"column_px": p.column_row[:, 0], "row_px": p.column_row[:, 1]}
    if p.sigma_px is not None:
        x, y = p.sigma_px.T
        columns["sigma_px"] = np.sqrt((x**2 + y**2) / 2)
        if (np.abs(x - y) > _ROUNDING * x).any():
            warn(
                f"{TABLE} has one standard deviation for x and y, and those of the block differ: their root mean "
                "square is written"
            )
    # A first name that starts with # is quoted, or its line would be a comment.
    quoting: Literal[0, 2] = csv.QUOTE_NONNUMERIC if any(n.startswith("#") for n in images) else csv.QUOTE_MINIMAL
    pd.DataFrame(columns).to_csv(folder / TABLE, index=False, quoting=quoting)


def _is_measured(path: Path) -> bool:
    """Return True if a file begins with a head and a row of point, x, y, and has an end somewhere."""
    begin = beginning(path, _HEAD)
    lines = [line.split() for line in begin]
    if len(lines) < 3 or is_geoin(begin) or not _is_row(lines[1]) or _is_head(lines[1]):
        return False
    return not _is_row(lines[0]) or [_END] in lines


def _is_row(words: list[str]) -> bool:
    return len(words) >= 3 and is_number(words[1]) and is_number(words[2])


def _is_head(words: list[str]) -> bool:
    """Return True for a head without an end before it: an image and what cannot be a coordinate."""
    return len(words) == 2 and not is_number(words[1])


def _read_measured(path: Path) -> tuple[list[str], np.ndarray, list[str], np.ndarray]:
    """Heads, and of every point the number of its head, its name and coordinates."""
    heads, photograph, points, rows, within = [], [], [], [], False
    for k, line in enumerate(read_legacy_text(path).split("\n"), 1):
        words = line.split()
        if not words or words == [_END]:
            within = False
        elif not within or _is_head(words):
            heads.append(line.strip())
            within = True
        elif len(words) < 3:
            raise InputError(f"{path.name}, row {k}: {quoted(line)} is not point, x, y. Complete the row")
        else:
            photograph.append(len(heads) - 1)
            points.append(words[0])
            rows.append(row_numbers(path, k, words[1:3], 2))
    return heads, np.array(photograph, int), points, np.array(rows).reshape(-1, 2)


def _read_table(text: Path, files: Sequence[str], of: str) -> Shown:
    table = read_csv(text, ("image", "point", "column_px", "row_px"), ("sigma_px",))
    places = places_by_name(files)
    images, points = table.ids("image").tolist(), table.ids("point")
    place = np.array([places.get(name, -1) for name in images], int)
    _warn_unknown(list(dict.fromkeys(name for name, k in zip(images, place, strict=True) if k < 0)), text, of)
    at, kept = np.stack([table.numbers("column_px"), table.numbers("row_px")], axis=1), place >= 0
    return named(
        place[kept], points[kept].tolist(), at[kept], np.repeat(table.sigmas("sigma_px")[kept, None], 2, axis=1)
    )


def _photograph(head: str, places: dict[str, int]) -> tuple[int, list[str]]:
    """The photograph that a head names, -1 for none, and the words after its name."""
    words = head.split()
    for n in range(len(words), 0, -1):
        name = head if n == len(words) else " ".join(words[:n])
        if name in places:
            return places[name], words[n:]
    return -1, []


def _scale(camera: ProjectCamera | None, rest: list[str], centred: bool) -> list[list[float]]:
    """Factors and offsets that make pixels of a photograph's coordinates.

    They are pixels if the head is a name alone and no coordinate of the file is negative.
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
            f"{text.name}: {len(unknown)} photographs are not in {of} and are left out: "
            f"{few([quoted(name) for name in unknown])}"
        )
