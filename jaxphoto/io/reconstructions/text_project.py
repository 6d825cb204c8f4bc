"""A folder of texts -> the tables of a block: exterior orientations, image points, and a camera file.

Orientations as `exterior_text`, image points as `points_beside`, the camera as `jaxphoto.io.cameras` reads it. Of
several cameras in its file images.csv says which photograph has which (image, camera; as in a block folder).
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import InputError, few, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.cameras import read_camera_file
from jaxphoto.io.cameras.camera_file import SeveralCamerasError
from jaxphoto.io.reconstructions import open_sfm, orthority, pix4d
from jaxphoto.io.reconstructions.exterior_text import ExteriorText, is_exterior, read_exterior
from jaxphoto.io.reconstructions.points_beside import (
    PhotographCamera,
    Shown,
    measured_texts,
    network_beside,
    places_by_name,
    points_beside,
)
from jaxphoto.io.reconstructions.rays import ray_misfit
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, estimated
from jaxphoto.io.text_tables import read_csv

IMAGES = "images.csv"
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
    others = any(other.recognises(source) for other in (pix4d, orthority, open_sfm)) or (source / TOML).is_file()
    return len(found) == 1 and bool(measured_texts(found[0])) and not others


def read_text_project(source: Path) -> BlockTables:
    """The block of a folder of texts, from the values in them; a file names the orientations of its folder.

    Each camera is free in c_mm, xp_mm, yp_mm and the coefficients that are not zero. Further as `free_network`.

    Raises InputError for files that are damaged, missing or too many, and for a system that is not known.
    """
    found = [source] if source.is_file() else _exteriors(source)
    if len(found) != 1:
        told = f" ({few([path.name for path in found])})" if found else ""
        raise InputError(f"{source} holds {len(found)} texts of orientations{told}; name one")
    path = found[0]
    given = read_exterior(path)
    cameras, camera_of = _cameras(path, given.names)
    of_image = [cameras[name] for name in camera_of]
    shown = points_beside(path, given.names, [PhotographCamera(*camera[:2]) for camera in of_image])
    if not len(shown.image):
        raise InputError(
            f"{path.parent} has no image points for the orientations in {path.name}; export the tie points as BINGO or "
            "PATB into this folder, or write image_points.csv"
        )
    rotations = _best_turned(given, of_image, shown)
    return network_beside(
        path,
        cameras,
        given.names,
        camera_of,
        rotations,
        given.positions,
        shown,
        given.system,
    )


def _exteriors(folder: Path) -> list[Path]:
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    texts = (p for p in paths if p.is_file() and p.suffix.lower() in _EXTERIORS and p.name != IMAGES)
    return [p for p in texts if is_exterior(p)]


def _cameras(path: Path, names: list[str]) -> tuple[dict[str, TiedCamera], list[str]]:
    """The cameras of the folder, and which each photograph has: of one, all have it.

    Raises InputError where images.csv leaves a photograph out, has one twice, or names a camera that there is not.
    """
    file, beside = _camera_file(path), path.with_name(IMAGES)
    if not beside.is_file():
        try:
            name, camera = _camera(file)
        except SeveralCamerasError:
            raise InputError(
                f"{file.name} holds several cameras, and nothing says which photograph has which; write {IMAGES} "
                "beside it (image, camera), or keep one camera in the file"
            ) from None
        return {name: camera}, [name] * len(names)
    table, places = read_csv(beside, ("image", "camera")), places_by_name(names)
    images, own, found = table.ids("image").tolist(), table.ids("camera").tolist(), dict[int, str]()
    for row, (image, camera) in enumerate(zip(images, own, strict=True)):
        if found.setdefault(place := places.get(image, -1), camera) != camera and place >= 0:
            raise table.bad(row, f"photograph {quoted(image)} has another camera in a row above; keep one of the two")
    if missing := [name for k, name in enumerate(names) if k not in found]:
        raise InputError(f"{IMAGES} says no camera of {len(missing)} photographs ({few(missing)}); add a row for each")
    camera_of = [found[k] for k in range(len(names))]
    return dict(_camera(file, name) for name in dict.fromkeys(camera_of)), camera_of


def _camera_file(path: Path) -> Path:
    seen = (p for p in sorted(path.parent.iterdir()) if p.is_file() and not p.name.startswith("."))
    found = [p for p in seen if p.suffix.lower() in _CAMERAS]
    if len(found) != 1:
        raise InputError(
            f"{path.parent} holds {len(found)} camera files and needs one: camera.toml with [cameras.NAME], or that "
            "of another program (docs/camera_files.md)"
        )
    return found[0]


def _camera(file: Path, name: str | None = None) -> tuple[str, TiedCamera]:
    """A camera under the name that the file has for it."""
    read = read_camera_file(file, camera=name)
    return read.name, TiedCamera(read.sensor, read.interior, estimated(read.interior))


def _best_turned(given: ExteriorText, cameras: list[TiedCamera], shown: Shown) -> Float[np.ndarray, "images 3 3"]:
    """Rotations from the object to the camera; one of their other readings where rays say so."""
    rotations = given.camera_from_object
    if not given.others:
        return rotations
    rays = np.zeros((len(shown.image), 3))
    for k, camera in enumerate(cameras):
        own, i = shown.image == k, camera.interior
        rays[own, :2] = camera.sensor.mm_from_px(shown.column_row[own]) - [float(i.x_p), float(i.y_p)]
        rays[own, 2] = -float(i.c)
    read = (rotations, *given.others)
    misfit = [ray_misfit(given.positions, r, rays, shown.image, shown.point) for r in read]
    best = int(np.argmin(misfit))
    return read[best] if misfit[best] * _WORSE < misfit[0] else rotations
