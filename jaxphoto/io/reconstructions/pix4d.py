"""The folder "params" of Pix4D -> the tables of a free network.

    NAME_calibrated_camera_parameters.txt   of every photograph: name width height; K; radial R1 R2 R3; tangential
                                            T1 T2; position t; rotation R
    NAME_tp_pix4d.txt                       of every photograph its name, then rows of point x y size, then -99
    NAME_offset.xyz                         what is added to positions to be in the map's system

A point is seen at K (u, v, 1), where (u, v) are the first two of R (X - t) over the third, x right, y down, z ahead,
with distortion added as OpenCV has it: k1, k2, k3 are R1, R2, R3, and p1, p2 are T1, T2. x and y are in pixels of the
photograph as it was taken; the corner of the upper left one is (0, 0). Positions of points are in none of these files:
rays tell them.
Sources: Pix4D support, articles 202977149 ("What does the Output Params Folder contain?") and 202559089 ("How are the
Internal and External Camera Parameters defined?").
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.cameras.camera_file import CameraSource, in_pixels
from jaxphoto.io.cameras.open_cv import PLANE
from jaxphoto.io.reconstructions.numbers import row_numbers
from jaxphoto.io.reconstructions.points_beside import points_of
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, TiedPhotographs, free_network
from jaxphoto.io.whole_text import LARGE, SMALL, read_text

CAMERAS, POINTS, OFFSET = "calibrated_camera_parameters.txt", "tp_pix4d.txt", "offset.xyz"
_HEAD = "fileName imageWidth imageHeight"
# Rows of a photograph below its name and size, as numbers in each: K, radial, tangential, t, R.
_ROWS = (3, 3, 3, 3, 2, 3, 3, 3, 3)
_FREE = ("c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2")


class _Photographs(NamedTuple):
    names: list[str]
    sizes: list[tuple[int, int]]
    numbers: Float[np.ndarray, "images 26"]


def recognises(source: Path) -> bool:
    """Whether `source` is such a folder, the project above it, or its file of cameras."""
    return len(_files(source)) == 1


def read_pix4d(source: Path) -> BlockTables:
    """The free-network self-calibration of a Pix4D project, from its values.

    Photographs whose K and distortion are the same have one camera, which is free in c_mm, xp_mm, yp_mm, k1, k2, k3,
    p1, p2. A pixel counts for a micrometre. Points have Pix4D's names. Further as `free_network`.

    Raises InputError for files that are damaged or do not fit together, and for fisheyes, whose files are others.
    """
    found = _files(source)
    if len(found) != 1:
        raise InputError(f"{source} holds {len(found)} files {CAMERAS}; name one")
    path = found[0]
    given = _read_cameras(path)
    radial_on, turn = given.numbers[:, :14], given.numbers[:, 17:].reshape(-1, 3, 3)
    kinds, number = np.unique(np.column_stack([given.sizes, radial_on]), axis=0, return_inverse=True)
    cameras = {str(k): _camera(path, values.tolist()) for k, values in enumerate(kinds)}
    tied = path.with_name(path.name.removesuffix(CAMERAS) + POINTS)
    shown = points_of(tied, given.names, path.name)
    return free_network(
        TiedPhotographs(
            path.name,
            "Pix4D",
            path.name.removesuffix(CAMERAS).strip("_"),
            cameras,
            given.names,
            [str(k) for k in number.tolist()],
            turn,
            given.numbers[:, 14:17] + _offset(path.with_name(path.name.removesuffix(CAMERAS) + OFFSET)),
            shown.points,
            None,
            shown.image,
            shown.point,
            shown.column_row,
        )
    )


def _files(source: Path) -> list[Path]:
    if source.is_file():
        return [source] if source.name.endswith(CAMERAS) and _opens_so(source) else []
    folders = (source, source / "params", source / "1_initial" / "params")
    return [path for folder in folders for path in sorted(folder.glob(f"*{CAMERAS}")) if _opens_so(path)]


def _opens_so(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_HEAD)) == _HEAD.encode()


def _read_cameras(path: Path) -> _Photographs:
    lines = read_text(path, LARGE).split("\n")
    # What the rows mean stands above the first empty one.
    begins = lines.index("") + 1 if "" in lines else len(lines)
    rows = [(k + 1, line) for k, line in enumerate(lines) if k >= begins and line.strip()]
    each = len(_ROWS) + 1
    if not rows or len(rows) % each:
        raise InputError(
            f"{path.name} has {len(rows)} rows of photographs, which are not {each} each: it ends early, or its "
            "cameras are fisheyes, which are not read"
        )
    names, sizes, numbers = [], [], []
    for first in range(0, len(rows), each):
        number, line = rows[first]
        words = line.rsplit(maxsplit=2)
        if len(words) != 3 or not all(word.isdigit() and len(word) < 9 for word in words[1:]):
            raise InputError(f"{path.name}, row {number}: {quoted(line)} is no name with width and height")
        names.append(words[0])
        sizes.append((int(words[1]), int(words[2])))
        own = rows[first + 1 : first + each]
        numbers.append(
            [x for (k, line), n in zip(own, _ROWS, strict=True) for x in row_numbers(path, k, line.split(), n)]
        )
    return _Photographs(names, sizes, np.array(numbers))


def _camera(path: Path, values: list[float]) -> TiedCamera:
    width, height, fx, skew, cx, _, fy, cy, *_, k1, k2, k3, p1, p2 = values
    if not (fx > 0 and fx == fy and skew == 0):
        raise InputError(f"{path.name}: K is not that of one focal length without skew; export the file anew")
    source = CameraSource(path)
    sensor, _ = source.sensor(int(width), int(height))
    interior = in_pixels(source, sensor, fx, fy, (cx, cy), PLANE, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    return TiedCamera(sensor, interior, _FREE)


def _offset(path: Path) -> Float[np.ndarray, "3"]:
    if not path.is_file():
        return np.zeros(3)
    return np.array(row_numbers(path, 1, read_text(path, SMALL).split(), 3))
