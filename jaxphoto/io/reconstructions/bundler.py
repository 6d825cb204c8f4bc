"""bundle.out of Bundler, VisualSFM and Metashape -> the tables of a free network.

    # Bundle file v0.3
    cameras points
    f k1 k2, three rows of R, t                        of every camera; f = 0 where it is not oriented
    X Y Z, R G B, n (camera feature x y) ...           of every point

The camera sees P = R X + t along its -z, x right and y up; x and y are in pixels from the middle of the photograph.
Names of photographs are in list.txt beside it (OpenSfM writes list_r000.out beside bundle_r000.out).
The format of a photograph is not told: it is the smallest about its middle that holds its points.
Source: N. Snavely, Bundler v0.4 User's Manual, "Output format and scene representation".
"""

import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.arrays import on_device
from jaxphoto.camera import BundlerRadial, InteriorOrientation, Sensor
from jaxphoto.errors import InputError
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.cameras.camera_file import ASSUMED_PIXEL_MM
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, TiedPhotographs, free_network
from jaxphoto.io.text_tables import LARGEST
from jaxphoto.io.whole_text import LARGE, SMALL, read_text

HEAD = "# Bundle file v0.3"
_LISTS = ("list.txt", "bundle.out.list.txt")
_PER_CAMERA, _PER_POINT, _PER_MEASUREMENT = 15, 6, 4
# Of f: the least half format, so that few points about the middle leave one that can be; and no format is as large.
_LEAST_HALF, _LARGEST_HALF = 0.05, 1e6


class _Bundle(NamedTuple):
    cameras: Float[np.ndarray, "cameras 5 3"]
    xyz: Float[np.ndarray, "points 3"]
    point: Int[np.ndarray, "n"]
    measured: Float[np.ndarray, "n 4"]
    """Camera, feature, x and y."""


def recognises(source: Path) -> bool:
    """Whether `source` is such a file, or a folder that holds exactly one."""
    return len(_files(source)) == 1


def read_bundler(source: Path) -> BlockTables:
    """The free-network self-calibration of a bundle file, from its values: c_mm, k1 and k2 of every photograph.

    A pixel counts for a micrometre. Photographs that are not oriented are left out. Further as `free_network`.

    Raises InputError for numbers that are missing, none, or do not fit together.
    """
    found = [source] if source.is_file() else _files(source)
    if len(found) != 1:
        raise InputError(f"{source} holds {len(found)} bundle files; name one")
    path = found[0]
    bundle = _read(path)
    names, cameras = _names(path, len(bundle.cameras)), bundle.cameras
    oriented = np.flatnonzero(cameras[:, 0, 0] > 0)
    new = np.full(len(cameras), -1)
    new[oriented] = np.arange(len(oriented))
    number = bundle.measured[:, 0].astype(int)
    kept = new[number] >= 0
    image, xy = new[number[kept]], bundle.measured[kept, 2:]
    half = np.maximum(1.0, np.tile(_LEAST_HALF * cameras[oriented, 0, :1], 2))
    np.maximum.at(half, image, np.abs(xy))
    size = 2 * np.ceil(np.minimum(half, _LARGEST_HALF)).astype(int)
    turn, f, moved = cameras[oriented, 1:4], cameras[oriented, 0], cameras[oriented, 4]
    each = [names[k] for k in oriented.tolist()]
    return free_network(
        TiedPhotographs(
            path.name,
            "the program",
            path.resolve().parent.name,
            {str(k): _camera(*of) for k, of in enumerate(zip(size.tolist(), f.tolist(), strict=True))},
            each,
            [str(k) for k in range(len(each))],
            np.array([[1.0], [-1.0], [-1.0]]) * turn,
            -np.einsum("nji,nj->ni", turn, moved),
            [str(k) for k in range(len(bundle.xyz))],
            bundle.xyz,
            image,
            bundle.point[kept],
            size[image] / 2 + xy * [1.0, -1.0],
        )
    )


def _camera(size: list[int], values: list[float]) -> TiedCamera:
    f, k1, k2 = values
    interior = InteriorOrientation(f * ASSUMED_PIXEL_MM, 0.0, 0.0, BundlerRadial(k1, k2))
    return TiedCamera(
        Sensor(size[0], size[1], ASSUMED_PIXEL_MM, pixel_assumed=True),
        jax.tree.map(on_device, interior),
        ("c_mm", "k1", "k2"),
    )


def _files(source: Path) -> list[Path]:
    paths = sorted(source.glob("*.out")) if source.is_dir() else [source]
    return [path for path in paths if path.is_file() and _opens_so(path)]


def _opens_so(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(HEAD)) == HEAD.encode()


def _names(path: Path, number: int) -> list[str]:
    """Of the photographs: the first word of each row of list.txt, else their numbers."""
    own = path.stem.replace("bundle", "list", 1)
    for file in (path.with_name(name) for name in (f"{path.stem}.txt", f"{own}.txt", f"{own}.out", *_LISTS)):
        if file != path and file.is_file():
            names = [line.split()[0] for line in read_text(file, SMALL).split("\n") if line.strip()]
            if len(names) != number:
                raise InputError(
                    f"{file.name} names {len(names)} photographs and {path.name} has {number} cameras; give the list "
                    "of this file, or none"
                )
            return names
    warnings.warn(f"{path.name}: photographs have numbers, as no list.txt names them", UserWarning, stacklevel=3)
    return [str(k) for k in range(number)]


def _read(path: Path) -> _Bundle:
    lines = read_text(path, LARGE).split("\n")
    words = " ".join(line for line in lines if not line.startswith("#")).split()
    try:
        numbers = np.array(words, float)
    except ValueError:
        raise InputError(f"{path.name}: there is a word that is no number; export the file anew") from None
    if not (np.abs(numbers) <= LARGEST).all():
        raise InputError(f"{path.name}: there is a number that is none, or too large; export the file anew")
    n_cameras, n_points = _count(path, numbers, 0, "cameras"), _count(path, numbers, 1, "points")
    at = 2 + _PER_CAMERA * n_cameras
    if len(numbers) < at + (_PER_POINT + 1) * n_points:
        raise InputError(f"{path.name}: the file ends before its {n_cameras} cameras and {n_points} points do")
    cameras = numbers[2:at].reshape(n_cameras, 5, 3)
    xyz, many, rows = np.zeros((n_points, 3)), np.zeros(n_points, int), []
    for k in range(n_points):
        # Behind its coordinates and colours, so that these are there, too.
        many[k] = measurements = _count(path, numbers, at + _PER_POINT, f"measurements of point {k}")
        xyz[k] = numbers[at : at + 3]
        at += _PER_POINT + 1
        rows.append(at + np.arange(_PER_MEASUREMENT * measurements))
        at += _PER_MEASUREMENT * measurements
        if at > len(numbers):
            raise InputError(f"{path.name}: the file ends within point {k} of {n_points}; export it anew")
    measured = numbers[np.concatenate([np.zeros(0, int), *rows])].reshape(-1, _PER_MEASUREMENT)
    if not np.isin(measured[:, 0], np.arange(n_cameras)).all():
        raise InputError(f"{path.name}: a point is measured in a camera that is none of 0 to {n_cameras - 1}")
    return _Bundle(cameras, xyz, np.repeat(np.arange(n_points), many), measured)


def _count(path: Path, numbers: np.ndarray, at: int, what: str) -> int:
    value = numbers[at] if at < len(numbers) else np.nan
    if not 0 <= value <= len(numbers) or value != int(value):
        raise InputError(f"{path.name}: the number of {what} is {value:g}, which cannot be; export the file anew")
    return int(value)
