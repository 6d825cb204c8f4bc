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

from jaxphoto.block import Frame
from jaxphoto.camera import InteriorOrientation, Sensor, get_parameter, parameter_names, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.block_folder.settings import frame_section
from jaxphoto.io.block_folder.table_layout import ANGLES, SIGMA_XYZ, coordinate_names
from jaxphoto.io.text_tables import Table
from jaxphoto.procedures.control.surveyed import SIGMA_M, SurveyedPoints
from jaxphoto.unknowns import FIXED, FREE

# Rows by which a rotation into a camera frame of computer vision becomes one into ours.
_CAMERA_TURN = np.array([[1.0], [-1.0], [-1.0]])
_PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".jp2", ".ppm", ".pgm", ".dng")
# R R' of numbers with few digits is off from I by no more.
_NO_ROTATION = 1e-3
# An orientation needs so many points, and the place of a block so many control points.
_LEAST = 3


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
    frame: Frame = Frame("local")
    """Of `centres` and of what `rotations` are against: grid east, grid north and up at the place of each."""
    control: SurveyedPoints | None = None
    """In coordinates of `frame`, easting or longitude first."""
    sigma_px: Float[np.ndarray, "n"] | None = None
    """Of measurements; NaN, or None for all, where nothing tells it: one pixel then."""


def estimated(interior: InteriorOrientation) -> tuple[str, ...]:
    """What a program that does not say so may have estimated: c_mm, xp_mm, yp_mm and every coefficient that is not
    zero."""
    first = ("c_mm", "xp_mm", "yp_mm")
    return tuple(n for n in parameter_names(interior) if n in first or float(get_parameter(interior, n)) != 0)


def free_network(given: TiedPhotographs) -> BlockTables:
    """The free-network self-calibration of tied photographs, from the values they have.

    An image has its file's name without the ending as id. Image coordinates have the standard deviation of one pixel
    where none is given. The datum is inner over the points, or that of the control where three points of it are given
    whole. A UserWarning counts what is left out: measurements that are there twice (of one feature with two directions,
    or of two features in one image that are one point), points that are then in fewer than two images, and images that
    then show fewer than three.

    Raises InputError where no photograph is oriented, two have one name, a rotation is none, or none is tied.
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
    control = _control_table(given)
    image, point, column_row, sigma = _measurements(given, place[given.image], control)
    kept = np.flatnonzero(np.bincount(image, minlength=len(names)))
    _check_tied(given, names, kept)
    order, names, image = order[kept], names[kept], np.searchsorted(kept, image)
    seen, point_of = np.unique(point, return_inverse=True)
    ids = np.array(given.points, object)[seen]
    exterior = ExteriorOrientation(given.centres[order], _CAMERA_TURN * given.rotations[order])  # type: ignore[arg-type]
    angles = np.rad2deg(np.asarray(exterior.omega_phi_kappa))
    camera = np.array(given.camera_of, object)[order]
    coordinates = coordinate_names(given.frame)
    tables = {
        "images": {"image": names, "camera": camera}
        | dict(zip((*coordinates, *ANGLES), np.column_stack([given.centres[order], angles]).T, strict=True)),
        "image_points": {
            "image": names[image],
            "point": ids[point_of],
            "column_px": column_row[:, 0],
            "row_px": column_row[:, 1],
        },
    }
    if np.isfinite(sigma).any():
        tables["image_points"]["sigma_px"] = _cells(sigma)
    if given.xyz is not None:
        tables["object_points"] = {"point": ids} | dict(zip(coordinates, given.xyz[seen].T, strict=True))
    settings: dict[str, Any] = {"title": given.title, "sigmas": {"image_px": 1.0}}
    if given.frame.kind == "epsg":
        settings["frame"] = frame_section(given.frame)
    if control is None:
        settings["datum"] = {"kind": "inner", "over": "points"}
    else:
        tables["control_points"] = control
        settings["sigmas"] |= dict(zip(("control_X_m", "control_Y_m", "control_Z_m"), SIGMA_M, strict=True))
    used = set(camera)
    settings["cameras"] = {name: _section(own) for name, own in given.cameras.items() if name in used}
    return BlockTables(settings, {key: Table.of(given.file, values) for key, values in tables.items()}, given.file)


def _control_table(given: TiedPhotographs) -> dict[str, np.ndarray] | None:
    """control_points.csv: the points that images show. None where they do not hold the block."""
    survey = given.control
    if survey is None:
        return None
    shown = {given.points[k] for k in np.unique(given.point)}
    there = [k for k, name in enumerate(survey.ids) if name in shown]
    holds = [k for k in there if not survey.check[k] and np.isfinite(survey.coordinates[k]).all()]
    if len(holds) < _LEAST:
        warnings.warn(
            f"{given.file}: images show {len(holds)} control point(s) with all coordinates, and a block needs "
            f"{_LEAST}; none is used",
            UserWarning,
            stacklevel=4,
        )
        return None
    numbers = np.column_stack([survey.coordinates[there], survey.sigma_m[there]])
    columns = dict(zip((*coordinate_names(given.frame), *SIGMA_XYZ), map(_cells, numbers.T), strict=True))
    role = np.where(survey.check[there], "check", "control").astype(object)
    return {"point": np.array([survey.ids[k] for k in there], object), **columns, "role": role}


def _cells(values: Float[np.ndarray, "n"]) -> np.ndarray:
    """Numbers as cells of a table, empty for NaN."""
    return np.array(["" if np.isnan(v) else repr(v) for v in values.tolist()], object)


def _check_tied(given: TiedPhotographs, names: np.ndarray, kept: np.ndarray) -> None:
    """Raise InputError where no image is tied to others; a UserWarning names those that are not."""
    if not len(kept):
        raise InputError(
            f"{given.file}: no image shows {_LEAST} points that others show, too; export the tie points of the project"
        )
    left = np.delete(names, kept)
    if len(left):
        told = few([quoted(name) for name in left.tolist()])
        warnings.warn(
            f"{given.file}: {len(left)} image(s) with fewer than {_LEAST} points are left out: {told}",
            UserWarning,
            stacklevel=4,
        )


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


def _measurements(
    given: TiedPhotographs, image: np.ndarray, control: dict[str, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Image, point, pixels and their sigma of every measurement; none twice, each point in two images at least or
    control, each image with three at least."""
    point, xy = given.point, given.column_row
    sigma = np.full(len(point), np.nan) if given.sigma_px is None else given.sigma_px
    n_all = len(point)
    # The same feature, by the point with the smaller number; then the same image, by the feature that comes first.
    order = np.lexsort((point, image))
    image, point, xy, sigma = image[order], point[order], xy[order], sigma[order]
    for key in ("xy", "point"):
        columns = np.column_stack([image, xy if key == "xy" else point])
        kept = np.sort(np.unique(columns, axis=0, return_index=True)[1])
        image, point, xy, sigma = image[kept], point[kept], xy[kept], sigma[kept]
    n_once, n_points = len(point), len(np.unique(point))
    own = set() if control is None else set(control["point"][control["role"] == "control"])
    held = np.array([name in own for name in given.points], bool)
    while True:
        tied = (np.bincount(point, minlength=len(held))[point] >= 2) | held[point]
        tied &= np.bincount(image[tied], minlength=len(given.files))[image] >= _LEAST
        if tied.all():
            break
        image, point, xy, sigma = image[tied], point[tied], xy[tied], sigma[tied]
    n_left = n_points - len(np.unique(point))
    if n_once < n_all or n_left:
        warnings.warn(
            f"{given.file}: {n_all - n_once} measurement(s) that are there twice are not used, nor are "
            f"{n_left} point(s) that fewer than two images show",
            UserWarning,
            stacklevel=4,
        )
    return image, point, xy, sigma
