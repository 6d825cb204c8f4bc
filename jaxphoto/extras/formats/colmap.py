"""COLMAP: `cameras`, `images` and `points3D`, all .txt or all .bin; cameras.txt or cameras.bin alone are camera files.

COLMAP's camera looks along +z, with x right and y down: x_camera = R x_world + t. Pixels are ours. All its models
without fisheye are parts of `OpenCv`, those with it of `OpenCvFisheye` on the equidistant projection. Frames and rigs
repeat the poses of the images and are not read. Written models have no colours, errors or standard deviations. Source:
the documentation of COLMAP, "Camera models" and "Output format", and its src/colmap/sensor/models.h.
"""

import math
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from jaxphoto.camera import InteriorOrientation, OpenCvFisheye, Sensor
from jaxphoto.errors import InputError, quoted
from jaxphoto.extras.formats.camera_models import OPENCV, OPENCV_FISHEYE, ProjectCamera, in_pixels, pixels_of
from jaxphoto.extras.formats.files import CameraFormat, Format, content_rows, row_numbers
from jaxphoto.extras.formats.project import Project, numbered, pose, translations
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
"""Parameters of each model in COLMAP's order, simplest model first; `f` stands for both focal lengths."""
FISHEYE = OPENCV_FISHEYE._replace(lacks=("b2",))
PARTS = {
    name: (OPENCV if name in _PLANES else FISHEYE).only(*parameters, *["b1"] * ("fx" in parameters))
    for name, parameters in MODELS.items()
}
"""Each model as part of ours."""
# By the number in a binary file; some are unknown here.
_NUMBERS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip
_PLACES = ("f", "fx", "fy", "cx", "cy")
_NO_POINT = 2**64 - 1
# Quaternions of any program have nearly unit length.
_LONGEST = 1e6
_FEATURE = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
# Colour (black) and mean error (unknown) of a written point.
_COLOUR, _ERROR = (0, 0, 0), -1


class ColmapCamera(NamedTuple):
    """A camera: model, format in pixels, and parameters in the order of `MODELS`."""

    model: str
    width_px: int
    height_px: int
    values: tuple[float, ...]


class ColmapImage(NamedTuple):
    """An image: `x_camera = R x_world + t`, its camera, and the features of points."""

    name: str
    camera: int
    quaternion: tuple[float, ...]
    """w, x, y, z of R."""
    translation: tuple[float, ...]
    xy_px: np.ndarray
    point: np.ndarray


class ColmapModel(NamedTuple):
    """The content of the three files, images sorted by name."""

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    point_ids: np.ndarray
    xyz: np.ndarray


class _Binary:
    """Little-endian records."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, read_bytes(path), 0

    def take(self, layout: str) -> tuple:
        try:
            values = struct.unpack_from("<" + layout, self.data, self.at)
        except struct.error:
            raise InputError(f"{self.path}: the file ends early. Copy it again") from None
        self.at += struct.calcsize("<" + layout)
        if not np.isfinite([v for v in values if isinstance(v, float)]).all():
            raise InputError(f"{self.path}: a number is not finite. Let COLMAP write it again")
        return values

    def count(self, size: int) -> int:
        """Number of the records that follow, of at least `size` bytes."""
        (count,) = self.take("Q")
        if count * size > len(self.data) - self.at:
            raise InputError(f"{self.path}: the file ends early. Copy it again")
        return count

    def rows(self, kind: np.dtype) -> np.ndarray:
        values = np.frombuffer(self.data, kind, self.count(kind.itemsize), self.at)
        self.at += values.nbytes
        return values

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise InputError(f"{self.path}: the file ends early. Copy it again")
        text, self.at = self.data[self.at : end].decode("utf-8", "replace"), end + 1
        return text


def find(source: Path) -> list[Path]:
    """Return the file of cameras of a model, the text if there are both kinds."""
    folder = source if source.is_dir() else source.parent if source.stem == FILES[0] else Path("/nonexistent")
    suffixes = (end for end in (".txt", ".bin") if all((folder / (name + end)).is_file() for name in FILES))
    return [folder / (FILES[0] + end) for end in suffixes][:1]


def read(path: Path) -> Project:
    """Read a model; cameras are free in what COLMAP's model has, points have COLMAP's numbers as ids."""
    model = read_model(path)
    images, ids = model.images, np.sort(model.point_ids)
    point = np.concatenate([np.zeros(0, int), *(i.point for i in images)])
    if len(missing := np.setdiff1d(point, ids)):
        raise InputError(
            f"{path.parent}: the images show {len(missing)} point(s) that points3D has not, for example {missing[0]}. "
            "Let COLMAP write the model again"
        )
    cameras = {str(k): _project_camera(path, model.cameras[k]) for k in sorted({i.camera for i in images})}
    quaternions = np.array([i.quaternion for i in images]).reshape(-1, 4)[:, [1, 2, 3, 0]]
    # SciPy before 1.17 takes no empty array.
    of = scipy.spatial.transform.Rotation.from_quat
    rotations = of(quaternions).as_matrix() if len(quaternions) else np.zeros((0, 3, 3))
    moved = np.array([i.translation for i in images]).reshape(-1, 3)
    folder = path.resolve().parent.name
    return Project(
        folder, cameras, (), [i.name for i in images], [str(i.camera) for i in images],
        pose(rotations, translations(np.swapaxes(rotations, 1, 2), moved)), ids.astype(str).tolist(),
        model.xyz[np.argsort(model.point_ids)], np.repeat(np.arange(len(images)), [len(i.point) for i in images]),
        np.searchsorted(ids, point), np.concatenate([np.zeros((0, 2)), *(i.xy_px for i in images)]), file=folder,
    )  # fmt: skip


def read_model(path: Path) -> ColmapModel:
    """Read the model of a folder, or of its file of cameras. Raise InputError for content that does not fit."""
    path = find(path)[0] if path.is_dir() else path
    images_path, points_path = (path.with_name(name + path.suffix) for name in FILES[1:])
    cameras = read_cameras(CameraSource(path))
    if path.suffix == ".txt":
        images = sorted(_text_images(images_path), key=lambda image: image.name)
        ids, xyz = _text_points(points_path)
    else:
        images = sorted(_binary_images(images_path), key=lambda image: image.name)
        ids, xyz = _binary_points(points_path)
    for image in images:
        if image.camera not in cameras:
            raise InputError(f"{path.parent}: image {image.name} is of camera {image.camera}, which is missing. Add it")
        length = math.hypot(*image.quaternion)
        if not 1 / _LONGEST < length < _LONGEST:
            raise InputError(
                f"{path.parent}: the quaternion of image {image.name} has the length {length:.3g} instead of 1. Let "
                "COLMAP write the model again"
            )
    for what, names in (("image", [i.name for i in images]), ("point", ids.tolist())):
        if twice := [name for name, times in Counter(names).items() if times > 1]:
            raise InputError(f"{path.parent}: {what} {twice[0]} is there twice. Keep one of them")
    return ColmapModel(cameras, images, ids, xyz)


def _cells_error(path: Path, row: int, count: int, expected: str) -> InputError:
    return InputError(
        f"{path}, row {row}: {count} cells instead of {expected}. Correct it or let COLMAP write it again"
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
        measured = measured[measured[:, 2] >= 0]
        ids = measured[:, 2].astype(np.int64)
        yield ColmapImage(cells[9].strip(), int(camera), tuple(numbers[:4]), tuple(numbers[4:]), measured[:, :2], ids)


def _text_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    points = []
    for row, line in content_rows(path):
        cells = line.split(maxsplit=4)[:4]
        if len(cells) < 4:
            raise _cells_error(path, row, len(cells), "POINT3D_ID X Y Z and more")
        points.append(row_numbers(path, row, cells, 4))
        if points[-1][0] % 1 or abs(points[-1][0]) >= 2**53:
            raise InputError(f"{path}, row {row}: {cells[0]} is no id. Write a whole number")
    values = np.array(points).reshape(-1, 4)
    return values[:, 0].astype(np.int64), values[:, 1:]


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    file = _Binary(path)
    for _ in range(file.count(73)):
        _, *numbers, camera = file.take("I7dI")
        name = file.name()
        features = file.rows(_FEATURE)
        features = features[features["point"] != _NO_POINT]
        if not np.isfinite(features["xy"]).all():
            raise InputError(f"{path}: image {name} has a coordinate that is not finite. Copy the file again")
        point = features["point"].astype(np.int64)
        yield ColmapImage(name, camera, tuple(numbers[:4]), tuple(numbers[4:]), features["xy"], point)


def _binary_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    file = _Binary(path)
    count = file.count(51)
    ids, xyz = np.zeros(count, np.int64), np.zeros((count, 3))
    for k in range(count):
        identifier, *xyz[k], _ = file.take("Q3d3xd")
        ids[k] = np.uint64(identifier).astype(np.int64)
        file.rows(np.dtype("<u4,<u4"))
    return ids, xyz


# Cameras ------------------------------------------------------------------------------------------------------


def recognise_cameras(path: Path, text: str) -> bool:
    """Return True for the file names of COLMAP, or if the first line is an id, a model and numbers."""
    lines = (line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    first = next(lines, [])
    named = path.name in ("cameras.txt", "cameras.bin")
    return named or (len(first) > 4 and first[1].isupper() and all(map(is_number, first[2:])))


def read_camera(source: CameraSource) -> CameraFile:
    """Read one camera of the file; the others need not be valid."""
    lines = read_cameras(source) if source.path.suffix == ".bin" else _lines_by_id(source)
    name = source.chosen([str(identifier) for identifier in lines])
    chosen = lines[int(name)]
    camera = chosen if isinstance(chosen, ColmapCamera) else _camera_of(source, name, chosen)
    sensor, interior, assumed = _sensor_and_interior(source, camera)
    return CameraFile(name, sensor, interior, None, assumed)


def read_cameras(source: CameraSource) -> dict[int, ColmapCamera]:
    """Read all cameras by id."""
    if source.path.suffix != ".bin":
        return {key: _camera_of(source, str(key), cells) for key, cells in _lines_by_id(source).items()}
    cameras: dict[int, ColmapCamera] = {}
    file = _Binary(source.path)
    for _ in range(file.count(24)):
        identifier, number, width, height = file.take("IiQQ")
        model = _NUMBERS[number] if 0 <= number < len(_NUMBERS) else f"number {number}"
        _check_known(source, model, str(identifier))
        if identifier in cameras:
            raise source.error(f"camera {identifier} stands there twice; keep one of the two")
        cameras[identifier] = ColmapCamera(model, width, height, file.take(f"{len(MODELS[model])}d"))
    return cameras


def _lines_by_id(source: CameraSource) -> dict[int, list[str]]:
    lines: dict[int, list[str]] = {}
    for row, line in content_rows(source.path):
        cells = line.split()
        identifier = int(cells[0]) if cells[0].isdecimal() else None
        if identifier is None:
            raise source.error(f"row {row} begins with {quoted(cells[0])}, which is no id")
        if identifier in lines:
            raise source.error(f"camera {identifier} stands there twice; keep one of the two lines")
        lines[identifier] = cells
    return lines


def _camera_of(source: CameraSource, name: str, cells: list[str]) -> ColmapCamera:
    if len(cells) < 4:
        raise source.error(f"camera {name} has {len(cells)} cells; write CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
    model = cells[1]
    _check_known(source, model, name)
    names = MODELS[model]
    if len(cells) != 4 + len(names):
        count = len(cells) - 4
        raise source.error(f"camera {name} has {count} parameters, {model} has {len(names)}: {', '.join(names)}")
    sensor, _ = source.sensor(*(source.number(f"the size of camera {name}", cell) for cell in cells[2:4]))
    values = (source.number(f"{key} of camera {name}", cell) for key, cell in zip(names, cells[4:], strict=True))
    return ColmapCamera(model, sensor.width_px, sensor.height_px, tuple(values))


def _check_known(source: CameraSource, model: str, name: str) -> None:
    if model not in MODELS:
        raise source.error(f"the model {model} of camera {name} is not known here; use one of {', '.join(MODELS)}")


def _sensor_and_interior(source: CameraSource, camera: ColmapCamera) -> tuple[Sensor, InteriorOrientation, str]:
    sensor, assumed = source.sensor(camera.width_px, camera.height_px)
    values = dict(zip(MODELS[camera.model], camera.values, strict=True))
    fx, fy = (values.pop("f"),) * 2 if "f" in values else (values.pop("fx"), values.pop("fy"))
    centre = values.pop("cx"), values.pop("cy")
    model = FISHEYE if camera.model in _FISHEYES else OPENCV
    return sensor, in_pixels(source, sensor, fx, fy, centre, model, **values), assumed


def _project_camera(path: Path, camera: ColmapCamera) -> ProjectCamera:
    sensor, interior, _ = _sensor_and_interior(CameraSource(path), camera)
    names = MODELS[camera.model]
    free = ["c_mm", "xp_mm", "yp_mm", *(k for k in names if k not in _PLACES)]
    return ProjectCamera(sensor, interior, (*free, *["b1"] * ("fx" in names)))


def colmap_camera(sensor: Sensor, interior: InteriorOrientation) -> ColmapCamera:
    """Return a camera in the simplest model that holds it."""
    fx, fy, column, row = pixels_of(interior, sensor)
    d = interior.distortion
    coefficients = {k: float(getattr(d, k)) for k in d.coefficients if k not in ("b1", "b2")}
    needed = {key for key, value in coefficients.items() if value != 0} | ({"fx"} if fx != fy else set())
    models = _FISHEYES if isinstance(d, OpenCvFisheye) else _PLANES
    model = next(m for m, names in models.items() if needed <= set(names))
    values = {"fx": fx, "fy": fy, "f": fy, "cx": column, "cy": row} | coefficients
    return ColmapCamera(model, sensor.width_px, sensor.height_px, tuple(values[key] for key in MODELS[model]))


def _cameras_text(cameras: dict[int, ColmapCamera]) -> str:
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for identifier, c in cameras.items():
        lines.append(" ".join([f"{identifier} {c.model} {c.width_px} {c.height_px}", *map(repr, c.values)]))
    return "\n".join(lines) + "\n"


def write_camera(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write cameras.txt; a `name` that is a number is the id."""
    identifier = int(name) if name.isascii() and name.isdigit() else 1
    path.write_text(_cameras_text({identifier: colmap_camera(sensor, interior)}), encoding="utf-8")


# Written models -----------------------------------------------------------------------------------------------


class _Point(NamedTuple):
    id: int
    xyz: list[float]
    track: np.ndarray
    """Image id and feature."""


def _model(p: Project) -> tuple[dict[int, ColmapCamera], list[ColmapImage], list[_Point]]:
    """Cameras, images in the order of their ids (from 1), and points; numeric ids of cameras and points are kept."""
    camera_ids, point_ids = numbered(tuple(p.cameras)), np.array(list(numbered(p.points).values()), int)
    rotations = p.world_to_camera
    quaternions = scipy.spatial.transform.Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]].tolist()
    moved = translations(rotations, p.exterior.position).tolist()
    images = [
        ColmapImage(
            p.files[i], camera_ids[p.image_camera[i]], tuple(quaternions[i]), tuple(moved[i]), p.column_row[rows],
            point_ids[p.point[rows]],
        )
        for i, rows in enumerate(p.rows_of_images)
    ]  # fmt: skip
    feature = p.number_in_image
    points = [
        _Point(int(identifier), xyz, np.stack([p.image[rows] + 1, feature[rows]], axis=1))
        for identifier, xyz, rows in zip(point_ids, np.asarray(p.xyz).tolist(), p.rows_of_points, strict=True)
        if len(rows)
    ]
    cameras = {camera_ids[name]: colmap_camera(c.sensor, c.interior) for name, c in p.cameras.items()}
    return cameras, images, points


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
    rows += [" ".join([str(q.id), *map(repr, q.xyz), rest, *map(str, q.track.ravel().tolist())]) for q in points]
    texts = (_cameras_text(cameras), "\n".join(lines) + "\n", "\n".join(rows) + "\n")
    for name, text in zip(FILES, texts, strict=True):
        (folder / f"{name}.txt").write_text(text, encoding="utf-8")


def write_binary(p: Project, folder: Path) -> None:
    """Write cameras.bin, images.bin and points3D.bin."""
    cameras, images, points = _model(p)
    parts = [[struct.pack("<Q", len(records))] for records in (cameras, images, points)]
    for identifier, c in cameras.items():
        layout = f"<IiQQ{len(c.values)}d"
        parts[0].append(struct.pack(layout, identifier, _NUMBERS.index(c.model), c.width_px, c.height_px, *c.values))
    for k, image in enumerate(images, 1):
        features = np.zeros(len(image.point), _FEATURE)
        features["xy"], features["point"] = image.xy_px, image.point
        head = struct.pack("<I7dI", k, *image.quaternion, *image.translation, image.camera)
        parts[1] += [head, image.name.encode() + b"\0", struct.pack("<Q", len(features)), features.tobytes()]
    for q in points:
        head = struct.pack("<Q3d3BdQ", q.id, *q.xyz, *_COLOUR, _ERROR, len(q.track))
        parts[2] += [head, q.track.astype("<u4").tobytes()]
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
