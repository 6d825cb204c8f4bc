"""A folder of texts -> the tables of a block: exterior orientations, image points, and a camera file.

Orientations as `exterior_text`, image points as `points_beside`, the camera as `jaxphoto.io.cameras` reads it.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError, few
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.cameras import read_camera_file
from jaxphoto.io.reconstructions import orthority, pix4d
from jaxphoto.io.reconstructions.exterior_text import ExteriorText, is_exterior, read_exterior
from jaxphoto.io.reconstructions.points_beside import (
    PhotographCamera,
    Shown,
    measured_texts,
    network_beside,
    points_beside,
)
from jaxphoto.io.reconstructions.rays import ray_misfit
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, estimated

_EXTERIORS = (".txt", ".csv", ".dat", ".ori", ".eo", ".opk", ".pat", ".out", "")
_CAMERAS = (".toml", ".xml", ".yml", ".yaml", ".json", ".cameramodel")
# Numbers are read otherwise where that lets rays miss by so many times less.
_WORSE = 3.0


def recognises(source: Path) -> bool:
    """Whether `source` is a text of orientations, or a folder with exactly one and image points beside it."""
    if source.is_file():
        return source.suffix.lower() in _EXTERIORS and is_exterior(source)
    found = _exteriors(source)
    # The folders of these have such texts, and more.
    others = pix4d.recognises(source) or orthority.recognises(source) or (source / TOML).is_file()
    return len(found) == 1 and bool(measured_texts(found[0])) and not others


def read_text_project(source: Path) -> BlockTables:
    """The block of a folder of texts, from the values in them; a file names the orientations of its folder.

    The camera is free in c_mm, xp_mm, yp_mm and the coefficients that are not zero. Further as `free_network`.

    Raises InputError for files that are damaged, missing or too many, and for a system that is not known.
    """
    found = [source] if source.is_file() else _exteriors(source)
    if len(found) != 1:
        told = f" ({few([path.name for path in found])})" if found else ""
        raise InputError(f"{source} holds {len(found)} texts of orientations{told}; name one")
    path = found[0]
    given = read_exterior(path)
    camera = _camera(path)
    shown = points_beside(path, given.names, [PhotographCamera(*camera[:2])] * len(given.names))
    if not len(shown.image):
        raise InputError(
            f"{path.parent} has no image points for the orientations in {path.name}; export the tie points as BINGO or "
            "PATB into this folder, or write image_points.csv"
        )
    rotations = _best_turned(given, camera, shown)
    return network_beside(
        path,
        {"camera": camera},
        given.names,
        ["camera"] * len(given.names),
        rotations,
        given.positions,
        shown,
        given.system,
    )


def _exteriors(folder: Path) -> list[Path]:
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    return [p for p in paths if p.is_file() and p.suffix.lower() in _EXTERIORS and is_exterior(p)]


def _camera(path: Path) -> TiedCamera:
    seen = (p for p in sorted(path.parent.iterdir()) if p.is_file() and not p.name.startswith("."))
    found = [p for p in seen if p.suffix.lower() in _CAMERAS]
    if len(found) != 1:
        raise InputError(
            f"{path.parent} holds {len(found)} camera files and needs one: camera.toml with [cameras.NAME], or that "
            "of another program (docs/camera_files.md)"
        )
    read = read_camera_file(found[0])
    return TiedCamera(read.sensor, read.interior, estimated(read.interior))


def _best_turned(given: ExteriorText, camera: TiedCamera, shown: Shown) -> Float[np.ndarray, "images 3 3"]:
    """Rotations from the object to the camera; one of their other readings where rays say so."""
    rotations = given.camera_from_object
    if not given.others:
        return rotations
    xy = camera.sensor.mm_from_px(shown.column_row) - [float(camera.interior.x_p), float(camera.interior.y_p)]
    rays = np.column_stack([xy, np.full(len(xy), -float(camera.interior.c))])
    read = (rotations, *given.others)
    misfit = [ray_misfit(given.positions, r, rays, shown.image, shown.point) for r in read]
    best = int(np.argmin(misfit))
    return read[best] if misfit[best] * _WORSE < misfit[0] else rotations
