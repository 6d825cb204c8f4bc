"""Interior and exterior parameters of orthority, with image points beside them -> the tables of a block.

    *.yaml          of each camera: type, im_size, focal_len, sensor_size, cx, cy, k1 ...
    *.geojson       world_crs, and of each photograph: filename, camera, xyz, opk (radians)
    or *.csv        filename, x, y, z, omega, phi, kappa (degrees) [, camera], and its system in a .prj of the same name

Signs and units as `jaxphoto.io.exports.orthority`. Without sensor_size, focal_len is over the longer side.
Source: orthority documentation, "Orthority interior parameters", "Orthority exterior parameters" and "CSV exterior
parameters".
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import still
from jaxphoto.camera import InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.io.block_folder import BlockTables
from jaxphoto.io.cameras.camera_file import CameraSource, in_pixels
from jaxphoto.io.cameras.open_cv import FISHEYE, PLANE
from jaxphoto.io.json_file import read_any_json
from jaxphoto.io.reconstructions.numbers import number_rows
from jaxphoto.io.reconstructions.points_beside import PhotographCamera, network_beside, points_beside
from jaxphoto.io.reconstructions.tied_photographs import TiedCamera, estimated
from jaxphoto.io.text_tables import read_csv
from jaxphoto.io.toml import Section
from jaxphoto.io.whole_text import LARGE, SMALL, read_text
from jaxphoto.io.yaml_text import yaml_values

_HEAD = 5_000
_POSITION, _ANGLES = ("x", "y", "z"), ("omega", "phi", "kappa")
_BROWN = ("k1", "k2", "p1", "p2", "k3")
_KINDS = {
    "pinhole": (PLANE, ()),
    "brown": (PLANE, _BROWN),
    "opencv": (PLANE, (*_BROWN, "k4", "k5", "k6")),
    "fisheye": (FISHEYE, ("k1", "k2", "k3", "k4")),
}
_NOT_READ = ("s1", "s2", "s3", "s4", "tx", "ty")


class _Exterior(NamedTuple):
    files: list[str]
    cameras: list[str]
    positions: Float[np.ndarray, "images 3"]
    angles: Float[np.ndarray, "images 3"]
    """omega, phi, kappa (rad)."""
    system: str


def recognises(source: Path) -> bool:
    """Whether `source` is a folder with one file of exterior parameters and one of interior ones, or the former."""
    folder = source if source.is_dir() else source.parent
    found = _exteriors(folder)
    return len(_interiors(folder)) == 1 and (len(found) == 1 if source.is_dir() else source in found)


def read_orthority(source: Path) -> BlockTables:
    """The block of parameters of orthority with image points beside them, from their values, in their system.

    Cameras are free in c_mm, xp_mm, yp_mm and the coefficients that are not zero; without sensor_size a pixel counts
    for a micrometre. Further as `free_network`.

    Raises InputError for files that are damaged or missing, cameras that are not known here, a system without EPSG
    code, and where there are no image points.
    """
    folder = source if source.is_dir() else source.parent
    found, inner = ([source] if source.is_file() else _exteriors(folder)), _interiors(folder)
    if len(found) != 1 or len(inner) != 1:
        told = few([path.name for path in (*found, *inner)]) or "none"
        raise InputError(f"{folder} has not one file of exterior and one of interior parameters ({told}); leave these")
    (path,), (cameras_path,) = found, inner
    given = _of_csv(path) if path.suffix.lower() == ".csv" else _of_geo_json(path)
    cameras = _cameras(cameras_path)
    camera_of = [_camera_of(path, cameras, k, name) for k, name in enumerate(given.cameras, 1)]
    shown = points_beside(path, given.files, [PhotographCamera(*cameras[name][:2]) for name in camera_of])
    if not len(shown.image):
        raise InputError(
            f"{path.name} has no image points, and none are beside it; export the tie points as BINGO or PATB into its "
            "folder, or write image_points.csv"
        )
    exterior = ExteriorOrientation.from_angles(given.positions, given.angles)  # type: ignore[arg-type]
    return network_beside(
        path,
        cameras,
        given.files,
        camera_of,
        still(exterior.camera_from_object),
        given.positions,
        shown,
        given.system,
    )


def _exteriors(folder: Path) -> list[Path]:
    paths = [p for p in sorted(folder.iterdir()) if p.is_file()] if folder.is_dir() else []
    collections = [p for p in paths if p.suffix.lower() in (".geojson", ".json") and '"world_crs"' in _begin(p)]
    return collections + [p for p in paths if p.suffix.lower() == ".csv" and _begin(p).startswith("filename,")]


def _interiors(folder: Path) -> list[Path]:
    paths = [p for p in sorted(folder.iterdir()) if p.is_file()] if folder.is_dir() else []
    return [p for p in paths if p.suffix.lower() in (".yaml", ".yml") and "focal_len" in _begin(p)]


def _begin(path: Path) -> str:
    with path.open("rb") as file:
        return file.read(_HEAD).decode("utf-8", "replace")


def _of_csv(path: Path) -> _Exterior:
    table = read_csv(path, ("filename", *_POSITION, *_ANGLES), ("camera",), ("filename", "camera"))
    position, angles = (np.stack([table.numbers(n) for n in names], axis=1) for names in (_POSITION, _ANGLES))
    beside = path.with_suffix(".prj")
    system = read_text(beside, SMALL).strip() if beside.is_file() else ""
    files, cameras = table.ids("filename").tolist(), table.text("camera").tolist()
    return _Exterior(files, cameras, position, np.deg2rad(angles), system)


def _of_geo_json(path: Path) -> _Exterior:
    content = read_any_json(path, LARGE)
    features = content.get("features") if isinstance(content, dict) else None
    if not isinstance(features, list) or not features:
        raise InputError(f"{path.name} has no features; let orthority write it anew")
    own = [one.get("properties") if isinstance(one, dict) else None for one in features]
    sections = [Section(path.name, f"features.{k}", p if isinstance(p, dict) else {}) for k, p in enumerate(own)]
    place = lambda k: f"{path.name}, feature {k + 1}"  # noqa: E731
    rows = [number_rows([section.values.get(key) for section in sections], (3,), place) for key in ("xyz", "opk")]
    cameras = ["" if s.values.get("camera") is None else s.text("camera") for s in sections]
    system = Section(path.name, "", content).text("world_crs", "")
    return _Exterior([s.text("filename") for s in sections], cameras, rows[0], rows[1], system)


def _cameras(path: Path) -> dict[str, TiedCamera]:
    source = CameraSource(path)
    try:
        content = yaml_values(source.text())
    except ValueError as error:
        raise source.error(str(error)) from None
    found = {}
    for name, values in content.items():
        if not isinstance(values, dict):
            raise source.error(f"camera {quoted(name)} has no names and values; write the file anew")
        interior_of = _interior(source, Section(path.name, name, values))
        found[name] = TiedCamera(*interior_of, estimated(interior_of[1]))
    return found


def _interior(source: CameraSource, given: Section) -> tuple[Any, InteriorOrientation]:
    """Sensor and interior orientation of a camera."""
    kind = given.text("type")
    if kind not in _KINDS:
        raise given.error("type", f"{quoted(kind)} is not known here; known are {', '.join(_KINDS)}")
    model, coefficients = _KINDS[kind]
    for name in _NOT_READ:
        if given.number(name, 0.0) != 0:
            raise given.error(name, "terms of a thin prism or a tilted sensor are not known here; calibrate without")
    width, height = given.vector("im_size", 2).tolist()
    many = isinstance(given.values.get("focal_len"), list)
    focal = given.vector("focal_len", 2) if many else np.full(2, given.positive("focal_len"))
    pixels, pixel_mm = np.array([width, height]), None
    if "sensor_size" in given:
        size = given.vector("sensor_size", 2)
        if not (size > 0).all():
            raise given.error("sensor_size", "this is not positive; give width and height in the unit of focal_len")
        # c is the second, that of rows.
        pixel_mm = float(size[1] / height) if height else None
        focal = focal * pixels / size
    else:
        focal = focal * max(width, height)
    sensor, _ = source.sensor(width, height, pixel_mm)
    longer = max(width, height)
    centre = (width / 2 + given.number("cx", 0.0) * longer, height / 2 + given.number("cy", 0.0) * longer)
    terms = {name: given.number(name, 0.0) for name in coefficients}
    return sensor, in_pixels(source, sensor, float(focal[0]), float(focal[1]), centre, model, **terms)


def _camera_of(path: Path, cameras: dict[str, TiedCamera], k: int, name: str) -> str:
    if not name and len(cameras) == 1:
        return next(iter(cameras))
    if name not in cameras:
        raise InputError(
            f"{path.name}, photograph {k}: there is no camera {quoted(name)} in the interior parameters (there are "
            f"{few(list(cameras))}); add it"
        )
    return name
