"""A reconstruction of OpenSfM, WebODM or OpenDroneMap, with its tracks -> the tables of a free network.

    reconstruction.json     cameras, shots (rotation as axis times angle, translation: x_camera = R x_world + t), points
    tracks.csv              photograph, track, feature, x, y, ...; a track is a point of the same name
    reference_lla.json      the place on WGS 84 from which the world counts east, north and up (or in the former)

Image coordinates are from the middle of the format, y down, over its longer side; so are focal lengths and c_x, c_y. A
camera `perspective` has k1 and k2, `simple_radial` k1, `radial` k1 and k2, `brown` k1 to k3, p1 and p2 of OpenCV,
`fisheye` k1 and k2 and `fisheye_opencv` k1 to k4 on the angle. Of several reconstructions the one of most shots is
read.
Source: OpenSfM documentation, "Geometric Models", "Reconstruction file format"; opensfm/io.py, src/map/tracks_manager.
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxphoto.errors import InputError, quoted
from jaxphoto.georeferencing.map_frame import Place
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.cameras.camera_file import CameraSource, in_pixels
from jaxphoto.io.cameras.open_cv import FISHEYE, PLANE
from jaxphoto.io.json_file import read_any_json
from jaxphoto.io.reconstructions.numbers import number_rows
from jaxphoto.io.reconstructions.on_map import about_place
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, TiedPhotographs, free_network
from jaxphoto.io.toml import Section
from jaxphoto.io.whole_text import LARGE, has_words, read_text

RECONSTRUCTION, TRACKS, REFERENCE = "reconstruction.json", "tracks.csv", "reference_lla.json"
_VERSION = "OPENSFM_TRACKS_VERSION_"
# Of each kind of camera: what it is here, and the coefficients it has.
_KINDS = {
    "perspective": (PLANE, ("k1", "k2")),
    "simple_radial": (PLANE, ("k1",)),
    "radial": (PLANE, ("k1", "k2")),
    "brown": (PLANE, ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": (FISHEYE, ("k1", "k2")),
    "fisheye_opencv": (FISHEYE, ("k1", "k2", "k3", "k4")),
}
_ONE_FOCAL = ("perspective", "fisheye")


def recognises(source: Path) -> bool:
    """Whether `source` is a file with shots, or a folder that has a reconstruction.json of them, or with tracks."""
    path = source / RECONSTRUCTION
    return (path.is_file() and (source / TRACKS).is_file()) or any(
        has_words(one, '"cameras"', '"shots"') for one in (path, source) if one.suffix == ".json"
    )


def read_open_sfm(source: Path) -> BlockTables:
    """The free-network self-calibration of a reconstruction of OpenSfM, from its values.

    Cameras are free in c_mm, the coefficients of their kind, and, where they have them, xp_mm, yp_mm and b1. A pixel
    counts for a micrometre. A point has the name of its track. Further as `free_network`.

    Raises InputError for files that are damaged or do not fit together, and for kinds of cameras that are not known.
    """
    path = source / RECONSTRUCTION if source.is_dir() else source
    folder = path.parent
    if not (folder / TRACKS).is_file():
        raise InputError(
            f"{path} has no {TRACKS} beside it, which says where its photographs show points; copy it there from the "
            "folder of the project (its folder opensfm, of OpenDroneMap), or run opensfm create_tracks again"
        )
    chosen = _largest(path, read_any_json(path, LARGE))
    shots, points = chosen.section("shots").values, chosen.section("points").values
    cameras = {name: _camera(path, chosen.section("cameras").section(name)) for name in chosen.section("cameras")}
    each = [Section(path.name, f"shots.{name}", shot if isinstance(shot, dict) else {}) for name, shot in shots.items()]
    camera_of = [shot.text("camera") for shot in each]
    for shot, camera in zip(each, camera_of, strict=True):
        if camera not in cameras:
            raise shot.error("camera", f"there is no camera {quoted(camera)} in the file; correct it")
    files, ids = list(shots), list(points)
    of_shot = lambda key: number_rows([shot.values.get(key) for shot in each], (3,), _place(path, files, key))  # noqa: E731
    rotations = scipy.spatial.transform.Rotation.from_rotvec(of_shot("rotation")).as_matrix().reshape(-1, 3, 3)
    given = [point.get("coordinates") if isinstance(point, dict) else None for point in points.values()]
    image, point, column_row = _tracks(folder / TRACKS, files, ids, [cameras[name] for name in camera_of])
    tied = TiedPhotographs(
        path.name,
        "OpenSfM",
        folder.resolve().name,
        cameras,
        files,
        camera_of,
        rotations,
        -np.einsum("nji,nj->ni", rotations, of_shot("translation")),
        ids,
        number_rows(given, (3,), _place(path, ids, "coordinates")),
        image,
        point,
        column_row,
    )
    reference = _reference(folder, chosen)
    return free_network(about_place(tied, reference) if reference else tied)


def _reference(folder: Path, chosen: Section) -> Place | None:
    """Where the world's origin is on WGS 84; None where nothing says it (0, 0 of a reconstruction without GPS)."""
    path = folder / REFERENCE
    if "reference_lla" in chosen:
        own = chosen.section("reference_lla")
    elif path.is_file():
        content = read_any_json(path, LARGE)
        own = Section(path.name, "", content if isinstance(content, dict) else {})
    else:
        return None
    place = own.number("longitude"), own.number("latitude"), own.number("altitude", 0.0)
    return place if any(place[:2]) else None


def _place(path: Path, names: list[str], key: str):
    return lambda k: f"{path.name}, {quoted(names[k])}, {key}"


def _largest(path: Path, content: Any) -> Section:
    """The reconstruction of most shots; a UserWarning counts the others."""
    each = content if isinstance(content, list) else [content]
    shots = [len(r["shots"]) if isinstance(r, dict) and isinstance(r.get("shots"), dict) else 0 for r in each]
    if not each or not max(shots):
        raise InputError(f"{path}: there is no reconstruction with shots in it; run OpenSfM's reconstruct")
    best = int(np.argmax(shots))
    if sum(shots) > shots[best]:
        said = f"{path}: of {len(each)} reconstructions the one of {shots[best]} shots is read, {sum(shots)} are in all"
        warnings.warn(said, UserWarning, stacklevel=3)
    return Section(path.name, "", each[best])


def _camera(path: Path, given: Section) -> TiedCamera:
    kind = given.text("projection_type", "perspective")
    if kind not in _KINDS:
        raise given.error("projection_type", f"{quoted(kind)} is not known here; known are {', '.join(_KINDS)}")
    model, names = _KINDS[kind]
    source = CameraSource(path)
    sensor, _ = source.sensor(given.count("width"), given.count("height"))
    longer = max(sensor.width_px, sensor.height_px)
    fx, fy = (given.number("focal"),) * 2 if kind in _ONE_FOCAL else (given.number("focal_x"), given.number("focal_y"))
    centre = [
        (side / 2) + given.number(key, 0.0) * longer
        for side, key in ((sensor.width_px, "c_x"), (sensor.height_px, "c_y"))
    ]
    values = {name: given.number(name, 0.0) for name in names}
    interior = in_pixels(source, sensor, fx * longer, fy * longer, (centre[0], centre[1]), model, **values)
    free = ("c_mm", *(() if kind in _ONE_FOCAL else ("xp_mm", "yp_mm")), *names, *(("b1",) if fx != fy else ()))
    return TiedCamera(sensor, interior, free)


def _tracks(
    path: Path, files: list[str], ids: list[str], cameras: list[TiedCamera]
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], Float[np.ndarray, "n 2"]]:
    """Photograph, point and pixels of what tracks.csv measures of the shots and points there are."""
    lines = read_text(path, LARGE).split("\n")
    begin = 1 if lines[0].startswith(_VERSION) else 0
    shot_of, point_of = {name: k for k, name in enumerate(files)}, {name: k for k, name in enumerate(ids)}
    found: list[tuple[int, int]] = []
    xy: list[list[str]] = []
    rows: list[int] = []
    for row, line in enumerate(lines[begin:], begin + 1):
        cells = line.split("\t")
        if len(cells) < 5:
            if line.strip():
                raise InputError(
                    f"{path.name}, row {row}: {len(cells)} cells, where photograph, track, feature, x and y are five "
                    "at least, between tabulators; write the file anew"
                )
            continue
        if cells[0] in shot_of and cells[1] in point_of:
            found.append((shot_of[cells[0]], point_of[cells[1]]))
            xy.append(cells[3:5])
            rows.append(row)
    image, point = np.array(found, int).reshape(-1, 2).T
    normalised = number_rows(xy, (2,), lambda k: f"{path.name}, row {rows[k]}")
    size = np.array([[c.sensor.width_px, c.sensor.height_px] for c in cameras]).reshape(-1, 2)[image]
    return image, point, normalised * size.max(axis=1, keepdims=True) + size / 2
