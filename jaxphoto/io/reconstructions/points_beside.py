"""Where photographs show points, for orientations whose own file does not say so: texts that lie beside it, and marks.

BINGO's coordinates are millimetres and PATB's in the unit of the principal distance in its heads, micrometres as a
rule; x right, y up, from the middle of the photograph. Pix4D's and those of image_points.csv are pixels; the corner of
the upper left one is (0, 0).
"""

import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.block import Frame
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.control_files.rows import Mark
from jaxphoto.io.reconstructions.measured_text import is_measured, read_measured
from jaxphoto.io.reconstructions.on_map import frame_of_words
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, TiedPhotographs, free_network
from jaxphoto.io.text_tables import is_number, read_csv

TABLE = "image_points.csv"
# What files of such texts end with.
_ENDS = (".txt", ".dat", ".im", ".img", ".ima", ".pho", ".pat", ".bingo", ".patb", "")
# A principal distance in micrometres is so many times one in millimetres, but for the difference of two calibrations.
_UM = 1000.0
_NEAR = 2.0
# A mark that was exported among tie points is rounded by less.
_SAME_PX = 2.0
_OTHER = " (tie)"


class Shown(NamedTuple):
    """Which photographs show which points, and where."""

    points: list[str]
    image: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    sigma_px: Float[np.ndarray, "n"]
    """NaN where nothing tells it."""


class PhotographCamera(NamedTuple):
    """The camera of a photograph."""

    sensor: Sensor
    interior: InteriorOrientation


def points_beside(path: Path, files: Sequence[str], cameras: Sequence[PhotographCamera]) -> Shown:
    """What the one text, or image_points.csv, in the folder of `path` says of the photographs `files`; nothing where
    there is none.

    Raises InputError for several, and for rows that are no image points. A UserWarning tells of other photographs.
    """
    found = measured_texts(path)
    if len(found) > 1:
        told = few([other.name for other in found])
        raise InputError(f"{path.parent} holds {len(found)} files of image points ({told}); leave one")
    if not found:
        return named([], [], np.zeros((0, 2)))
    (text,) = found
    if text.name == TABLE:
        return _of_table(text, files, path.name)
    return points_of(text, files, path.name, cameras)


def measured_texts(path: Path) -> list[Path]:
    """The files of image points in the folder of `path`, which is none of them."""
    near = (p for p in sorted(path.parent.iterdir()) if p.is_file() and p != path)
    return [p for p in near if p.name == TABLE or (p.suffix.lower() in _ENDS and is_measured(p))]


def points_of(text: Path, files: Sequence[str], of: str, cameras: Sequence[PhotographCamera] | None = None) -> Shown:
    """The image points in a text of the photographs `files`; without `cameras` they are pixels. A UserWarning tells of
    photographs that are none of `files`, which the file `of` names.

    Raises InputError for rows that are no image points.
    """
    measured = read_measured(text)
    places = places_by_name(files)
    heads = [_photograph(head, places) for head in measured.heads]
    _tell([head for head, (k, _) in zip(measured.heads, heads, strict=True) if k < 0], text, of)
    image = np.array([k for k, _ in heads], int)[measured.photograph]
    centred = bool((measured.xy < 0).any())
    scales = [_scale(None if cameras is None or k < 0 else cameras[k], rest, centred) for k, rest in heads]
    scale, offset = np.array(scales).reshape(-1, 2, 2)[measured.photograph].transpose(1, 0, 2)
    kept = image >= 0
    points = [measured.points[k] for k in np.flatnonzero(kept).tolist()]
    return named(image[kept], points, (measured.xy * scale + offset)[kept])


def network_beside(
    path: Path,
    cameras: Mapping[str, TiedCamera],
    files: Sequence[str],
    camera_of: Sequence[str],
    camera_from_object: Float[np.ndarray, "images 3 3"],
    positions: Float[np.ndarray, "images 3"],
    shown: Shown,
    system: str = "",
) -> BlockTables:
    """The `free_network` of orientations in our axes that the file `path` gives in the system that these words name, ""
    for one of its own, and of the points beside it. Raises what `free_network` and `frame_of_words` raise.
    """
    return free_network(
        TiedPhotographs(
            path.name,
            "the program",
            path.resolve().parent.name,
            cameras,
            files,
            camera_of,
            np.array([[1.0], [-1.0], [-1.0]]) * camera_from_object,
            positions,
            shown.points,
            None,
            shown.image,
            shown.point,
            shown.column_row,
            frame_of_words(path.name, system, positions) if system else Frame("local"),
            sigma_px=shown.sigma_px,
        )
    )


def marks_shown(marks: Sequence[Mark], files: Sequence[str]) -> Shown:
    """The marks of points in the photographs `files`, by their whole names; other photographs are left out."""
    place = {name: k for k, name in enumerate(files)}
    own = [mark for mark in marks if mark[0] in place]
    at, sigma = np.array([mark[2] for mark in own]).reshape(-1, 2), np.array([mark[3] for mark in own], float)
    return named([place[mark[0]] for mark in own], [mark[1] for mark in own], at, sigma)


def joined(ties: Shown, marks: Shown, of: str) -> Shown:
    """Both. A tie point of a mark's name is the mark where a photograph shows both at one place; else it is another
    point, which gets another name (UserWarning).
    """
    names = [[shown.points[k] for k in shown.point.tolist()] for shown in (ties, marks)]
    marked = dict(zip(zip(marks.image.tolist(), names[1], strict=True), marks.column_row, strict=True))
    where = list(zip(ties.image.tolist(), names[0], strict=True))
    same = {
        place[1]
        for place, at in zip(where, ties.column_row, strict=True)
        if place in marked and float(np.hypot(*(marked[place] - at))) < _SAME_PX
    }
    clash = set(names[0]) & set(names[1]) - same
    if clash:
        warnings.warn(
            f"{of}: {len(clash)} tie points have the name of a marker but lie elsewhere ({few(sorted(clash))}); they "
            f"get another, with {_OTHER!r} behind",
            UserWarning,
            stacklevel=3,
        )
    # What is a mark's is measured once.
    kept = np.array([place[1] not in same or place not in marked for place in where], bool)
    own = [name + _OTHER if name in clash else name for name, keep in zip(names[0], kept.tolist(), strict=True) if keep]
    image = np.concatenate([ties.image[kept], marks.image])
    at = np.concatenate([ties.column_row[kept], marks.column_row])
    # Of a mark, what the tie point there has.
    of_ties = dict(zip(where, ties.sigma_px.tolist(), strict=True))
    of_marks = [
        of_ties.get((i, name), np.nan) if name in same and np.isnan(s) else s
        for i, name, s in zip(marks.image.tolist(), names[1], marks.sigma_px.tolist(), strict=True)
    ]
    return named(image, own + names[1], at, np.concatenate([ties.sigma_px[kept], of_marks]))


def named(
    image: Sequence[int] | np.ndarray,
    points: Sequence[str],
    column_row: Float[np.ndarray, "n 2"],
    sigma_px: Float[np.ndarray, "n"] | None = None,
) -> Shown:
    """Measurements by the names of their points."""
    ids, point = np.unique(np.array(points, object), return_inverse=True)
    sigma = np.full(len(column_row), np.nan) if sigma_px is None else sigma_px
    return Shown(ids.tolist(), np.array(image, int), point.astype(int), column_row, sigma)


def _of_table(text: Path, files: Sequence[str], of: str) -> Shown:
    table = read_csv(text, ("image", "point", "column_px", "row_px"), ("sigma_px",))
    places = places_by_name(files)
    images, points = table.ids("image").tolist(), table.ids("point").tolist()
    place = np.array([places.get(name, -1) for name in images], int)
    _tell(list(dict.fromkeys(name for name, k in zip(images, place.tolist(), strict=True) if k < 0)), text, of)
    at, kept = np.stack([table.numbers("column_px"), table.numbers("row_px")], axis=1), place >= 0
    own = [name for name, k in zip(points, kept.tolist(), strict=True) if k]
    return named(place[kept], own, at[kept], table.sigmas("sigma_px")[kept])


def places_by_name(files: Sequence[str]) -> dict[str, int]:
    """Photographs by their names, and by those without folder and ending where only one has such."""
    paths = [PurePosixPath(PureWindowsPath(file).as_posix()) for file in files]
    found: dict[str, int] = {}
    for names in ([path.stem for path in paths], [path.name for path in paths]):
        times = Counter(names)
        found |= {name: k for k, name in enumerate(names) if times[name] == 1}
    return found | {name: k for k, name in enumerate(files)}


def _photograph(head: str, places: dict[str, int]) -> tuple[int, list[str]]:
    """The photograph that a head names, -1 for none, and what the head says of it beyond its name."""
    words = head.split()
    for n in range(len(words), 0, -1):
        name = head if n == len(words) else " ".join(words[:n])
        if name in places:
            return places[name], words[n:]
    return -1, []


def _scale(camera: PhotographCamera | None, rest: list[str], centred: bool) -> list[list[float]]:
    """What makes pixels of a photograph's coordinates: factors and what is then added, by axis.

    Where its head is but its name, they are pixels if none of the file is negative: half of those from the middle are.
    """
    if camera is None or not (rest or centred):
        return [[1.0, 1.0], [0.0, 0.0]]
    sensor, c_um = camera.sensor, float(camera.interior.c) * _UM
    c = abs(float(rest[0])) if rest and is_number(rest[0]) else 0.0
    unit_px = (1 / _UM if c_um / _NEAR < c < c_um * _NEAR else 1.0) / sensor.pixel_mm
    return [[unit_px, -unit_px], [sensor.width_px / 2, sensor.height_px / 2]]


def _tell(unknown: list[str], text: Path, of: str) -> None:
    if unknown:
        left = few([quoted(name) for name in unknown])
        warnings.warn(
            f"{text.name}: {len(unknown)} photographs are not in {of} and are left out: {left}",
            UserWarning,
            stacklevel=4,
        )
