"""Photographs that another program has oriented, with their tie points -> the tables of a free network.

Cameras of computer vision look along +z, with x right and y down: x_camera = R (x_world - centre). Ours has y up and
looks along -z, so `camera_from_object` = diag(1, -1, -1) R. The unit of the world is taken for the metre; its scale,
place and turn are arbitrary where nothing else is said.
"""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.camera import InteriorOrientation, Sensor, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from jaxphoto.io.text_tables import Table
from jaxphoto.unknowns import FIXED, FREE

# Rows by which a rotation into a camera frame of computer vision becomes one into ours.
_CAMERA_TURN = np.array([[1.0], [-1.0], [-1.0]])
_PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".jp2", ".ppm", ".pgm", ".dng")
# R R' of numbers with few digits is off from I by no more.
_NO_ROTATION = 1e-3


class TiedCamera(NamedTuple):
    """A camera, and which of its parameters the network is to estimate."""

    sensor: Sensor
    interior: InteriorOrientation
    free: tuple[str, ...]


class TiedPhotographs(NamedTuple):
    """What a file of another program says; indices count from 0."""

    file: str
    """For messages, as is `program`."""
    program: str
    title: str
    cameras: Mapping[str, TiedCamera]
    files: Sequence[str]
    """Of the photographs, in any order."""
    camera_of: Sequence[str]
    rotations: Float[np.ndarray, "images 3 3"]
    """World to camera: x right, y down, z ahead."""
    centres: Float[np.ndarray, "images 3"]
    points: Sequence[str]
    xyz: Float[np.ndarray, "points 3"] | None
    """None where the file has none, and rays tell it."""
    image: Int[np.ndarray, "n"]
    point: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    """In pixels; the centre of the upper left one is (0.5, 0.5)."""


def free_network(given: TiedPhotographs) -> BlockTables:
    """The free-network self-calibration of tied photographs, from the values they have.

    An image has its file's name without the ending as id. Every image coordinate has the standard deviation of one
    pixel. The datum is inner over the points. A UserWarning counts what is left out: measurements that are there twice
    (of one feature with two directions, or of two features in one image that are one point), and points that are then
    in fewer than two images.

    Raises InputError where no photograph is oriented, two have one name, or a rotation is none.
    """
    if not len(given.files):
        raise InputError(f"{given.file}: no image is oriented; give one that has images")
    _check_rotations(given)
    order = np.argsort(np.array(given.files, object), kind="stable")
    place = np.argsort(order)
    names = np.array(_image_names([given.files[k] for k in order]), object)
    if len(set(names)) < len(names):
        twice = next(name for name in names if list(names).count(name) > 1)
        raise InputError(f"{given.file}: image {twice} is there twice; keep one of them")
    image, point, column_row = _measurements(given, place[given.image])
    seen, point_of = np.unique(point, return_inverse=True)
    ids = np.array(given.points, object)[seen]
    exterior = ExteriorOrientation(given.centres[order], _CAMERA_TURN * given.rotations[order])  # type: ignore[arg-type]
    angles = np.rad2deg(np.asarray(exterior.omega_phi_kappa))
    camera = np.array(given.camera_of, object)[order]
    tables = {
        "images": {"image": names, "camera": camera}
        | dict(zip((*XYZ, *ANGLES), np.column_stack([given.centres[order], angles]).T, strict=True)),
        "image_points": {
            "image": names[image],
            "point": ids[point_of],
            "column_px": column_row[:, 0],
            "row_px": column_row[:, 1],
        },
    }
    if given.xyz is not None:
        tables["object_points"] = {"point": ids} | dict(zip(XYZ, given.xyz[seen].T, strict=True))
    used = set(given.camera_of)
    settings = {
        "title": given.title,
        "sigmas": {"image_px": 1.0},
        "cameras": {name: _section(own) for name, own in given.cameras.items() if name in used},
        "datum": {"kind": "inner", "over": "points"},
    }
    return BlockTables(settings, {key: Table.of(given.file, values) for key, values in tables.items()}, given.file)


def _section(camera: TiedCamera) -> dict[str, Any]:
    """The table [cameras.X]."""
    priors = jax.tree.map(lambda _: FIXED, camera.interior)
    for name in camera.free:
        priors = set_parameter(priors, name, FREE)
    return camera_section(Camera(camera.sensor, camera.interior, priors))


def _check_rotations(given: TiedPhotographs) -> None:
    r = given.rotations
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.einsum("nij,nkj->nik", r, r) - np.eye(3)).max(axis=(1, 2))
        bad = ~(off < _NO_ROTATION) | ~(np.linalg.det(np.where(off[:, None, None] < 1, r, 0.0)) > 0)
    for k in np.flatnonzero(bad).tolist():
        raise InputError(
            f"{given.file}: the matrix of image {given.files[k]} is no rotation (its rows are not at right angles, of "
            f"length 1 and right-handed); let {given.program} write the file again"
        )


def _image_names(files: list[str]) -> list[str]:
    """Names of the files without the endings of photographs, with them where two would be the same.

    Folders of somebody's disk are left out.
    """
    paths = [PurePosixPath(PureWindowsPath(file).as_posix()) for file in files]
    if any(path.is_absolute() or PureWindowsPath(str(path)).is_absolute() for path in paths):
        paths = [PurePosixPath(path.name) for path in paths]
    short = [str(path.with_suffix("")) if path.suffix.lower() in _PHOTOGRAPHS else str(path) for path in paths]
    return short if len(set(short)) == len(short) else [str(path) for path in paths]


def _measurements(given: TiedPhotographs, image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, point and pixels of every measurement; none twice, each point in two images at least."""
    point, xy = given.point, given.column_row
    n_all = len(point)
    # The same feature, by the point with the smaller number; then the same image, by the feature that comes first.
    order = np.lexsort((point, image))
    image, point, xy = image[order], point[order], xy[order]
    for key in ("xy", "point"):
        columns = np.column_stack([image, xy if key == "xy" else point])
        kept = np.sort(np.unique(columns, axis=0, return_index=True)[1])
        image, point, xy = image[kept], point[kept], xy[kept]
    n_once = len(point)
    _, of_id, times = np.unique(point, return_inverse=True, return_counts=True)
    several = times[of_id] >= 2
    if n_once < n_all or not several.all():
        warnings.warn(
            f"{given.file}: {n_all - n_once} measurement(s) that are there twice are not used, nor are "
            f"{int((times < 2).sum())} point(s) that fewer than two images show",
            UserWarning,
            stacklevel=4,
        )
    return image[several], point[several], xy[several]
