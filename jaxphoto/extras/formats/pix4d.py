"""The folder "params" of Pix4D.

    NAME_calibrated_camera_parameters.txt   of every photograph: name width height; K; radial R1 R2 R3; tangential
                                            T1 T2; position t; rotation R
    NAME_tp_pix4d.txt                       of every photograph its name, then rows of point x y size, then -99
    NAME_offset.xyz                         what is added to positions to be in the map's system

A point is seen at K (u, v, 1), where (u, v) are the first two of R (X - t) over the third, x right, y down, z ahead,
with OpenCV's distortion k1, k2, k3 = R1, R2, R3 and p1, p2 = T1, T2. Pixels are ours. The files have no object points:
these are intersected.
Sources: Pix4D support, articles 202977149 ("What does the Output Params Folder contain?") and 202559089 ("How are the
Internal and External Camera Parameters defined?").
"""

from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.camera_models import BROWN_TERMS, OPENCV, ProjectCamera, in_pixels
from jaxphoto.extras.formats.files import Format, begins_with, row_numbers
from jaxphoto.extras.formats.points_beside import points_of
from jaxphoto.extras.formats.project import Project, pose
from jaxphoto.io.camera_files import CameraSource
from jaxphoto.io.text_files import read_legacy_text

CAMERAS_FILE, POINTS_FILE, OFFSET_FILE = "calibrated_camera_parameters.txt", "tp_pix4d.txt", "offset.xyz"
_HEAD = "fileName imageWidth imageHeight"
# Numbers in the rows below name and size: K, radial, tangential, t, R.
_ROWS = (3, 3, 3, 3, 2, 3, 3, 3, 3)


def find(source: Path) -> list[Path]:
    """Return the files of cameras in the folder, or in that of a project."""
    folders = (source, source / "params", source / "1_initial" / "params") if source.is_dir() else ()
    paths = [path for folder in folders for path in sorted(folder.glob(f"*{CAMERAS_FILE}"))] or [source]
    return [p for p in paths if p.is_file() and p.name.endswith(CAMERAS_FILE) and begins_with(p, _HEAD)]


def read(path: Path) -> Project:
    """Read a project; photographs with the same K and distortion have one camera, free in all terms."""
    name = path.name.removesuffix(CAMERAS_FILE)
    files, sizes, numbers = _read_cameras(path)
    kinds, number = np.unique(np.column_stack([sizes, numbers[:, :14]]), axis=0, return_inverse=True)
    shown = points_of(path.with_name(name + POINTS_FILE), files, path.name)
    offset_path = path.with_name(name + OFFSET_FILE)
    offset = (
        row_numbers(offset_path, 1, read_legacy_text(offset_path).split(), 3) if offset_path.is_file() else np.zeros(3)
    )
    return Project(
        name.strip("_"), {str(k): _camera(path, values.tolist()) for k, values in enumerate(kinds)}, (), files,
        [str(k) for k in number.tolist()], pose(numbers[:, 17:].reshape(-1, 3, 3), numbers[:, 14:17] + offset),
        shown.points, None, shown.image, shown.point, shown.column_row, file=path.name,
    )  # fmt: skip


def _read_cameras(path: Path) -> tuple[list[str], list[tuple[int, int]], np.ndarray]:
    """Names, sizes, and 26 numbers of each photograph."""
    lines = read_legacy_text(path).split("\n")
    # The head ends at the first empty line.
    begin = lines.index("") + 1 if "" in lines else len(lines)
    rows = [(k + 1, line) for k, line in enumerate(lines) if k >= begin and line.strip()]
    each = len(_ROWS) + 1
    if not rows or len(rows) % each:
        raise InputError(f"{path.name} has {len(rows)} rows, not {each} a photograph: it ends early, or has fisheyes")
    names, sizes, numbers = [], [], []
    for first in range(0, len(rows), each):
        row, line = rows[first]
        words = line.rsplit(maxsplit=2)
        if len(words) != 3 or not all(word.isdigit() and len(word) < 9 for word in words[1:]):
            raise InputError(f"{path.name}, row {row}: {quoted(line)} is no name with width and height")
        names.append(words[0])
        sizes.append((int(words[1]), int(words[2])))
        below = zip(rows[first + 1 : first + each], _ROWS, strict=True)
        numbers.append([x for (k, line), n in below for x in row_numbers(path, k, line.split(), n)])
    return names, sizes, np.array(numbers)


def _camera(path: Path, values: list[float]) -> ProjectCamera:
    width, height, fx, skew, cx, _, fy, cy, *_, k1, k2, k3, p1, p2 = values
    if not (fx > 0 and fx == fy and skew == 0):
        raise InputError(f"{path.name}: K is not that of one focal length without skew. Export it again")
    source = CameraSource(path)
    sensor, _ = source.sensor(int(width), int(height))
    interior = in_pixels(source, sensor, fx, fy, (cx, cy), OPENCV, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    return ProjectCamera(sensor, interior, ("c_mm", "xp_mm", "yp_mm", *BROWN_TERMS))


FORMATS = (Format("pix4d", "folder params of Pix4D", find, read),)
