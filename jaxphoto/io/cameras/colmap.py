"""Cameras of COLMAP: `CAMERA_ID MODEL WIDTH HEIGHT PARAMS...`, a line of cameras.txt or a record of cameras.bin.

COLMAP's centre of the upper left pixel is (0.5, 0.5), as ours. All its models without fisheye are parts of
`OpenCv`, those with it of `OpenCvFisheye` on the equidistant projection.
Source: the documentation of COLMAP, "Camera models" and "Output format", and its src/colmap/sensor/models.h.
"""

import struct
from pathlib import Path
from typing import NamedTuple

from jaxphoto.camera import Equidistant, InteriorOrientation, OpenCv, OpenCvFisheye, Perspective, Sensor
from jaxphoto.errors import quoted
from jaxphoto.io.cameras.binary_file import BinaryFile
from jaxphoto.io.cameras.camera_file import CameraFile, CameraModel, CameraSource, from_centre_px, in_pixels
from jaxphoto.io.text_tables import is_number, natural

# f alone stands for both focal lengths.
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
"""The models that are known, simplest first, and the order of their parameters."""
PLANE = CameraModel(OpenCv, ("b2",), Perspective())
FISHEYE = CameraModel(OpenCvFisheye, ("b2",), Equidistant())
"""What they are here."""
PARTS = {
    name: (PLANE if name in _PLANES else FISHEYE).only(*parameters, *["b1"] * ("fx" in parameters))
    for name, parameters in MODELS.items()
}
"""What each of them is."""

TEXT, BINARY = "cameras.txt", "cameras.bin"
_COLUMNS = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
# By the number that a binary file has for it; those that are not known here for the message.
_NUMBERS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip


class ColmapCamera(NamedTuple):
    """A camera as COLMAP has it: name of its model, format in pixels, and parameters in the order of `MODELS`."""

    model: str
    width_px: int
    height_px: int
    values: tuple[float, ...]

    @property
    def named(self) -> dict[str, float]:
        """The parameters by their names."""
        return dict(zip(MODELS[self.model], self.values, strict=True))


def recognises(path: Path, text: str) -> bool:
    """Whether the file is called so, or the first line that is no comment begins with an id and the name of a model."""
    first = next((line.split() for _, line in _lines(text)), [])
    return path.name in (TEXT, BINARY) or (len(first) > 4 and first[1].isupper() and all(map(is_number, first[2:])))


def read_colmap(source: CameraSource) -> CameraFile:
    """One camera of the file, which only has to be sound in itself. Raises what `read_cameras` raises."""
    if source.path.suffix == ".bin":
        cameras = read_cameras(source)
        name = source.chosen([str(identifier) for identifier in cameras])
        camera = cameras[int(name)]
    else:
        lines = _by_id(source)
        name = source.chosen([str(identifier) for identifier in lines])
        camera = _camera(source, name, lines[int(name)])
    sensor, interior, assumed = sensor_and_interior(source, camera)
    return CameraFile(name, sensor, interior, None, assumed)


def read_cameras(source: CameraSource) -> dict[int, ColmapCamera]:
    """All cameras of cameras.txt or cameras.bin by their ids.

    Raises InputError for what is no camera, for ids that are there twice and for models that are not known here.
    """
    if source.path.suffix != ".bin":
        return {key: _camera(source, str(key), cells) for key, cells in _by_id(source).items()}
    cameras = {}
    file = BinaryFile(source.path)
    for _ in range(file.count(24)):
        identifier, number, width, height = file.take("IiQQ")
        model = _NUMBERS[number] if 0 <= number < len(_NUMBERS) else f"number {number}"
        _check_known(source, model, str(identifier))
        if identifier in cameras:
            raise source.error(f"camera {identifier} stands there twice; keep one of the two")
        cameras[identifier] = ColmapCamera(model, width, height, file.numbers(len(MODELS[model])))
    return cameras


def sensor_and_interior(source: CameraSource, camera: ColmapCamera) -> tuple[Sensor, InteriorOrientation, str]:
    """Sensor, interior orientation as `PLANE` or `FISHEYE`, and what was assumed. Raises what `in_pixels` does."""
    sensor, assumed = source.sensor(camera.width_px, camera.height_px)
    values = camera.named
    fx, fy = (values.pop("f"),) * 2 if "f" in values else (values.pop("fx"), values.pop("fy"))
    centre = values.pop("cx"), values.pop("cy")
    model = FISHEYE if camera.model in _FISHEYES else PLANE
    return sensor, in_pixels(source, sensor, fx, fy, centre, model, **values), assumed


def colmap_camera(sensor: Sensor, interior: InteriorOrientation) -> ColmapCamera:
    """A camera that is a `PLANE` or `FISHEYE` as the simplest model that holds it."""
    fx, fy, column, row = from_centre_px(interior, sensor)
    d = interior.distortion
    values = {"fx": fx, "fy": fy, "f": fy, "cx": column, "cy": row}
    coefficients = {k: float(getattr(d, k)) for k in d.coefficients if k not in ("b1", "b2")}
    needed = {key for key, value in coefficients.items() if value != 0} | ({"fx"} if fx != fy else set())
    models = _FISHEYES if isinstance(d, OpenCvFisheye) else _PLANES
    model = next(m for m, names in models.items() if needed <= set(names))
    of_model = tuple((values | coefficients)[key] for key in MODELS[model])
    return ColmapCamera(model, sensor.width_px, sensor.height_px, of_model)


def cameras_text(cameras: dict[int, ColmapCamera]) -> str:
    """The content of cameras.txt; numbers come back exactly."""
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for identifier, c in cameras.items():
        lines.append(" ".join([f"{identifier} {c.model} {c.width_px} {c.height_px}", *map(repr, c.values)]))
    return "\n".join(lines) + "\n"


def cameras_bytes(cameras: dict[int, ColmapCamera]) -> bytes:
    """The content of cameras.bin."""
    records = [struct.pack("<Q", len(cameras))]
    for identifier, c in cameras.items():
        layout = f"<IiQQ{len(c.values)}d"
        records.append(struct.pack(layout, identifier, _NUMBERS.index(c.model), c.width_px, c.height_px, *c.values))
    return b"".join(records)


def write_colmap(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write a camera that is a `PLANE` or `FISHEYE` as cameras.txt; a `name` that is a number is its id."""
    identifier = int(name) if name.isascii() and name.isdigit() else 1
    path.write_text(cameras_text({identifier: colmap_camera(sensor, interior)}), encoding="utf-8")


def _by_id(source: CameraSource) -> dict[int, list[str]]:
    """The cells of every camera's line, by its id."""
    found: dict[int, list[str]] = {}
    for row, line in _lines(source.text()):
        cells = line.split()
        identifier = natural(cells[0])
        if identifier is None:
            raise source.error(f"row {row} begins with {quoted(cells[0])}, which is no id; write {_COLUMNS}")
        if identifier in found:
            raise source.error(f"camera {identifier} stands there twice; keep one of the two lines")
        found[identifier] = cells
    return found


def _camera(source: CameraSource, name: str, cells: list[str]) -> ColmapCamera:
    if len(cells) < 4:
        raise source.error(f"camera {name} has {len(cells)} cells; write {_COLUMNS}")
    model = cells[1]
    _check_known(source, model, name)
    names = MODELS[model]
    if len(cells) != 4 + len(names):
        given = len(cells) - 4
        raise source.error(f"camera {name} has {given} parameters, {model} has {len(names)}: {', '.join(names)}")
    width, height = (source.number(f"the size of camera {name}", cell) for cell in cells[2:4])
    source.sensor(width, height)
    values = (source.number(f"{key} of camera {name}", cell) for key, cell in zip(names, cells[4:], strict=True))
    return ColmapCamera(model, int(width), int(height), tuple(values))


def _check_known(source: CameraSource, model: str, name: str) -> None:
    if model not in MODELS:
        raise source.error(f"the model {model} of camera {name} is not known here; use one of {', '.join(MODELS)}")


def _lines(text: str) -> list[tuple[int, str]]:
    """Rows and text of the lines that are neither empty nor comments."""
    numbered = enumerate(text.splitlines(), start=1)
    return [(row, line) for row, line in numbered if line.strip() and not line.lstrip().startswith("#")]
