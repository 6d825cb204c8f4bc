"""Interior and exterior parameters of orthority, with image points beside them.

    *.yaml          of each camera: type, im_size, focal_len, sensor_size, cx, cy, k1 ... of OpenCV
    *.geojson       world_crs, and of each photograph: filename, camera, xyz, opk (radians)
    or *.csv        filename, x, y, z, omega, phi, kappa (degrees) [, camera], and its system in a .prj of the same name

cx and cy are from the middle of the format, y down, over its longer side; focal_len has the unit of sensor_size,
without it that of the longer side; angles are those of docs/conventions.md. Written are int_param.yaml, ext_param.csv
and ext_param.prj in map coordinates. Source: orthority documentation, "Orthority interior parameters", "Orthority
exterior parameters" and "CSV exterior parameters"; orthority/camera.py.
"""

import csv
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.errors import InputError, few, quoted
from jaxphoto.extras.formats.camera_models import FISHEYE_TERMS, OPENCV, OPENCV_FISHEYE, ProjectCamera, in_pixels
from jaxphoto.extras.formats.files import Format, beginning, number_rows, read_json
from jaxphoto.extras.formats.opencv import yaml_cameras
from jaxphoto.extras.formats.points_beside import points_beside, write_image_points
from jaxphoto.extras.formats.project import Project
from jaxphoto.extras.formats.texts import angles_deg, oriented_project
from jaxphoto.io.camera_files import CameraSource
from jaxphoto.io.text_files import read_legacy_text
from jaxphoto.io.text_tables import read_csv
from jaxphoto.io.toml import Section

_HEAD = 5_000
_BROWN = ("k1", "k2", "p1", "p2", "k3")
_RATIONAL = ("k4", "k5", "k6")
_KINDS = {
    "pinhole": (OPENCV, ()),
    "brown": (OPENCV, _BROWN),
    "opencv": (OPENCV, (*_BROWN, *_RATIONAL)),
    "fisheye": (OPENCV_FISHEYE, FISHEYE_TERMS),
}
_NOT_READ = ("s1", "s2", "s3", "s4", "tx", "ty")


class _Exterior(NamedTuple):
    files: list[str]
    cameras: list[str]
    positions: np.ndarray
    angles: np.ndarray
    system: str


def find(source: Path) -> list[Path]:
    """Return the files of exterior parameters beside one of interior ones."""
    folder = source if source.is_dir() else source.parent
    if len(_interiors(folder)) != 1:
        return []
    files = [p for p in sorted(folder.iterdir()) if p.is_file()]
    collections = [p for p in files if p.suffix.lower() in (".geojson", ".json") and '"world_crs"' in _begin(p)]
    exteriors = collections + [p for p in files if p.suffix.lower() == ".csv" and _begin(p).startswith("filename,")]
    return exteriors if source.is_dir() else [p for p in exteriors if p == source]


def _interiors(folder: Path) -> list[Path]:
    paths = [p for p in sorted(folder.iterdir()) if p.is_file()]
    return [p for p in paths if p.suffix.lower() in (".yaml", ".yml") and "focal_len" in _begin(p)]


def _begin(path: Path) -> str:
    return "\n".join(beginning(path, _HEAD))


def read(path: Path) -> Project:
    """Read parameters; cameras are free in c, xp, yp and coefficients that are not zero."""
    interiors = _interiors(path.parent)
    if len(interiors) != 1:
        raise InputError(f"{path.parent} has {len(interiors)} files of interior parameters; leave one")
    files, names, positions, angles, system = _of_csv(path) if path.suffix.lower() == ".csv" else _of_json(path)
    source = CameraSource(interiors[0])
    cameras = {name: _camera(source, Section(source.path.name, name, v)) for name, v in yaml_cameras(source).items()}
    only = next(iter(cameras)) if len(cameras) == 1 else ""
    camera_of = [name or only for name in names]
    for k, name in enumerate(camera_of, 1):
        if name not in cameras:
            raise InputError(
                f"{path.name}, photograph {k}: there is no camera {quoted(name)} in the interior parameters (there are "
                f"{few(list(cameras))}); add it"
            )
    shown = points_beside(path, files, [cameras[name] for name in camera_of])
    exterior = ExteriorOrientation.from_angles(positions, angles)  # type: ignore[arg-type]
    return oriented_project(path, cameras, files, camera_of, exterior, shown, system)


def _of_csv(path: Path) -> _Exterior:
    names = ("x", "y", "z", "omega", "phi", "kappa")
    table = read_csv(path, ("filename", *names), ("camera",), ("filename", "camera"))
    values = np.stack([table.numbers(n) for n in names], axis=1)
    prj = path.with_suffix(".prj")
    system = read_legacy_text(prj).strip() if prj.is_file() else ""
    files, cameras = table.ids("filename").tolist(), table.text("camera").tolist()
    return _Exterior(files, cameras, values[:, :3], np.deg2rad(values[:, 3:]), system)


def _of_json(path: Path) -> _Exterior:
    content = read_json(path)
    features = [feature["properties"] for feature in content["features"]]
    sections = [Section(path.name, f"features.{k}", values) for k, values in enumerate(features)]
    place = lambda k: f"{path.name}, feature {k + 1}"  # noqa: E731
    positions, angles = (number_rows([f.get(key) for f in features], (3,), place) for key in ("xyz", "opk"))
    cameras = ["" if f.get("camera") is None else str(f["camera"]) for f in features]
    return _Exterior([s.text("filename") for s in sections], cameras, positions, angles, content.get("world_crs") or "")


def _camera(source: CameraSource, section: Section) -> ProjectCamera:
    kind = section.text("type")
    if kind not in _KINDS:
        raise section.error("type", f"{quoted(kind)} is not known here; known are {', '.join(_KINDS)}")
    model, coefficients = _KINDS[kind]
    for name in _NOT_READ:
        if section.number(name, 0.0) != 0:
            raise section.error(name, "terms of a thin prism or a tilted sensor are not known here; calibrate without")
    width, height = section.vector("im_size", 2).tolist()
    longer, pixel_mm = max(width, height), None
    two = isinstance(section.values.get("focal_len"), list)
    focal = section.vector("focal_len", 2) if two else np.full(2, section.positive("focal_len"))
    if "sensor_size" in section:
        size = section.vector("sensor_size", 2)
        if not (size > 0).all():
            raise section.error("sensor_size", "this is not positive; give width and height in the unit of focal_len")
        pixel_mm = float(size[1] / height) if height else None
        focal = focal * [width, height] / size
    else:
        focal = focal * longer
    sensor, _ = source.sensor(width, height, pixel_mm)
    centre = width / 2 + section.number("cx", 0.0) * longer, height / 2 + section.number("cy", 0.0) * longer
    terms = {name: section.number(name, 0.0) for name in coefficients}
    fx, fy = focal.tolist()
    return ProjectCamera.estimated(sensor, in_pixels(source, sensor, fx, fy, centre, model, **terms))


def write(p: Project, folder: Path) -> None:
    """Write the three files, the .prj only for a map system, and image_points.csv."""
    m = p.in_map()
    if m.geographic:
        raise InputError(f"orthority counts metres, and the block is in {m.system}, in degrees")
    cameras = "".join(_written(name, camera) for name, camera in p.cameras.items())
    (folder / "int_param.yaml").write_text(cameras, encoding="utf-8")
    values = np.hstack([np.asarray(m.exterior.position), angles_deg(m.exterior)])
    with (folder / "ext_param.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["filename", "x", "y", "z", "omega", "phi", "kappa", "camera"])
        for name, row, camera in zip(p.files, values.tolist(), p.image_camera, strict=True):
            table.writerow([name, *map(repr, row), camera])
    if m.system:
        (folder / "ext_param.prj").write_text(m.system + "\n", encoding="utf-8")
    write_image_points(p, folder)


def _written(name: str, camera: ProjectCamera) -> str:
    sensor, interior, _ = camera
    c, longer_mm = float(interior.c), max(sensor.width_mm, sensor.height_mm)
    if type(interior.distortion) is OPENCV_FISHEYE.distortion:
        kind, terms = "fisheye", camera.terms(FISHEYE_TERMS)
    else:
        kind = "opencv" if any(camera.terms(_RATIONAL).values()) else "brown"
        terms = camera.terms(_KINDS[kind][1])
    focal = c * (1 + camera.terms(("b1",))["b1"]), c
    values = {
        "type": kind,
        "im_size": f"[{sensor.width_px}, {sensor.height_px}]",
        "focal_len": f"[{', '.join(map(_number, focal))}]",
        "sensor_size": f"[{_number(sensor.width_mm)}, {_number(sensor.height_mm)}]",
        "cx": _number(float(interior.x_p) / longer_mm),
        "cy": _number(-float(interior.y_p) / longer_mm),
        **{key: _number(value) for key, value in terms.items()},
    }
    return f"{json.dumps(name)}:\n" + "".join(f"  {key}: {text}\n" for key, text in values.items())


def _number(value: float) -> str:
    """A number of YAML 1.1, which has a point before the exponent."""
    digits, e, exponent = repr(float(value)).partition("e")
    return digits + ("" if "." in digits else ".0") + e + exponent


FORMATS = (
    Format(
        "orthority", "parameters of orthority, YAML and CSV", find, read, write=write, plane=OPENCV,
        fisheye=OPENCV_FISHEYE, endings=(".yaml", ".csv", ".prj"), in_map=True, lacks=("points",),
    ),
)  # fmt: skip
