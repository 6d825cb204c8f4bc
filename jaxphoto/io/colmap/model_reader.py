"""A COLMAP model -> the tables of a block folder: a free network with approximate values, ready to be calibrated.

COLMAP's camera looks along +z, with x right and y down: x_camera = R x_world + t, and the projection centre is -R't.
Pixels are counted as ours (centre of the upper left one at (0.5, 0.5)).
"""

from pathlib import Path

import numpy as np
import scipy

from jaxphoto.errors import InputError
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.cameras.camera_file import CameraSource
from jaxphoto.io.cameras.colmap import TEXT, ColmapCamera, sensor_and_interior
from jaxphoto.io.colmap.model import read_model
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, TiedPhotographs, free_network

_PLACES = ("f", "fx", "fy", "cx", "cy")


def read_colmap_model(folder: Path) -> BlockTables:
    """The free-network self-calibration of a COLMAP model, from its values.

    Cameras have the distortion `opencv` and are free in what COLMAP's model has: c_mm, xp_mm, yp_mm, its coefficients,
    and b1 where it has two focal lengths. A pixel counts for a micrometre, so that c in micrometres is the focal length
    in pixels. A point has COLMAP's number as id. Further as `free_network`.

    Raises InputError for files that are damaged or do not fit together, and for models of cameras that are not known
    here.
    """
    model = read_model(folder)
    images = model.images
    ids = np.sort(model.point_ids)
    point = np.concatenate([np.zeros(0, int), *(i.point for i in images)])
    if len(missing := np.setdiff1d(point, ids)):
        raise InputError(
            f"{folder}: the images show {len(missing)} point(s) that points3D has not, for example {missing[0]}; "
            "let COLMAP write the model again"
        )
    name = folder.resolve().name
    quaternions = np.array([i.quaternion for i in images]).reshape(-1, 4)
    rotations = (
        scipy.spatial.transform.Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
        if images
        else np.zeros((0, 3, 3))
    )
    return free_network(
        TiedPhotographs(
            name,
            "COLMAP",
            name,
            {str(k): _camera(folder, model.cameras[k]) for k in sorted({i.camera for i in images})},
            [i.name for i in images],
            [str(i.camera) for i in images],
            rotations,
            -np.einsum("nji,nj->ni", rotations, np.array([i.translation for i in images]).reshape(-1, 3)),
            ids.astype(str).tolist(),
            model.xyz[np.argsort(model.point_ids)],
            np.repeat(np.arange(len(images)), [len(i.point) for i in images]),
            np.searchsorted(ids, point),
            np.concatenate([np.zeros((0, 2)), *(i.xy_px for i in images)]),
        )
    )


def _camera(folder: Path, camera: ColmapCamera) -> TiedCamera:
    sensor, interior, _ = sensor_and_interior(CameraSource(folder / TEXT), camera)
    free = ["c_mm", "xp_mm", "yp_mm", *(k for k in camera.named if k not in _PLACES)]
    return TiedCamera(sensor, interior, (*free, "b1") if "fx" in camera.named else tuple(free))
