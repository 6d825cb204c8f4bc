"""COLMAP models, read and written by pycolmap: `cameras`, `images` and `points3D`, all .txt or all .bin.

A single cameras.txt is a camera file. COLMAP's camera axes are x right, y down, z forward: x_camera = R x_world + t.
Pixel coordinates are the same as ours. Its perspective models are special cases of `OpenCv`, its fisheye models of
`OpenCvFisheye` with the equidistant projection. Exported models have no colours, errors or standard deviations. Source:
COLMAP documentation, "Camera models" and "Output format"; src/colmap/sensor/models.h.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxphoto.camera import InteriorOrientation, OpenCvFisheye, Sensor
from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.files import CameraFormat, Format, content_rows, row_numbers
from jaxphoto.extras.formats.project import (
    OPENCV,
    OPENCV_FISHEYE,
    Project,
    ProjectCamera,
    in_pixels,
    numbered,
    pixels_of,
    pose,
    translations,
)
from jaxphoto.io.camera_files import CameraFile, CameraReader, CameraSource
from jaxphoto.io.text_files import read_bytes, read_text
from jaxphoto.io.text_tables import is_number

FILES = ("cameras", "images", "points3D")
_PLANES = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_FISHEYES = {
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "THIN_PRISM_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "s1", "s2"),
}
MODELS = _PLANES | _FISHEYES
"""Parameters of each model in COLMAP's order, simplest model first; `f` means fx = fy."""
FISHEYE = OPENCV_FISHEYE._replace(lacks=("b2",))
_PLACES = ("f", "fx", "fy", "cx", "cy")


def find(source: Path) -> list[Path]:
    """Return the cameras file of a model; .txt is preferred to .bin."""
    if source.is_file() and source.stem != FILES[0]:
        return []
    folder = source if source.is_dir() else source.parent
    suffixes = (end for end in (".txt", ".bin") if all((folder / (name + end)).is_file() for name in FILES))
    return [folder / (FILES[0] + end) for end in suffixes][:1]


def read(path: Path) -> Project:
    """Read a model; free camera parameters are the parameters of COLMAP's model, point ids are COLMAP's ids."""
    model, folder = _model(path), path.resolve().parent.name
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    cameras = {}
    for number in sorted({image.camera_id for image in images}):
        c = model.cameras[number]
        camera = _camera(CameraSource(path), str(number), c.model_name, c.width, c.height, c.params.tolist())
        names = MODELS[c.model_name]
        free = ["c_mm", "xp_mm", "yp_mm", *(k for k in names if k not in _PLACES), *["b1"] * ("fx" in names)]
        cameras[str(number)] = ProjectCamera(camera.sensor, camera.interior, tuple(free))
    matrices = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    rotations = matrices[:, :, :3]
    shown = [[feature for feature in image.points2D if feature.has_point3D()] for image in images]
    ids = np.array(sorted(model.points3D), int)
    return Project(
        folder, cameras, (), [image.name for image in images], [str(image.camera_id) for image in images],
        pose(rotations, translations(np.swapaxes(rotations, 1, 2), matrices[:, :, 3])), ids.astype(str).tolist(),
        np.array([model.points3D[k].xyz for k in ids.tolist()]).reshape(-1, 3),
        np.repeat(np.arange(len(images)), [len(features) for features in shown]),
        np.searchsorted(ids, [feature.point3D_id for features in shown for feature in features]),
        np.array([feature.xy for features in shown for feature in features]).reshape(-1, 2), file=folder,
    )  # fmt: skip


def _model(path: Path) -> Any:
    """Read the model of a cameras file."""
    import pycolmap

    model, images = pycolmap.Reconstruction(), path.with_name("images.txt")
    if path.suffix != ".txt":
        model.read_binary(str(path.parent))
    elif images.is_file() and read_text(images).encode() != read_bytes(images):
        # pycolmap returns names in UTF-8 only.
        with tempfile.TemporaryDirectory() as folder:
            for file in path.parent.glob("*.txt"):
                Path(folder, file.name).write_text(read_text(file), "utf-8")
            model.read_text(folder)
    else:
        model.read_text(str(path.parent))
    return model


# Cameras ------------------------------------------------------------------------------------------------------


def recognise_cameras(path: Path, text: str) -> bool:
    """Return True for COLMAP's file names, or if the first line is an id, a model and numeric values."""
    lines = (line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    first = next(lines, [])
    named = path.name in ("cameras.txt", "cameras.bin")
    return named or (len(first) > 4 and first[1].isupper() and all(map(is_number, first[2:])))


def read_camera(source: CameraSource) -> CameraFile:
    """Read one camera: of a text file, or of a binary model."""
    if source.path.suffix == ".bin":
        cameras = {str(key): camera for key, camera in _model(source.path).cameras.items()}
        c = cameras[name := source.chosen(list(cameras))]
        return _camera(source, name, c.model_name, c.width, c.height, c.params.tolist())
    lines = {}
    for row, line in content_rows(source.path):
        cells = line.split()
        if not cells[0].isdecimal() or len(cells) < 4:
            raise source.error(f"row {row}: {quoted(line)}; write CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        if cells[0] in lines:
            raise source.error(f"duplicate camera {cells[0]}; keep one of the two lines")
        lines[cells[0]] = row, cells
    name = source.chosen(list(lines))
    row, (_, kind, *words) = lines[name]
    width, height, *values = row_numbers(source.path, row, words, len(words))
    return _camera(source, name, kind, width, height, values)


def _camera(
    source: CameraSource, name: str, kind: str, width: float, height: float, numbers: Sequence[float]
) -> CameraFile:
    if kind not in MODELS:
        raise source.error(f"model {kind} of camera {name} is not supported; use one of {', '.join(MODELS)}")
    names = MODELS[kind]
    if len(numbers) != len(names):
        raise source.error(
            f"camera {name} has {len(numbers)} parameters instead of the {len(names)} of {kind}: {', '.join(names)}"
        )
    sensor, assumed = source.sensor(width, height)
    values = dict(zip(names, map(float, numbers), strict=True))
    fx, fy = (values.pop("f"),) * 2 if "f" in values else (values.pop("fx"), values.pop("fy"))
    centre = values.pop("cx"), values.pop("cy")
    interior = in_pixels(source, sensor, fx, fy, centre, FISHEYE if kind in _FISHEYES else OPENCV, **values)
    return CameraFile(name, sensor, interior, None, assumed)


def colmap_camera(sensor: Sensor, interior: InteriorOrientation) -> tuple[str, int, int, list[float]]:
    """Return the simplest COLMAP model with all nonzero coefficients, width, height and parameters."""
    fx, fy, column, row = pixels_of(interior, sensor)
    d = interior.distortion
    coefficients = {k: float(getattr(d, k)) for k in d.coefficients if k not in ("b1", "b2")}
    needed = {key for key, value in coefficients.items() if value != 0} | ({"fx"} if fx != fy else set())
    models = _FISHEYES if isinstance(d, OpenCvFisheye) else _PLANES
    model = next(m for m, names in models.items() if needed <= set(names))
    values = {"fx": fx, "fy": fy, "f": fy, "cx": column, "cy": row} | coefficients
    return model, sensor.width_px, sensor.height_px, [values[key] for key in MODELS[model]]


def write_camera(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write cameras.txt; the id is `name` if it is an integer, otherwise 1."""
    model, width, height, values = colmap_camera(sensor, interior)
    identifier = int(name) if name.isascii() and name.isdigit() else 1
    line = " ".join([f"{identifier} {model} {width} {height}", *map(repr, values)])
    path.write_text(f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n{line}\n", encoding="utf-8")


# Written models -----------------------------------------------------------------------------------------------


def _written(p: Project) -> Any:
    """Build a model: images are counted from 1; numeric ids of cameras and points are retained."""
    import pycolmap

    model, camera_ids, point_ids = (
        pycolmap.Reconstruction(),
        numbered(tuple(p.cameras)),
        list(numbered(p.points).values()),
    )
    for name, camera in p.cameras.items():
        kind, width, height, params = colmap_camera(camera.sensor, camera.interior)
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=camera_ids[name], model=kind, width=width, height=height, params=params)
        )
    rotations = p.world_to_camera
    moved = translations(rotations, p.exterior.position)
    for i, rows in enumerate(p.rows_of_images):
        image = pycolmap.Image(p.files[i], p.column_row[rows], camera_ids[p.image_camera[i]], i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.column_stack([rotations[i], moved[i]])))
    tracks = np.stack([p.image + 1, p.number_in_image], axis=1).tolist()
    for identifier, xyz, rows in zip(point_ids, np.asarray(p.xyz), p.rows_of_points, strict=True):
        if len(rows):
            model.add_point3D_with_id(identifier, pycolmap.Point3D(xyz=xyz))
            for row in rows.tolist():
                model.add_observation(identifier, pycolmap.TrackElement(*tracks[row]))
    return model


def write_text(p: Project, folder: Path) -> None:
    """Write cameras.txt, images.txt, points3D.txt, and COLMAP's rigs.txt and frames.txt."""
    if blank := [name for name in p.files if len(name.split()) != 1]:
        raise InputError(f"images.txt allows no blanks, but {quoted(blank[0])} has one; write colmap-binary")
    _written(p).write_text(str(folder))


def write_binary(p: Project, folder: Path) -> None:
    """Write the same files as .bin."""
    _written(p).write_binary(str(folder))


FORMATS = (
    Format(
        "colmap", "COLMAP model: cameras, images, points3D as text", find, read, write=write_text, plane=OPENCV,
        fisheye=FISHEYE, endings=(".txt",),
    ),
    Format("colmap-binary", "the same, binary", write=write_binary, plane=OPENCV, fisheye=FISHEYE, endings=(".bin",)),
)  # fmt: skip
CAMERAS = (
    CameraFormat("colmap", CameraReader(recognise_cameras, read_camera), write_camera, OPENCV, FISHEYE, (), "# {}"),
)
