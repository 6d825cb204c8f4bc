"""COLMAP models: `cameras`, `images` and `points3D`, all .txt or all .bin. A single cameras file is a camera file.

COLMAP's camera axes are x right, y down, z forward: x_camera = R x_world + t. Pixel coordinates are the same as ours.
Its perspective models are special cases of `OpenCv`, its fisheye models of `OpenCvFisheye` with the equidistant
projection. Frames and rigs repeat the image poses and are not read. Exported models have no colours, errors or standard
deviations. Source: COLMAP documentation, "Camera models" and "Output format"; src/colmap/sensor/models.h.
"""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

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
from jaxphoto.io.text_files import read_bytes, read_legacy_text
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
PARTS = {
    name: (OPENCV if name in _PLANES else FISHEYE).only(*parameters, *["b1"] * ("fx" in parameters))
    for name, parameters in MODELS.items()
}
"""Distortion and projection of each COLMAP model."""
# Model names by model id in binary files; some are not supported here.
_NUMBERS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip
_PLACES = ("f", "fx", "fy", "cx", "cy")
_NO_POINT = -1
_FEATURE = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
# Colour (black) and mean error (unknown) of exported points.
_COLOUR, _ERROR = (0, 0, 0), -1


class ColmapImage(NamedTuple):
    """Image: pose `x_camera = R x_world + t`, its camera, and the features that have an object point."""

    name: str
    camera: int
    quaternion: Sequence[float]
    """w, x, y, z of R."""
    translation: Sequence[float]
    xy_px: np.ndarray
    point: np.ndarray


class _Binary:
    """Reader of little-endian records."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, read_bytes(path), 0

    def take(self, layout: str) -> tuple:
        try:
            values = struct.unpack_from("<" + layout, self.data, self.at)
        except struct.error:
            raise InputError(f"{self.path}: the file ends early. Copy it again") from None
        self.at += struct.calcsize("<" + layout)
        return values

    def rows(self, kind: np.dtype) -> np.ndarray:
        (count,) = self.take("Q")
        data = self.data[self.at : self.at + count * kind.itemsize]
        if len(data) < count * kind.itemsize:
            raise InputError(f"{self.path}: the file ends early. Copy it again")
        self.at += len(data)
        return np.frombuffer(data, kind)

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        text, self.at = self.data[self.at : end], end + 1
        return text.decode("utf-8", "replace")


def find(source: Path) -> list[Path]:
    """Return the cameras file of a model; .txt is preferred to .bin."""
    if source.is_file() and source.stem != FILES[0]:
        return []
    folder = source if source.is_dir() else source.parent
    suffixes = (end for end in (".txt", ".bin") if all((folder / (name + end)).is_file() for name in FILES))
    return [folder / (FILES[0] + end) for end in suffixes][:1]


def read(path: Path) -> Project:
    """Read a model; free camera parameters are the parameters of COLMAP's model, point ids are COLMAP's ids."""
    images_path, points_path = (path.with_name(name + path.suffix) for name in FILES[1:])
    text, source, folder = path.suffix == ".txt", CameraSource(path), path.resolve().parent.name
    cameras, models = read_cameras(source), dict[str, ProjectCamera]()
    images = sorted((_text_images if text else _binary_images)(images_path), key=lambda image: image.name)
    ids, xyz = (_text_points if text else _binary_points)(points_path)
    point = np.concatenate([np.zeros(0, int), *(i.point for i in images)])
    if len(missing := np.setdiff1d(point, ids)):
        raise InputError(
            f"{path.parent}: {len(missing)} point(s) of the images are missing in points3D, for example {missing[0]}. "
            "Export the model from COLMAP again"
        )
    for image in images:
        if image.camera not in cameras:
            raise InputError(f"{path.parent}: camera {image.camera} of image {image.name} is missing. Add it")
        model, *_ = cameras[image.camera]
        names = MODELS[model]
        free = ["c_mm", "xp_mm", "yp_mm", *(k for k in names if k not in _PLACES), *["b1"] * ("fx" in names)]
        camera = _camera_file(source, str(image.camera), cameras[image.camera])
        models[camera.name] = ProjectCamera(camera.sensor, camera.interior, tuple(free))
    quaternions = np.array([i.quaternion for i in images]).reshape(-1, 4)[:, [1, 2, 3, 0]]
    # SciPy before 1.17 rejects empty arrays.
    of = scipy.spatial.transform.Rotation.from_quat
    rotations = of(quaternions).as_matrix() if len(quaternions) else np.zeros((0, 3, 3))
    moved = np.array([i.translation for i in images]).reshape(-1, 3)
    order = np.argsort(ids)
    return Project(
        folder, models, (), [i.name for i in images], [str(i.camera) for i in images],
        pose(rotations, translations(np.swapaxes(rotations, 1, 2), moved)), ids[order].astype(str).tolist(), xyz[order],
        np.repeat(np.arange(len(images)), [len(i.point) for i in images]), np.searchsorted(ids[order], point),
        np.concatenate([np.zeros((0, 2)), *(i.xy_px for i in images)]), file=folder,
    )  # fmt: skip


def _cells_error(path: Path, row: int, count: int, expected: str) -> InputError:
    return InputError(
        f"{path}, row {row}: {count} cells instead of {expected}. Correct it or export it from COLMAP again"
    )


def _text_images(path: Path) -> Iterator[ColmapImage]:
    numbered_lines = enumerate(read_legacy_text(path).split("\n"), 1)
    lines = iter([(row, line) for row, line in numbered_lines if not line.lstrip().startswith("#")])
    for row, line in lines:
        if not line.strip():
            continue
        cells = line.split(maxsplit=9)
        if len(cells) < 10:
            raise _cells_error(path, row, len(cells), "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        *numbers, camera = row_numbers(path, row, cells[1:9], 8)
        row, line = next(lines, (row + 1, ""))
        features = line.split()
        if len(features) % 3:
            raise _cells_error(path, row, len(features), "X Y POINT3D_ID of some features")
        measured = np.array(row_numbers(path, row, features, len(features))).reshape(-1, 3)
        measured = measured[measured[:, 2] != _NO_POINT]
        ids = measured[:, 2].astype(np.int64)
        yield ColmapImage(cells[9].strip(), int(camera), numbers[:4], numbers[4:], measured[:, :2], ids)


def _text_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    points = []
    for row, line in content_rows(path):
        cells = line.split(maxsplit=4)[:4]
        if len(cells) < 4:
            raise _cells_error(path, row, len(cells), "POINT3D_ID X Y Z and more")
        points.append(row_numbers(path, row, cells, 4))
    values = np.array(points).reshape(-1, 4)
    return values[:, 0].astype(np.int64), values[:, 1:]


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    file = _Binary(path)
    for _ in range(*file.take("Q")):
        _, *numbers, camera = file.take("I7dI")
        name, features = file.name(), file.rows(_FEATURE)
        features = features[features["point"] != _NO_POINT]
        yield ColmapImage(name, camera, numbers[:4], numbers[4:], features["xy"], features["point"].astype(np.int64))


def _binary_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    file, ids, xyz = _Binary(path), list[int](), list[list[float]]()
    for _ in range(*file.take("Q")):
        identifier, *at, _ = file.take("q3d3xd")
        ids.append(identifier)
        xyz.append(at)
        file.rows(np.dtype("<u4,<u4"))
    return np.array(ids, np.int64), np.array(xyz).reshape(-1, 3)


# Cameras ------------------------------------------------------------------------------------------------------


def recognise_cameras(path: Path, text: str) -> bool:
    """Return True for COLMAP's file names, or if the first line is an id, a model and numeric values."""
    lines = (line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    first = next(lines, [])
    named = path.name in ("cameras.txt", "cameras.bin")
    return named or (len(first) > 4 and first[1].isupper() and all(map(is_number, first[2:])))


def read_camera(source: CameraSource) -> CameraFile:
    """Read one camera."""
    cameras = read_cameras(source)
    name = source.chosen([str(identifier) for identifier in cameras])
    return _camera_file(source, name, cameras[int(name)])


def read_cameras(source: CameraSource) -> dict[int, tuple[str, float, float, list[float]]]:
    """Return model, width, height and parameters of all cameras by id."""
    cameras: dict[int, tuple[str, float, float, list[float]]] = {}
    if source.path.suffix == ".bin":
        file = _Binary(source.path)
        for _ in range(*file.take("Q")):
            identifier, number, width, height = file.take("IiQQ")
            model = _NUMBERS[number] if 0 <= number < len(_NUMBERS) else f"number {number}"
            names = _names(source, model, identifier)
            cameras[identifier] = model, width, height, list(file.take(f"{len(names)}d"))
        return cameras
    for row, line in content_rows(source.path):
        cells = line.split()
        if not cells[0].isdecimal() or len(cells) < 4:
            raise source.error(f"row {row}: {quoted(line)}; write CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        if (identifier := int(cells[0])) in cameras:
            raise source.error(f"duplicate camera {identifier}; keep one of the two lines")
        names, count = _names(source, cells[1], identifier), len(cells) - 4
        if count != len(names):
            raise source.error(
                f"camera {identifier} has {count} parameters instead of the {len(names)} of {cells[1]}: "
                f"{', '.join(names)}"
            )
        width, height, *values = row_numbers(source.path, row, cells[2:], 2 + count)
        cameras[identifier] = cells[1], width, height, values
    return cameras


def _names(source: CameraSource, model: str, identifier: int) -> tuple[str, ...]:
    if model not in MODELS:
        raise source.error(f"model {model} of camera {identifier} is not supported; use one of {', '.join(MODELS)}")
    return MODELS[model]


def _camera_file(source: CameraSource, name: str, camera: tuple[str, float, float, list[float]]) -> CameraFile:
    kind, width, height, numbers = camera
    sensor, assumed = source.sensor(width, height)
    values = {key: source.number(key, value) for key, value in zip(MODELS[kind], numbers, strict=True)}
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


def _cameras_text(cameras: dict[int, tuple[str, int, int, list[float]]]) -> str:
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for identifier, (model, width, height, values) in cameras.items():
        lines.append(" ".join([f"{identifier} {model} {width} {height}", *map(repr, values)]))
    return "\n".join(lines) + "\n"


def write_camera(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write cameras.txt; the id is `name` if it is an integer, otherwise 1."""
    identifier = int(name) if name.isascii() and name.isdigit() else 1
    path.write_text(_cameras_text({identifier: colmap_camera(sensor, interior)}), encoding="utf-8")


# Written models -----------------------------------------------------------------------------------------------

_Points = list[tuple[int, list[float], np.ndarray]]
"""Id, coordinates and track (image id and feature index) of each point."""


def _model(p: Project) -> tuple[dict[int, tuple[str, int, int, list[float]]], list[ColmapImage], _Points]:
    """Return cameras, images by id (from 1), and points; numeric ids of cameras and points are retained."""
    camera_ids, point_ids = numbered(tuple(p.cameras)), np.array(list(numbered(p.points).values()), int)
    rotations = p.world_to_camera
    quaternions = scipy.spatial.transform.Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]].tolist()
    moved = translations(rotations, p.exterior.position).tolist()
    cameras = [camera_ids[name] for name in p.image_camera]
    heads = zip(p.files, cameras, quaternions, moved, strict=True)
    images = [
        ColmapImage(*head, p.column_row[rows], point_ids[p.point[rows]])
        for head, rows in zip(heads, p.rows_of_images, strict=True)
    ]
    tracks = np.stack([p.image + 1, p.number_in_image], axis=1)
    every = zip(point_ids.tolist(), np.asarray(p.xyz).tolist(), p.rows_of_points, strict=True)
    points = [(identifier, xyz, tracks[rows]) for identifier, xyz, rows in every if len(rows)]
    return {camera_ids[name]: colmap_camera(c.sensor, c.interior) for name, c in p.cameras.items()}, images, points


def write_text(p: Project, folder: Path) -> None:
    """Write cameras.txt, images.txt and points3D.txt."""
    cameras, images, points = _model(p)
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for k, image in enumerate(images, 1):
        numbers = " ".join(map(repr, (*image.quaternion, *image.translation)))
        features = zip(image.xy_px.tolist(), image.point.tolist(), strict=True)
        lines.append(f"{k} {numbers} {image.camera} {image.name}")
        lines.append(" ".join(f"{column!r} {row!r} {point}" for (column, row), point in features))
    rest = " ".join(map(str, (*_COLOUR, _ERROR)))
    rows = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    rows += [" ".join([str(k), *map(repr, xyz), rest, *map(str, track.ravel().tolist())]) for k, xyz, track in points]
    texts = (_cameras_text(cameras), "\n".join(lines) + "\n", "\n".join(rows) + "\n")
    for name, text in zip(FILES, texts, strict=True):
        (folder / f"{name}.txt").write_text(text, encoding="utf-8")


def write_binary(p: Project, folder: Path) -> None:
    """Write cameras.bin, images.bin and points3D.bin."""
    cameras, images, points = _model(p)
    parts = [[struct.pack("<Q", len(records))] for records in (cameras, images, points)]
    for identifier, (model, width, height, values) in cameras.items():
        parts[0].append(struct.pack(f"<IiQQ{len(values)}d", identifier, _NUMBERS.index(model), width, height, *values))
    for k, image in enumerate(images, 1):
        features = np.zeros(len(image.point), _FEATURE)
        features["xy"], features["point"] = image.xy_px, image.point
        head = struct.pack("<I7dI", k, *image.quaternion, *image.translation, image.camera)
        parts[1] += [head, image.name.encode() + b"\0", struct.pack("<Q", len(features)), features.tobytes()]
    for identifier, xyz, track in points:
        head = struct.pack("<Q3d3BdQ", identifier, *xyz, *_COLOUR, _ERROR, len(track))
        parts[2] += [head, track.astype("<u4").tobytes()]
    for name, content in zip(FILES, parts, strict=True):
        (folder / f"{name}.bin").write_bytes(b"".join(content))


FORMATS = (
    Format(
        "colmap", "COLMAP model: cameras, images, points3D as text", find, read, write=write_text, plane=OPENCV,
        fisheye=FISHEYE, endings=(".txt",),
    ),
    Format("colmap-binary", "the same, binary", write=write_binary, plane=OPENCV, fisheye=FISHEYE, endings=(".bin",)),
)  # fmt: skip
CAMERAS = (
    CameraFormat(
        "colmap", CameraReader(recognise_cameras, read_camera), write_camera, OPENCV, FISHEYE, (), "# {}", PARTS
    ),
)
