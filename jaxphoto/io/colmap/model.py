"""The three files of a COLMAP model, `cameras`, `images` and `points3D`, as .txt or as .bin, read into arrays.

Frames and rigs, which newer models have beside them, repeat the poses of the images and are not read.
Source: the documentation of COLMAP, "Output format".
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.errors import InputError
from jaxphoto.io.cameras.colmap import MODELS

_FILES = ("cameras", "images", "points3D")
# By the number that a binary file has for it; those that are not known here for the message.
_MODEL_NUMBERS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip
# What a binary file has for a feature that is of no point.
_NO_POINT = 2**64 - 1


class ColmapCamera(NamedTuple):
    """A camera: the name of its model, its format in pixels and its parameters in the order of `MODELS`."""

    model: str
    width_px: int
    height_px: int
    values: tuple[float, ...]


class ColmapImage(NamedTuple):
    """An image: `x_camera = R x_world + t`, its camera, and the features that are of points."""

    name: str
    camera: int
    quaternion: tuple[float, float, float, float]
    """w, x, y, z of R."""
    translation: tuple[float, float, float]
    xy_px: Float[np.ndarray, "n 2"]
    """Column and row; the centre of the upper left pixel is (0.5, 0.5)."""
    point: Int[np.ndarray, "n"]


class ColmapModel(NamedTuple):
    """What the files of a folder say: cameras by their ids, images sorted by name."""

    folder: Path
    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    point_ids: Int[np.ndarray, "n"]
    xyz: Float[np.ndarray, "n 3"]


def recognises(source: Path) -> bool:
    """Whether `source` is a folder with the three files of a model, all text or all binary."""
    return any(all((source / (name + suffix)).is_file() for name in _FILES) for suffix in (".txt", ".bin"))


def read_model(folder: Path) -> ColmapModel:
    """The model in `folder`, from the text where it has both kinds. Raises InputError for what cannot be read."""
    if not recognises(folder):
        raise InputError(
            f"{folder} has not {', '.join(_FILES)}, all .txt or all .bin; give the folder of a COLMAP model"
        )
    if all((folder / f"{name}.txt").is_file() for name in _FILES):
        cameras, images, points = (_Text(folder / f"{name}.txt") for name in _FILES)
        return _sorted(ColmapModel(folder, _text_cameras(cameras), _text_images(images), *_text_points(points)))
    cameras_bin, images_bin, points_bin = (_Binary(folder / f"{name}.bin") for name in _FILES)
    parts = _binary_cameras(cameras_bin), _binary_images(images_bin), *_binary_points(points_bin)
    return _sorted(ColmapModel(folder, *parts))


def _sorted(model: ColmapModel) -> ColmapModel:
    return model._replace(images=sorted(model.images, key=lambda image: image.name))


def _check_known(place: str, model: str) -> None:
    """Raise InputError for the model of a camera that is not known here, as those of fish-eye lenses."""
    if model not in MODELS:
        raise InputError(f"{place}: the model {model} is not known here; let COLMAP use one of {', '.join(MODELS)}")


class _Text:
    """The lines of a text file that are no comment, with their rows."""

    def __init__(self, path: Path):
        self.path = path
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except UnicodeDecodeError:
            raise InputError(f"{path}: the file is no text; give a model as COLMAP writes it") from None
        self.lines = iter([(row, line) for row, line in enumerate(lines, 1) if not line.lstrip().startswith("#")])
        self.row = 0

    def __iter__(self) -> Iterator[list[str]]:
        """The cells of the lines that are not empty."""
        for row, line in self.lines:
            self.row = row
            if line.strip():
                yield line.split()

    def next_line(self) -> list[str]:
        """The cells of the line that follows, none where it is empty or the file ends."""
        self.row, line = next(self.lines, (self.row + 1, ""))
        return line.split()

    def numbers(self, cells: list[str], whole: bool = False) -> np.ndarray:
        try:
            values = np.array(cells, float)
        except ValueError:
            values = np.array([np.nan])
        if not np.isfinite(values).all():
            raise self.error("there is a cell that is no finite number")
        if not whole:
            return values
        if (values != np.floor(values)).any():
            raise self.error("an id is a whole number")
        return values.astype(int)

    def error(self, message: str) -> InputError:
        return InputError(f"{self.path}, row {self.row}: {message}; correct the file or let COLMAP write it again")


def _text_cameras(file: _Text) -> dict[int, ColmapCamera]:
    cameras = {}
    for cells in file:
        if len(cells) < 4:
            raise file.error(f"{len(cells)} cells instead of CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        _check_known(f"{file.path}, row {file.row}", cells[1])
        identifier, width, height = file.numbers([cells[0], *cells[2:4]], whole=True).tolist()
        values = file.numbers(cells[4:])
        if len(values) != len(MODELS[cells[1]]):
            raise file.error(f"{len(values)} parameters, {cells[1]} has {len(MODELS[cells[1]])}")
        cameras[identifier] = ColmapCamera(cells[1], width, height, tuple(values.tolist()))
    return cameras


def _text_images(file: _Text) -> list[ColmapImage]:
    images = []
    for cells in file:
        if len(cells) < 10:
            raise file.error(f"{len(cells)} cells instead of IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        pose = file.numbers(cells[1:8]).tolist()
        camera = int(file.numbers(cells[8:9], whole=True)[0])
        features = file.next_line()
        if len(features) % 3:
            raise file.error(f"{len(features)} cells are not X Y POINT3D_ID of some features")
        measured = file.numbers(features).reshape(-1, 3)
        ids = file.numbers(features[2::3], whole=True)
        of_point = ids >= 0
        images.append(
            ColmapImage(
                " ".join(cells[9:]), camera, tuple(pose[:4]), tuple(pose[4:]), measured[of_point, :2], ids[of_point]
            )
        )
    return images


def _text_points(file: _Text) -> tuple[np.ndarray, np.ndarray]:
    ids, xyz = [], []
    for cells in file:
        if len(cells) < 4:
            raise file.error(f"{len(cells)} cells instead of POINT3D_ID X Y Z and more")
        ids.append(cells[0])
        xyz.append(cells[1:4])
    return file.numbers(ids, whole=True), file.numbers([cell for row in xyz for cell in row]).reshape(-1, 3)


class _Binary:
    """The bytes of a file, little-endian, read one after the other."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, layout: str) -> tuple:
        """The values of a `struct` layout."""
        try:
            values = struct.unpack_from("<" + layout, self.data, self.at)
        except struct.error:
            raise self.short() from None
        self.at += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        """What comes before the next zero."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.short()
        text = self.data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return text

    def rows(self, dtype: list[tuple[str, str]], count: int) -> np.ndarray:
        """`count` records."""
        kind = np.dtype(dtype)
        if self.at + count * kind.itemsize > len(self.data):
            raise self.short()
        values = np.frombuffer(self.data, kind, count, self.at)
        self.at += count * kind.itemsize
        return values

    def short(self) -> InputError:
        return InputError(f"{self.path}: the file ends early; copy it again or let COLMAP write it again")


def _binary_cameras(file: _Binary) -> dict[int, ColmapCamera]:
    cameras = {}
    for _ in range(file.take("Q")[0]):
        identifier, number, width, height = file.take("IiQQ")
        model = _MODEL_NUMBERS[number] if 0 <= number < len(_MODEL_NUMBERS) else f"number {number}"
        _check_known(f"{file.path}, camera {identifier}", model)
        cameras[identifier] = ColmapCamera(model, width, height, file.take(f"{len(MODELS[model])}d"))
    return cameras


def _binary_images(file: _Binary) -> list[ColmapImage]:
    images = []
    for _ in range(file.take("Q")[0]):
        _, *pose, camera = file.take("I7dI")
        name = file.text()
        features = file.rows([("x", "<f8"), ("y", "<f8"), ("point", "<u8")], file.take("Q")[0])
        features = features[features["point"] != _NO_POINT]
        xy = np.stack([features["x"], features["y"]], axis=1)
        images.append(
            ColmapImage(name, camera, tuple(pose[:4]), tuple(pose[4:]), xy, features["point"].astype(np.int64))
        )
    return images


def _binary_points(file: _Binary) -> tuple[np.ndarray, np.ndarray]:
    count = file.take("Q")[0]
    ids, xyz = np.zeros(count, np.int64), np.zeros((count, 3))
    for k in range(count):
        ids[k], *xyz[k], _, length = file.take("Q3d3xdQ")
        file.rows([("image", "<u4"), ("feature", "<u4")], length)
    return ids, xyz
