"""Pix4D's folder "params".

    NAME_calibrated_camera_parameters.txt   for each photograph: name width height; K; radial R1 R2 R3; tangential
                                            T1 T2; position t; rotation R
    NAME_tp_pix4d.txt                       for each photograph: name; rows of point x y size; -99
    NAME_offset.xyz                         offset to add to positions to obtain map coordinates

The projection is K (u, v, 1), where (u, v) are the first two components of R (X - t) divided by the third, with camera
axes x right, y down, z forward, and OpenCV's distortion k1, k2, k3 = R1, R2, R3 and p1, p2 = T1, T2. Pixel coordinates
are the same as ours. The files have no object points: they are intersected.

Sources: Pix4D support, articles 202977149 ("What does the Output Params Folder contain?") and 202559089 ("How are the
Internal and External Camera Parameters defined?").
"""

from pathlib import Path

import numpy as np

from jaxphoto.errors import InputError
from jaxphoto.extras.formats.files import Format, row_numbers
from jaxphoto.extras.formats.project import BROWN_TERMS, OPENCV, Project, ProjectCamera, in_pixels, pose
from jaxphoto.extras.formats.texts import points_of
from jaxphoto.io.camera_files import CameraSource
from jaxphoto.io.text_files import has_words, read_text

CAMERAS_FILE, POINTS_FILE, OFFSET_FILE = "calibrated_camera_parameters.txt", "tp_pix4d.txt", "offset.xyz"
_HEAD = "fileName imageWidth imageHeight"
# Number of values in each row below name and size: K, radial, tangential, t, R.
_ROWS = (3, 3, 3, 3, 2, 3, 3, 3, 3)


def find(source: Path) -> list[Path]:
    """Return the camera parameter files in a params folder or a project folder."""
    folders = (source, source / "params", source / "1_initial" / "params") if source.is_dir() else ()
    paths = [path for folder in folders for path in sorted(folder.glob(f"*{CAMERAS_FILE}"))] or [source]
    return [p for p in paths if p.is_file() and p.name.endswith(CAMERAS_FILE) and has_words(p, _HEAD)]


def read(path: Path) -> Project:
    """Read a project. Photographs with equal K and distortion share a camera with all parameters free."""
    name, lines = path.name.removesuffix(CAMERAS_FILE), read_text(path).split("\n")
    # The header ends at the first empty line.
    begin = lines.index("") + 1 if "" in lines else len(lines)
    rows = [(k + 1, line) for k, line in enumerate(lines) if k >= begin and line.strip()]
    each = len(_ROWS) + 1
    if not rows or len(rows) % each:
        raise InputError(
            f"{path.name}: {len(rows)} rows, not a multiple of {each} (rows per photograph); the file is truncated "
            "or has fisheye cameras. Re-export it for perspective cameras"
        )
    files, values = [], []
    for first in range(0, len(rows), each):
        row, line = rows[first]
        file, *size = line.rsplit(maxsplit=2)
        below = zip(rows[first + 1 : first + each], _ROWS, strict=True)
        files.append(file)
        values.append(
            row_numbers(path, row, size, 2)
            + [x for (k, line), n in below for x in row_numbers(path, k, line.split(), n)]
        )
    numbers = np.array(values)
    kinds, number = np.unique(numbers[:, :16], axis=0, return_inverse=True)
    shown = points_of(path.with_name(name + POINTS_FILE), files, path.name)
    offset, offset_path = [0.0] * 3, path.with_name(name + OFFSET_FILE)
    if offset_path.is_file():
        offset = row_numbers(offset_path, 1, read_text(offset_path).split(), 3)
    return Project(
        name.strip("_"), {str(k): _camera(path, kind.tolist()) for k, kind in enumerate(kinds)}, (), files,
        [str(k) for k in number.tolist()], pose(numbers[:, 19:].reshape(-1, 3, 3), numbers[:, 16:19] + offset),
        shown.points, None, shown.image, shown.point, shown.column_row, file=path.name,
    )  # fmt: skip


def _camera(path: Path, values: list[float]) -> ProjectCamera:
    width, height, fx, skew, cx, _, fy, cy, *_, k1, k2, k3, p1, p2 = values
    if fx != fy or skew != 0:
        raise InputError(f"{path.name}: K has two focal lengths or skew. Export it again")
    source = CameraSource(path)
    sensor, _ = source.sensor(width, height)
    interior = in_pixels(source, sensor, fx, fy, (cx, cy), OPENCV, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    return ProjectCamera(sensor, interior, ("c_mm", "xp_mm", "yp_mm", *BROWN_TERMS))


FORMATS = (Format("pix4d", "folder params of Pix4D", find, read),)
