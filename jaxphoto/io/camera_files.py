"""Camera files: results, block.toml, and a registry of readers for formats of other programs.

`jaxphoto.extras.formats` registers its formats in `CAMERA_READERS` when it is imported.
"""

import importlib
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxphoto.arrays import as_jax_array
from jaxphoto.camera import InteriorOrientation, Sensor, constant_names, empty_camera, parameter_names, set_parameter
from jaxphoto.errors import InputError, JaxphotoError, quoted
from jaxphoto.io.block_folder.camera_section import Camera, camera_section, known_together, read_sensor
from jaxphoto.io.block_folder.settings import read_settings
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.result_tables import SUMMARY, read_summary, reservation
from jaxphoto.io.text_files import read_json, read_text
from jaxphoto.io.text_tables import LARGEST, read_csv
from jaxphoto.io.toml import Section, read_toml, toml_text
from jaxphoto.unknowns import FIXED

ASSUMED_PIXEL_MM = 0.001
"""Default pixel size if none is specified; c in micrometres then equals the focal length in pixels."""
INTERIOR, CAMERA = "interior.csv", "camera.toml"
CAMERAS_READ = (
    "OpenCV's and ROS' YAML, COLMAP's cameras.txt, Agisoft's XML, mrcal's .cameramodel, a SMAC report, interior.csv "
    "and block.toml"
)
"""Formats that `read_camera_file` reads, for messages and help."""
_IN_FOLDER = (INTERIOR, TOML, CAMERA, "cameras.txt", "cameras.bin")
_LARGEST_SIDE_PX = 1e7
_CORRELATION = ("parameter_a", "parameter_b", "rho")
_ROUNDING = 1e-5


class SeveralCamerasError(InputError):
    """Error: a file contains several cameras, and none was selected."""


class CameraFile(NamedTuple):
    """A camera read from a file."""

    name: str
    sensor: Sensor
    interior: InteriorOrientation
    covariance: Float[np.ndarray, "n n"] | None = None
    """Covariance of `parameter_names(interior)`, zero rows for fixed parameters; None if not in the file."""
    note: str = ""
    """Assumptions of the reader and warnings about the camera; "" if none."""


class CameraSource(NamedTuple):
    """A camera file and the user's options."""

    path: Path
    camera: str | None = None
    pixel_mm: float | None = None
    size_px: tuple[int, int] | None = None
    block: Path | None = None
    """Block folder or block.toml with the camera model of interior.csv."""

    def error(self, message: str) -> InputError:
        """Return an error about this file."""
        return InputError(f"{self.path}: {message}")

    def text(self) -> str:
        """Read the text. Raise InputError for a binary file."""
        return read_text(self.path)

    def number(self, name: str, text: Any) -> float:
        """Parse a finite number in the file. Raise InputError for other text."""
        try:
            value = float(text)
        except (TypeError, ValueError, OverflowError):
            value = np.nan
        if not abs(value) <= LARGEST:
            raise self.error(f"{name} is {quoted(text)}, not a finite number; write it like 12.34")
        return value

    def chosen(self, names: list[str]) -> str:
        """Return the requested camera of `names`, or the only one. Raise InputError otherwise."""
        listed = ", ".join(names)
        if not names:
            raise self.error("no camera in the file; give a file with one")
        if self.camera is None and len(names) > 1:
            raise SeveralCamerasError(f"{self.path}: {len(names)} cameras in the file; choose one of {listed}")
        if self.camera not in (None, *names):
            raise self.error(f"unknown camera {quoted(self.camera)}; choose one of {listed}")
        return self.camera or names[0]

    def sensor(self, width: float, height: float, pixel_mm: float | None = None) -> tuple[Sensor, str]:
        """Return the sensor, and a note if its pixel size is assumed. The user's pixel size overrides `pixel_mm`."""
        if self.size_px is not None and self.size_px != (width, height):
            size = "{} x {}".format(*self.size_px)
            raise self.error(f"image size is {width:g} x {height:g} px, not {size}; remove the size")
        if not all(0 < side <= _LARGEST_SIDE_PX and side == int(side) for side in (width, height)):
            raise self.error(f"image size {width:g} x {height:g} px is invalid; give positive whole numbers")
        pixel = self.pixel_mm if self.pixel_mm is not None else pixel_mm
        if pixel is None:
            note = f"the pixel size is unknown; {ASSUMED_PIXEL_MM} mm was assumed, and c_mm scales with it"
            return Sensor(int(width), int(height), ASSUMED_PIXEL_MM, pixel_assumed=True), note
        if not 0 < pixel < np.inf:
            raise self.error(f"pixel size {pixel:g} mm is invalid; give it in millimetres")
        return Sensor(int(width), int(height), float(pixel)), ""


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Convert any exception due to invalid content into an InputError about the file."""
    try:
        yield
    except JaxphotoError:
        raise
    except (ValueError, TypeError, LookupError, ArithmeticError, AttributeError, RecursionError, SyntaxError) as error:
        raise InputError(
            f"{path.name}: damaged, or not a {what} ({type(error).__name__}: {error}). Export it again"
        ) from error


def joined_notes(*notes: str) -> str:
    """Join nonempty notes by semicolons."""
    return "; ".join(note for note in notes if note)


class CameraReader(NamedTuple):
    """A reader, and its predicate for name and content of a file."""

    recognise: Callable[[Path, str], bool]
    read: Callable[[CameraSource], CameraFile]


def camera_readers() -> dict[str, CameraReader]:
    """Return all readers by format; import the readers for other programs first."""
    importlib.import_module("jaxphoto.extras.formats")
    return CAMERA_READERS


def is_camera_file(path: Path) -> bool:
    """Return True if a file is a camera file, but not block.toml."""
    try:
        text = CameraSource(path).text()
    except InputError:
        return False
    return any(reader.recognise(path, text) for name, reader in camera_readers().items() if name != "block")


def read_camera_file(
    path: str | Path,
    *,
    camera: str | None = None,
    pixel_mm: float | None = None,
    size_px: tuple[int, int] | None = None,
    block: str | Path | None = None,
) -> CameraFile:
    """Read the camera in a file of another program (docs/formats.md) or of jaxphoto.

    The format is detected from the content. `path` may also be a result folder, a flight folder, a block folder or a
    COLMAP model. `camera` selects one of several cameras. `pixel_mm` and `size_px` supply values that the file lacks.
    `block` supplies the camera model of an interior.csv without summary.json.

    Raises InputError for missing or damaged files, unknown formats and models, and missing values.
    """
    path = Path(path)
    if path.is_dir():
        path = results_in(path)
        inside = [path / name for name in _IN_FOLDER if (path / name).is_file()]
        if not inside:
            raise InputError(f"{path} contains none of {', '.join(_IN_FOLDER)}; name the camera file")
        path = inside[0]
    if not path.is_file():
        raise InputError(f"file not found: {path}; correct the name")
    source = CameraSource(path, camera, pixel_mm, size_px, Path(block) if block is not None else None)
    text = "" if path.name == "cameras.bin" else source.text()
    for reader in camera_readers().values():
        if reader.recognise(path, text):
            with reading(path, "camera file"):
                result = reader.read(source)
            if pixel_mm is not None and not math.isclose(result.sensor.pixel_mm, pixel_mm, rel_tol=1e-6):
                raise source.error(
                    f"its pixel size is {result.sensor.pixel_mm:g} mm, not {pixel_mm:g}: remove --pixel-mm, "
                    "or, if that size was assumed, convert the file to pixels first: jaxphoto camera "
                    f"{quoted(str(path))} --out pixels.yml"
                )
            return result
    if not text.strip():
        raise source.error("the file is empty; re-export it")
    raise source.error(f"unknown camera file format; supported are {CAMERAS_READ}")


def results_in(folder: Path) -> Path:
    """Return the result folder of the largest part if `folder` is a flight, else `folder`."""
    result = folder / "result"
    return result if (result / INTERIOR).is_file() and not (folder / INTERIOR).is_file() else folder


def read_block_camera(source: CameraSource) -> CameraFile:
    """Read a camera of a block.toml, or of a file that contains [cameras.NAME] tables only."""
    cameras = read_settings(read_toml(source.path), source.path.name).cameras
    name = source.chosen(list(cameras))
    camera = cameras[name]
    covariance = None
    if camera.known is not None:
        names = parameter_names(camera.interior)
        which = [names.index(parameter) for parameter in camera.known.parameters]
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(which, which)] = camera.known.covariance
    return CameraFile(name, camera.sensor, camera.interior, covariance, camera.reservation)


def write_block_camera(
    path: Path,
    name: str,
    sensor: Sensor,
    interior: InteriorOrientation,
    covariance: np.ndarray | None = None,
    reservation: str = "",
) -> None:
    """Write a [cameras.NAME] table of block.toml. Parameters with a covariance are free, the others fixed."""
    known = None if covariance is None else known_together(interior, covariance)
    section = camera_section(Camera(sensor, interior, jax.tree.map(lambda _: FIXED, interior), known, reservation))
    for parameter in () if known is None else known.parameters:
        section["unknowns"][parameter] = "free"
    path.write_text(toml_text({"cameras": {name: section}}), encoding="utf-8")


def read_results(source: CameraSource) -> CameraFile:
    """Read a camera of interior.csv, and its covariance from sigmas and correlation.csv.

    Model and sensor are read from summary.json in the same folder, or from `source.block`.
    """
    summary = read_summary(source.path.parent)
    if summary.get("converged") is False:
        raise source.error("summary.json: the adjustment did not converge. Correct the block and adjust again")
    table = read_csv(source.path, ("camera", "parameter", "value"), ("sigma", "significant", "unit"))
    of = table.ids("camera")
    name = source.chosen(list(dict.fromkeys(of.tolist())))
    sensor, empty = _described(source, name)
    table = table.take(of == name)
    parameters = table.ids("parameter").tolist()
    values = dict(zip(parameters, table.numbers("value").tolist(), strict=True))
    sigma = np.nan_to_num(table.numbers("sigma", empty=True))
    sigmas = dict(zip(parameters, sigma.tolist(), strict=True))
    names, constants = parameter_names(empty), constant_names(empty)
    if missing := [n for n in (*names, *constants) if n not in values]:
        model = type(empty.distortion).__name__
        raise source.error(f"camera {name} has no {', '.join(missing)}, which {model} needs; give its block")
    interior = empty
    for parameter in (*names, *constants):
        interior = set_parameter(interior, parameter, as_jax_array(values[parameter]))
    covariance = _covariance(source, name, names, np.array([sigmas[n] for n in names]))
    return CameraFile(name, sensor, interior, covariance, reservation(summary))


def _covariance(source: CameraSource, camera: str, names: tuple[str, ...], sigma: np.ndarray) -> np.ndarray | None:
    """Return sigma_i rho_ij sigma_j, zero for fixed parameters; None without estimates or without correlation.csv."""
    path = source.path.with_name("correlation.csv")
    free = [n for n, s in zip(names, sigma, strict=True) if s > 0]
    if not free or not path.is_file():
        return None
    try:
        table: pd.DataFrame = pd.read_csv(path, usecols=list(_CORRELATION), dtype=str)
    except ValueError:
        columns = ", ".join(_CORRELATION)
        raise source.error(
            f"{path.name} in its folder is not a table of {columns}; adjust again or remove it"
        ) from None
    labels = {f"interior[{camera}].{n}": k for k, n in enumerate(names) if n in free}
    rows = table[table.parameter_a.isin(labels) & table.parameter_b.isin(labels)]
    rho = np.full((len(names), len(names)), np.nan)
    a, b = (rows[column].map(labels).to_numpy(int) for column in _CORRELATION[:2])
    rho[a, b] = pd.to_numeric(rows.rho, errors="coerce")
    np.fill_diagonal(rho, 1.0)
    part = rho[np.ix_(*2 * [[names.index(n) for n in free]])]
    symmetric = np.isfinite(part).all() and np.abs(part - part.T).max() < _ROUNDING
    if len(rows) != len(free) * (len(free) - 1) or not symmetric or np.linalg.eigvalsh(part).min() < -_ROUNDING:
        raise source.error(f"{path.name} in its folder is of another adjustment; adjust again or remove it")
    return sigma[:, None] * np.nan_to_num(rho) * sigma


def _described(source: CameraSource, camera: str) -> tuple[Sensor, InteriorOrientation]:
    """Return sensor and camera model of a camera of the results, ignoring parameter values."""
    if source.block is not None:
        path = source.block / TOML if source.block.is_dir() else source.block
        cameras = read_settings(read_toml(path), path.name).cameras
        if camera not in cameras:
            raise source.error(f"{path} has no camera {camera!r}; give the block that was adjusted")
        return cameras[camera].sensor, cameras[camera].interior
    path = source.path.with_name(SUMMARY)
    try:
        section = Section(path.name, "", read_json(path)).section("cameras").section(camera)
        return read_sensor(section), empty_camera(section.values)
    except (ValueError, KeyError, TypeError):
        raise source.error(
            f"the model of camera {camera} is in neither summary.json nor a block; give the block"
        ) from None


CAMERA_READERS: dict[str, CameraReader] = {
    "interior": CameraReader(lambda path, text: text.startswith("camera,parameter,value"), read_results),
    "block": CameraReader(lambda path, text: path.suffix == ".toml", read_block_camera),
}
"""Readers of camera files by format."""
