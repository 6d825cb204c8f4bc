"""OpenSfM, WebODM and OpenDroneMap: a reconstruction and its tracks.

    reconstruction.json     cameras, shots (rotation vector (axis times angle), translation: x_camera = R x_world + t),
                            points
    tracks.csv              photograph, track, feature, x, y, ...; a track is the point of the same name
    reference_lla.json      origin on WGS 84 of the east-north-up world frame (may also be in reconstruction.json)

Image coordinates are relative to the image centre, y down, divided by the longer side of the format; focal lengths and
c_x, c_y are divided by it, too. If there are several reconstructions, the one with most shots is read. The export
contains cameras `brown` and `fisheye_opencv`. Source: OpenSfM documentation, "Geometric Models", "Reconstruction file
format"; opensfm/io.py, opensfm/geo.py, src/map/tracks_manager.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.files import Format, by_content, number_rows, warn
from jaxphoto.extras.formats.project import (
    BROWN,
    BROWN_TERMS,
    FISHEYE_TERMS,
    OPENCV,
    OPENCV_FISHEYE,
    Project,
    ProjectCamera,
    about_place,
    in_pixels,
    pose,
    translations,
)
from jaxphoto.georeferencing.map_frame import Place
from jaxphoto.io.camera_files import CameraSource
from jaxphoto.io.text_files import has_words, read_text
from jaxphoto.io.toml import Section

RECONSTRUCTION, TRACKS, REFERENCE = "reconstruction.json", "tracks.csv", "reference_lla.json"
_KINDS = {
    "perspective": (OPENCV, ("k1", "k2")),
    "simple_radial": (OPENCV, ("k1",)),
    "radial": (OPENCV, ("k1", "k2")),
    "brown": (OPENCV, BROWN_TERMS),
    "fisheye": (OPENCV_FISHEYE, ("k1", "k2")),
    "fisheye_opencv": (OPENCV_FISHEYE, FISHEYE_TERMS),
}
_ONE_FOCAL = ("perspective", "fisheye")


def _is_reconstruction(path: Path) -> bool:
    named = path.name == RECONSTRUCTION and path.with_name(TRACKS).is_file()
    return named or (path.suffix == ".json" and has_words(path, '"cameras"', '"shots"'))


def read(path: Path) -> Project:
    """Read a reconstruction; cameras have free c, the coefficients of their model and, if given, xp, yp and b1."""
    folder = path.parent
    if not (folder / TRACKS).is_file():
        raise InputError(f"{path}: {TRACKS} not found in its folder. Copy it from the project's folder (opensfm)")
    content = _largest(path, json.loads(read_text(path)))
    shots, points = content.section("shots").values, content.section("points").values
    cameras = {name: _camera(path, content.section("cameras").section(name)) for name in content.section("cameras")}
    sections = [Section(path.name, f"shots.{name}", shot) for name, shot in shots.items()]
    camera_of = [shot.text("camera") for shot in sections]
    for shot in sections:
        if shot.text("camera") not in cameras:
            raise shot.error("camera", f"unknown camera {quoted(shot.text('camera'))}; correct it")
    files, ids = list(shots), list(points)

    def vectors(key: str) -> np.ndarray:
        place = lambda k: f"{path.name}, {quoted(files[k])}, {key}"  # noqa: E731
        return number_rows([shot.values.get(key) for shot in sections], (3,), place)

    rotations = scipy.spatial.transform.Rotation.from_rotvec(vectors("rotation")).as_matrix().reshape(-1, 3, 3)
    xyz = [point.get("coordinates") for point in points.values()]
    image, point, column_row = _tracks(folder / TRACKS, files, ids, [cameras[name] for name in camera_of])
    project = Project(
        folder.resolve().name, cameras, (), files, camera_of,
        pose(rotations, translations(np.swapaxes(rotations, 1, 2), vectors("translation"))), ids,
        number_rows(xyz, (3,), lambda k: f"{path.name}, {quoted(ids[k])}, coordinates"), image, point, column_row,
        file=path.name,
    )  # fmt: skip
    reference = _reference(folder, content)
    return about_place(project, reference) if reference else project


def _reference(folder: Path, content: Section) -> Place | None:
    """Return the origin of the world on WGS 84; None if unknown (0, 0 in reconstructions without GPS)."""
    path, reference = folder / REFERENCE, content.section("reference_lla")
    if "reference_lla" not in content:
        reference = Section(path.name, "", json.loads(read_text(path)) if path.is_file() else {})
    place = tuple(reference.number(key, 0.0) for key in ("longitude", "latitude", "altitude"))
    return place if any(place[:2]) else None  # type: ignore[return-value]


def _largest(path: Path, content: Any) -> Section:
    each = content if isinstance(content, list) else [content]
    shots = [len(r["shots"]) if isinstance(r, dict) and isinstance(r.get("shots"), dict) else 0 for r in each]
    if not any(shots):
        raise InputError(f"{path}: no reconstruction with shots; run OpenSfM's reconstruct")
    best = int(np.argmax(shots))
    if sum(shots) > shots[best]:
        warn(f"{path}: read the largest of {len(each)} reconstructions ({shots[best]} of {sum(shots)} shots)")
    return Section(path.name, "", each[best])


def _camera(path: Path, camera: Section) -> ProjectCamera:
    kind = camera.text("projection_type", "perspective")
    if kind not in _KINDS:
        raise camera.error("projection_type", f"{quoted(kind)} is not supported; use one of {', '.join(_KINDS)}")
    model, names = _KINDS[kind]
    source = CameraSource(path)
    sensor, _ = source.sensor(camera.count("width"), camera.count("height"))
    longer, one = max(sensor.width_px, sensor.height_px), kind in _ONE_FOCAL
    fx, fy = (camera.number("focal" if one else key) * longer for key in ("focal_x", "focal_y"))
    cx, cy = (camera.number(key, 0.0) * longer for key in ("c_x", "c_y"))
    centre = sensor.width_px / 2 + cx, sensor.height_px / 2 + cy
    terms = {name: camera.number(name, 0.0) for name in names}
    interior = in_pixels(source, sensor, fx, fy, centre, model, **terms)
    free = ("c_mm", *(() if one else ("xp_mm", "yp_mm")), *names, *(("b1",) if fx != fy else ()))
    return ProjectCamera(sensor, interior, free)


def _tracks(
    path: Path, files: list[str], ids: list[str], cameras: list[ProjectCamera]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return image index, point index and pixel coordinates of the image points of known shots and points."""
    lines = read_text(path).split("\n")
    begin = 1 if lines[0].startswith("OPENSFM_TRACKS_VERSION_") else 0
    shot_of, point_of = {name: k for k, name in enumerate(files)}, {name: k for k, name in enumerate(ids)}
    index, xy, rows = [], [], []
    for row, line in enumerate(lines[begin:], begin + 1):
        cells = line.split("\t")
        if len(cells) < 5 and line.strip():
            raise InputError(
                f"{path.name}, row {row}: {len(cells)} cells; expected photograph, track, feature, x, y ..."
            )
        if len(cells) >= 5 and cells[0] in shot_of and cells[1] in point_of:
            index.append((shot_of[cells[0]], point_of[cells[1]]))
            xy.append(cells[3:5])
            rows.append(row)
    image, point = np.array(index, int).reshape(-1, 2).T
    normalised = number_rows(xy, (2,), lambda k: f"{path.name}, row {rows[k]}")
    size = _sizes(cameras)[image]
    return image, point, normalised * size.max(axis=1, keepdims=True) + size / 2


def _sizes(cameras: list[ProjectCamera]) -> np.ndarray:
    return np.array([[c.sensor.width_px, c.sensor.height_px] for c in cameras]).reshape(-1, 2)


def write(p: Project, folder: Path) -> None:
    """Write reconstruction.json, camera_models.json, tracks.csv and, on WGS 84, reference_lla.json."""
    rotations = p.world_to_camera
    vectors = scipy.spatial.transform.Rotation.from_matrix(rotations).as_rotvec().tolist()
    moved = translations(rotations, p.exterior.position).tolist()
    cameras = {name: _written(camera) for name, camera in p.cameras.items()}
    shots = {
        file: {"rotation": vectors[i], "translation": moved[i], "camera": p.image_camera[i]}
        for i, file in enumerate(p.files)
    }
    xyz = np.asarray(p.xyz).tolist()
    points = {name: {"color": [0.0, 0.0, 0.0], "coordinates": at} for name, at in zip(p.points, xyz, strict=True)}
    reconstruction: dict[str, Any] = {"cameras": cameras, "shots": shots, "points": points}
    if p.place is not None:
        reconstruction["reference_lla"] = dict(zip(("longitude", "latitude", "altitude"), p.place, strict=True))
        _write_json(folder / REFERENCE, reconstruction["reference_lla"])
    _write_json(folder / RECONSTRUCTION, [reconstruction])
    _write_json(folder / "camera_models.json", cameras)
    size = _sizes([p.cameras[name] for name in p.image_camera])[p.image]
    xy = ((p.column_row - size / 2) / size.max(axis=1, keepdims=True)).tolist()
    rows = zip(p.image.tolist(), p.point.tolist(), p.number_in_image.tolist(), xy, strict=True)
    lines = [f"{p.files[i]}\t{p.points[j]}\t{k}\t{x!r}\t{y!r}\t0\t0\t0\n" for i, j, k, (x, y) in rows]
    (folder / TRACKS).write_text("".join(lines), encoding="utf-8")


def _written(camera: ProjectCamera) -> dict[str, Any]:
    sensor, interior, _ = camera
    longer_mm = max(sensor.width_mm, sensor.height_mm)
    focal = float(interior.c) / longer_mm
    fisheye = type(interior.distortion) is OPENCV_FISHEYE.distortion
    return {
        "projection_type": "fisheye_opencv" if fisheye else "brown",
        "width": sensor.width_px,
        "height": sensor.height_px,
        "focal_x": focal * (1 + camera.terms(("b1",))["b1"]),
        "focal_y": focal,
        "c_x": float(interior.xp) / longer_mm,
        "c_y": -float(interior.yp) / longer_mm,
        **camera.terms(FISHEYE_TERMS if fisheye else BROWN_TERMS),
    }


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


FORMATS = (
    Format(
        "opensfm", "reconstruction of OpenSfM, as in WebODM", by_content(RECONSTRUCTION, _is_reconstruction), read,
        write=write, plane=BROWN, fisheye=OPENCV_FISHEYE, endings=(".json", ".csv", ".txt"),
    ),
)  # fmt: skip
