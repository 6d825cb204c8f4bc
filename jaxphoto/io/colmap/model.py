"""The three files of a COLMAP model, `cameras`, `images` and `points3D`, as .txt or as .bin, read into arrays.

Frames and rigs, which newer models have beside them, repeat the poses of the images and are not read.
Source: the documentation of COLMAP, "Output format".
"""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.errors import InputError
from jaxphoto.io.cameras.binary_file import BinaryFile
from jaxphoto.io.cameras.camera_file import CameraSource
from jaxphoto.io.cameras.colmap import ColmapCamera, read_cameras

FILES = ("cameras", "images", "points3D")
# What a binary file has for a feature that is of no point.
_NO_POINT = 2**64 - 1
# Programs write quaternions of length 1, people now and then others; what is far from all of them is damaged.
_LONGEST = 1e6


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
    return any(all((source / (name + suffix)).is_file() for name in FILES) for suffix in (".txt", ".bin"))


def read_model(folder: Path) -> ColmapModel:
    """The model in `folder`, from the text where it has both kinds. Raises InputError for what cannot be read."""
    if not recognises(folder):
        raise InputError(
            f"{folder} has not {', '.join(FILES)}, all .txt or all .bin; give the folder of a COLMAP model"
        )
    if all((folder / f"{name}.txt").is_file() for name in FILES):
        images, points = (_Text(folder / f"{name}.txt") for name in FILES[1:])
        model = ColmapModel(
            folder, read_cameras(CameraSource(folder / "cameras.txt")), _text_images(images), *_text_points(points)
        )
    else:
        images_bin, points_bin = (BinaryFile(folder / f"{name}.bin") for name in FILES[1:])
        cameras = read_cameras(CameraSource(folder / "cameras.bin"))
        model = ColmapModel(folder, cameras, _binary_images(images_bin), *_binary_points(points_bin))
    return _sound(model._replace(images=sorted(model.images, key=lambda image: image.name)))


def _sound(model: ColmapModel) -> ColmapModel:
    """The model itself. Raises InputError for what does not fit together."""
    for image in model.images:
        if image.camera not in model.cameras:
            missing = f"{model.folder}: image {image.name} is of camera {image.camera}, which is missing; add it"
            raise InputError(missing)
        length = math.hypot(*image.quaternion)
        if not 1 / _LONGEST < length < _LONGEST:
            raise InputError(
                f"{model.folder}: the quaternion of image {image.name} has the length {length:.3g} instead of 1, which "
                "is no rotation; let COLMAP write the model again"
            )
    for what, ids in (("image", [i.name for i in model.images]), ("point", model.point_ids.tolist())):
        for value, times in Counter(ids).items():
            if times > 1:
                raise InputError(f"{model.folder}: {what} {value} is there twice; keep one of them")
    return model


class _Text:
    """The lines of a text file that are no comment, with their rows."""

    def __init__(self, path: Path):
        self.path = path
        lines = CameraSource(path).text().split("\n")
        self.lines = iter([(row, line) for row, line in enumerate(lines, 1) if not line.lstrip().startswith("#")])
        self.row = 0

    def __iter__(self) -> Iterator[str]:
        """The lines that are not empty."""
        for row, line in self.lines:
            self.row = row
            if line.strip():
                yield line

    def next_line(self) -> list[str]:
        """The cells of the line that follows, none where it is empty or the file ends."""
        self.row, line = next(self.lines, (self.row + 1, ""))
        return line.split()

    def numbers(self, cells: list[str]) -> np.ndarray:
        try:
            values = np.array(cells, float)
        except ValueError:
            values = np.array([np.nan])
        if not np.isfinite(values).all():
            raise self.error("there is a cell that is no finite number")
        return values

    def ids(self, cells: list[str]) -> np.ndarray:
        try:
            return np.array(cells, object).astype(np.int64)
        except (ValueError, OverflowError):
            raise self.error("an id is a whole number") from None

    def error(self, message: str) -> InputError:
        return InputError(f"{self.path}, row {self.row}: {message}; correct the file or let COLMAP write it again")


def _text_images(file: _Text) -> list[ColmapImage]:
    images = []
    for line in file:
        cells = line.split(maxsplit=9)
        if len(cells) < 10:
            raise file.error(f"{len(cells)} cells instead of IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        pose = file.numbers(cells[1:8]).tolist()
        camera = int(file.ids(cells[8:9])[0])
        features = file.next_line()
        if len(features) % 3:
            raise file.error(f"{len(features)} cells are not X Y POINT3D_ID of some features")
        measured = file.numbers(features).reshape(-1, 3)
        ids = file.ids(features[2::3])
        of_point = ids >= 0
        images.append(
            ColmapImage(
                cells[9].strip(), camera, tuple(pose[:4]), tuple(pose[4:]), measured[of_point, :2], ids[of_point]
            )
        )
    return images


def _text_points(file: _Text) -> tuple[np.ndarray, np.ndarray]:
    ids, xyz = [], []
    for line in file:
        cells = line.split(maxsplit=4)
        if len(cells) < 4:
            raise file.error(f"{len(cells)} cells instead of POINT3D_ID X Y Z and more")
        ids.append(file.ids(cells[:1])[0])
        xyz.append(file.numbers(cells[1:4]))
    return np.array(ids, np.int64), np.array(xyz, float).reshape(-1, 3)


def _binary_images(file: BinaryFile) -> list[ColmapImage]:
    images = []
    for _ in range(file.count(73)):
        file.take("I")
        pose, camera = file.numbers(7), file.take("I")[0]
        name = file.text()
        features = file.rows([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
        features = features[features["point"] != _NO_POINT]
        xy = np.stack([features["x"], features["y"]], axis=1)
        if not np.isfinite(xy).all():
            raise file.error(f"image {name} has a coordinate that is not finite")
        images.append(ColmapImage(name, camera, pose[:4], pose[4:], xy, features["point"].astype(np.int64)))  # type: ignore[arg-type]
    return images


def _binary_points(file: BinaryFile) -> tuple[np.ndarray, np.ndarray]:
    count = file.count(51)
    ids, xyz = np.zeros(count, np.int64), np.zeros((count, 3))
    for k in range(count):
        identifier = file.take("Q")[0]
        ids[k], xyz[k] = np.uint64(identifier).astype(np.int64), file.numbers(3)
        file.take("3xd")
        file.rows([("image", "<u4"), ("feature", "<u4")])
    return ids, xyz
