"""A COLMAP model -> the tables of a block folder: a free network with approximate values, ready to be calibrated.

COLMAP's camera looks along +z, with x right and y down: x_camera = R x_world + t. Ours has y up and looks along -z, so
`camera_from_object` = diag(1, -1, -1) R, and the projection centre is -R't. Pixels are counted as ours (centre of the
upper left one at (0.5, 0.5)). The unit of the model is taken for the metre; its scale, place and turn are arbitrary.
"""

import warnings
from pathlib import Path, PurePosixPath
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from jaxphoto.camera import set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from jaxphoto.io.cameras.camera_file import CameraSource
from jaxphoto.io.cameras.colmap import TEXT, ColmapCamera, sensor_and_interior
from jaxphoto.io.colmap.model import ColmapImage, ColmapModel, read_model
from jaxphoto.io.text_tables import Table
from jaxphoto.unknowns import FIXED, FREE

# Rows by which a rotation into COLMAP's camera frame becomes one into ours.
_CAMERA_TURN = np.array([[1.0], [-1.0], [-1.0]])
_PLACES = ("f", "fx", "fy", "cx", "cy")
_PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".jp2", ".ppm", ".pgm", ".dng")


def read_colmap_model(folder: Path) -> BlockTables:
    """The free-network self-calibration of a COLMAP model, from its values.

    Cameras have the distortion `opencv` and are free in what COLMAP's model has: c_mm, xp_mm, yp_mm, its coefficients,
    and b1 where it has two focal lengths. A pixel counts for a micrometre, so that c in micrometres is the focal length
    in pixels. An image has its file's name without the ending as id, a point COLMAP's number. Every coordinate has the
    standard deviation of one pixel. The datum is inner over the points.

    A UserWarning counts what is left out: measurements that a model has twice (of one feature that has two directions,
    or of two features in one image that are one point), and points that are then in fewer than two images. Raises
    InputError for files that are damaged or do not fit together, and for models of cameras that are not known here.
    """
    model = read_model(folder)
    if not model.images:
        raise InputError(f"{folder}: no image of the model is oriented; give one that has images")
    names = np.array(_image_names(model.images), object)
    image, point, xy = _measurements(model)
    centres, angles = _orientations(model.images)
    used = sorted({of.camera for of in model.images})
    seen = np.isin(model.point_ids, point)
    name = folder.resolve().name
    tables = {
        "images": {"image": names, "camera": np.array([str(i.camera) for i in model.images], object)}
        | dict(zip((*XYZ, *ANGLES), np.column_stack([centres, np.rad2deg(angles)]).T, strict=True)),
        "image_points": {"image": names[image], "point": _text(point), "column_px": xy[:, 0], "row_px": xy[:, 1]},
        "object_points": {"point": _text(model.point_ids[seen])} | dict(zip(XYZ, model.xyz[seen].T, strict=True)),
    }
    files = {"images": "images", "image_points": "images", "object_points": "points3D"}
    settings = {
        "title": name,
        "sigmas": {"image_px": 1.0},
        "cameras": {str(number): _camera(folder, model.cameras[number]) for number in used},
        "datum": {"kind": "inner", "over": "points"},
    }
    return BlockTables(
        settings, {key: Table.of(f"{name}/{files[key]}", columns) for key, columns in tables.items()}, name
    )


def _image_names(images: list[ColmapImage]) -> list[str]:
    """Names of the files without the endings of photographs, with them where two would be the same."""
    paths = [PurePosixPath(image.name) for image in images]
    short = [str(path.with_suffix("")) if path.suffix.lower() in _PHOTOGRAPHS else str(path) for path in paths]
    return short if len(set(short)) == len(short) else [image.name for image in images]


def _measurements(model: ColmapModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, id of the point and pixels of every measurement; none twice, each point in two images at least."""
    image = np.repeat(np.arange(len(model.images)), [len(i.point) for i in model.images])
    point = np.concatenate([i.point for i in model.images])
    xy = np.concatenate([i.xy_px for i in model.images])
    if len(missing := np.setdiff1d(point, model.point_ids)):
        raise InputError(
            f"{model.folder}: the images show {len(missing)} point(s) that points3D has not, for example {missing[0]}; "
            "let COLMAP write the model again"
        )
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
            f"{model.folder}: {n_all - n_once} measurement(s) that are there twice are not used, nor are "
            f"{int((times < 2).sum())} point(s) that fewer than two images show",
            UserWarning,
            stacklevel=4,
        )
    return image[several], point[several], xy[several]


def _orientations(images: list[ColmapImage]) -> tuple[np.ndarray, np.ndarray]:
    """Projection centres and omega, phi, kappa in radians, both (n, 3)."""
    quaternions = np.array([i.quaternion for i in images])
    rotation = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    centres = -np.einsum("nji,nj->ni", rotation, np.array([i.translation for i in images]))
    return centres, np.asarray(ExteriorOrientation(centres, _CAMERA_TURN * rotation).omega_phi_kappa)


def _camera(folder: Path, camera: ColmapCamera) -> dict[str, Any]:
    """The table [cameras.X]."""
    sensor, interior, _ = sensor_and_interior(CameraSource(folder / TEXT), camera)
    free = ["c_mm", "xp_mm", "yp_mm", *(k for k in camera.named if k not in _PLACES)]
    free += ["b1"] if "fx" in camera.named else []
    priors = jax.tree.map(lambda _: FIXED, interior)
    for name in free:
        priors = set_parameter(priors, name, FREE)
    return camera_section(Camera(sensor, interior, priors))


def _text(ids: np.ndarray) -> np.ndarray:
    return ids.astype(str).astype(object)
