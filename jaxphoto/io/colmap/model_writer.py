"""A block -> a COLMAP model as text: cameras.txt, images.txt and points3D.txt, from its start values or others.

Coordinates, rotations and image points come back exactly to rounding, and so does a camera that is a part of OpenCV's;
another one is fitted (`camera.conversion`), and by how much it then misses is told. COLMAP knows no observations but
image points: standard deviations, control, stations and what is free stay behind.
"""

import warnings
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxphoto.arrays import still
from jaxphoto.block import Block
from jaxphoto.camera import Perspective
from jaxphoto.camera.conversion import Conversion, converted
from jaxphoto.errors import InputError
from jaxphoto.io.cameras.colmap import FISHEYE, PLANE, cameras_text, colmap_camera
from jaxphoto.io.colmap.model import FILES
from jaxphoto.io.colmap.model_reader import CAMERA_TURN
from jaxphoto.procedures.adjust import start_of
from jaxphoto.unknowns import Unknowns
from jaxphoto.writing import check_folder, whole_folder

_IMAGES = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
_POINTS = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"


def write_colmap_model(block: Block, folder: str | Path, unknowns: Unknowns | None = None) -> dict[str, Conversion]:
    """Write images, points and image points of `block` as a COLMAP model; returns the conversion of every camera.

    The values are those of `unknowns` (of an `Adjustment`), else the start values of the block, completed as for an
    adjustment; in its own Cartesian frame. An image has its id as name; ids of cameras and points that are numbers
    stay, others are counted from 1. Warns (UserWarning) of refraction and earth curvature, which COLMAP does not know.

    Raises InputError where `folder` holds something else than such a model that jaxphoto wrote and for a camera that
    cannot be fitted, BlockError where no start values can be found.
    """
    folder = Path(folder)
    check_model_target(folder)
    values = start_of(block) if unknowns is None else unknowns
    cameras = _conversions(block, values)
    if block.corrections.refraction or block.corrections.curvature:
        warnings.warn("COLMAP knows no refraction or earth curvature: its points will not fit by them", stacklevel=2)
    camera_ids, point_ids = _ids(tuple(cameras)), np.array(list(_ids(block.points).values()), int)
    written = {camera_ids[k]: colmap_camera(block.sensors[k], c.interior) for k, c in cameras.items()}
    images, tracks = _images_text(block, values, point_ids, camera_ids)
    texts = (cameras_text(written), images, _points_text(still(values.points), point_ids, tracks))
    with whole_folder(folder, _all_clash) as work:
        for name, text in zip(FILES, texts, strict=True):
            (work / f"{name}.txt").write_text(text, encoding="utf-8")
    return cameras


def check_model_target(folder: Path, *inputs: Path) -> None:
    """Raise InputError where no model can be written (`check_folder`), or anything else lies in the folder."""
    check_folder(folder, *inputs, clashes=_all_clash)


def _all_clash(name: str) -> bool:
    # COLMAP reads what it finds: binary files before text, rigs and frames of another model.
    return True


def _conversions(block: Block, unknowns: Unknowns) -> dict[str, Conversion]:
    """Every camera that took an image, as one that COLMAP has."""
    found = {}
    for name in dict.fromkeys(block.image_camera):
        try:
            interior = unknowns.interior[name]
            model = PLANE if type(interior.projection) is Perspective else FISHEYE
            found[name] = converted(interior, model.distortion, block.sensors[name], model.lacks, model.projection)
        except ValueError as error:
            raise InputError(f"camera {name} cannot be written for COLMAP: {error}") from None
    return found


def _ids(names: tuple[str, ...]) -> dict[str, int]:
    """The names as numbers where all are positive ones, otherwise counted from 1."""
    own = [int(name) if name.isascii() and name.isdigit() else 0 for name in names]
    kept = min(own, default=1) > 0 and len(set(own)) == len(own) and max(own, default=1) < 2**31
    return dict(zip(names, own if kept else range(1, len(names) + 1), strict=True))


def _images_text(
    block: Block, unknowns: Unknowns, point_ids: np.ndarray, camera_ids: dict[str, int]
) -> tuple[str, list[list[str]]]:
    """images.txt, and of every point the images and features in which it is seen."""
    rotations = CAMERA_TURN * still(unknowns.exterior.camera_from_object)
    translations = -np.einsum("nij,nj->ni", rotations, still(unknowns.exterior.position))
    quaternions = Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]]
    rows = block.image_points
    order = np.argsort(rows.image, kind="stable")
    of_image = np.split(order, np.cumsum(np.bincount(rows.image, minlength=len(block.images)))[:-1])
    tracks: list[list[str]] = [[] for _ in block.points]
    lines = []
    for i, (name, camera, own) in enumerate(zip(block.images, block.image_camera, of_image, strict=True)):
        pose = " ".join(map(repr, [*quaternions[i].tolist(), *translations[i].tolist()]))
        lines.append(f"{i + 1} {pose} {camera_ids[camera]} {name}")
        xy, point = block.sensors[camera].px_from_mm(still(rows.xy)[own]), rows.point[own]
        triples = zip(xy.tolist(), point_ids[point].tolist(), strict=True)
        lines.append(" ".join(f"{column!r} {row!r} {identifier}" for (column, row), identifier in triples))
        for feature, p in enumerate(point.tolist()):
            tracks[p].append(f"{i + 1} {feature}")
    return _IMAGES + "\n".join(lines) + "\n", tracks


def _points_text(xyz: np.ndarray, ids: np.ndarray, tracks: list[list[str]]) -> str:
    """points3D.txt; colour and error, which nobody knows here, are 0 and -1."""
    rows = zip(ids.tolist(), xyz.tolist(), tracks, strict=True)
    lines = (" ".join([str(i), *map(repr, at), "0 0 0 -1", *track]) for i, at, track in rows if track)
    return _POINTS + "".join(line + "\n" for line in lines)
