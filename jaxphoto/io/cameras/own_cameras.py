"""Cameras of jaxphoto itself: interior.csv of a folder of results, with its covariance, and those of a block.toml."""

from pathlib import Path

import jax
import numpy as np
import pandas as pd

from jaxphoto.arrays import on_device
from jaxphoto.camera import InteriorOrientation, Sensor, constant_names, empty_camera, parameter_names, set_parameter
from jaxphoto.io.block_folder.camera_section import Camera, camera_section, known_together, read_sensor
from jaxphoto.io.block_folder.settings import read_settings
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.cameras.camera_file import CameraFile, CameraSource
from jaxphoto.io.json_file import read_json
from jaxphoto.io.results_judged import SUMMARY, read_summary, reservation
from jaxphoto.io.text_tables import read_csv
from jaxphoto.io.toml import Section, read_toml, toml_text
from jaxphoto.unknowns import FIXED

INTERIOR = "interior.csv"
CAMERA = "camera.toml"
_RESULT = "result"
_COLUMNS = ("camera", "parameter", "value")
_CORRELATION = ("parameter_a", "parameter_b", "rho")
_ROUNDING = 1e-5


def results_in(folder: Path) -> Path:
    """The folder of results of the largest part where `folder` is that of a flight, else `folder` itself."""
    result = folder / _RESULT
    return result if (result / INTERIOR).is_file() and not (folder / INTERIOR).is_file() else folder


def read_block_camera(source: CameraSource) -> CameraFile:
    """A camera of a block.toml (or of a file with its [cameras.NAME] tables alone): the start of an adjustment."""
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
    """Write the [cameras.NAME] table of a block.toml, everything fixed but what has a covariance: that is known by it.

    `covariance` is that of `parameter_names(interior)`; `reservation`, what speaks against the calibration.
    """
    known = None if covariance is None else known_together(interior, covariance)
    section = camera_section(Camera(sensor, interior, jax.tree.map(lambda _: FIXED, interior), known, reservation))
    for parameter in () if known is None else known.parameters:
        section["unknowns"][parameter] = "free"
    path.write_text(toml_text({"cameras": {name: section}}), encoding="utf-8")


def read_results(source: CameraSource) -> CameraFile:
    """A camera of interior.csv, with the covariance that its sigmas and the table of correlations make.

    Model and sensor are those of summary.json beside it, or of the block that `source.block` names.
    Raises InputError where neither tells them, for an adjustment that did not converge, and for tables that do not fit.
    """
    summary = read_summary(source.path.parent)
    if summary.get("converged") is False:
        raise source.error(
            "summary.json beside it says that the adjustment did not converge, so its numbers are no calibration: mend "
            "the block and adjust again"
        )
    table = read_csv(source.path, _COLUMNS, ("sigma", "significant", "unit"))
    of = table.ids("camera")
    name = source.chosen(list(dict.fromkeys(of.tolist())))
    sensor, empty = _described(source, name)
    own = table.take(of == name)
    parameters = own.ids("parameter").tolist()
    for number, parameter in enumerate(parameters):
        if parameter in parameters[:number]:
            raise own.bad(number, f"{parameter} of camera {name} stands there twice; keep one of the two rows")
    values = dict(zip(parameters, own.numbers("value").tolist(), strict=True))
    given = np.nan_to_num(own.numbers("sigma", empty=True))
    for line in np.flatnonzero(given < 0):
        raise own.bad(line, f"sigma is {given[line]:g}; leave it empty for what was held fixed")
    sigmas = dict(zip(parameters, given.tolist(), strict=True))
    names = parameter_names(empty)
    constants = constant_names(empty)
    if missing := [n for n in (*names, *constants) if n not in values]:
        model = type(empty.distortion).__name__
        raise source.error(f"camera {name} has no {', '.join(missing)}, which {model} needs; give the block it is of")
    if not values["c_mm"] > 0:
        raise source.error(f"c_mm of camera {name} is {values['c_mm']:g}; a principal distance is positive")
    for constant in constants:
        if not (values[constant] > 0 or (constant == "r0_mm" and values[constant] == 0)):
            raise source.error(f"{constant} of camera {name} is {values[constant]:g}; give it as a positive length")
    interior = empty
    for parameter in (*names, *constants):
        interior = set_parameter(interior, parameter, on_device(values[parameter]))
    sigma = np.array([sigmas[n] for n in names])
    return CameraFile(name, sensor, interior, _covariance(source, name, names, sigma), reservation(summary))


def _covariance(source: CameraSource, camera: str, names: tuple[str, ...], sigma: np.ndarray) -> np.ndarray | None:
    """sigma_i rho_ij sigma_j, zero for what was fixed; None where nothing was estimated or no correlations are kept."""
    path = source.path.with_name("correlation.csv")
    free = [n for n, s in zip(names, sigma, strict=True) if s > 0]
    if not free or not path.is_file():
        return None
    try:
        # As text: a long row of digits would become an integer that is no float.
        table: pd.DataFrame = pd.read_csv(path, usecols=list(_CORRELATION), dtype=str)
    except ValueError:
        needed = ", ".join(_CORRELATION)
        raise source.error(f"{path.name} beside it is no table of {needed}; adjust again or remove it") from None
    labels = {f"interior[{camera}].{n}": k for k, n in enumerate(names) if n in free}
    rows = table[table.parameter_a.isin(labels) & table.parameter_b.isin(labels)]
    rho = np.full((len(names), len(names)), np.nan)
    a, b = (rows[column].map(labels).to_numpy(int) for column in _CORRELATION[:2])
    rho[a, b] = pd.to_numeric(rows.rho, errors="coerce")
    own = np.ix_(*2 * [[names.index(n) for n in free]])
    np.fill_diagonal(rho, 1.0)
    if len(rows) != len(free) * (len(free) - 1) or not _is_correlation(rho[own]):
        raise source.error(f"{path.name} beside it is not of the same adjustment; adjust again or remove it")
    return sigma[:, None] * np.nan_to_num(rho) * sigma


def _is_correlation(rho: np.ndarray) -> bool:
    """Whether every pair is there, both ways alike, and the matrix could be one of correlations, but for rounding."""
    alike = np.isfinite(rho).all() and np.abs(rho - rho.T).max() < _ROUNDING
    return bool(alike and np.linalg.eigvalsh(rho).min() > -_ROUNDING)


def _described(source: CameraSource, camera: str) -> tuple[Sensor, InteriorOrientation]:
    """Sensor and model (with zeros for numbers) of a camera of the results."""
    if source.block is not None:
        path = source.block / TOML if source.block.is_dir() else source.block
        cameras = read_settings(read_toml(path), path.name).cameras
        if camera not in cameras:
            raise source.error(f"{path} has no camera {camera!r}; give the block that was adjusted")
        return cameras[camera].sensor, cameras[camera].interior
    path = source.path.with_name(SUMMARY)
    try:
        told = Section(path.name, "", read_json(path)).section("cameras").section(camera)
        return read_sensor(told), empty_camera(told.values)
    except (ValueError, KeyError, TypeError):
        raise source.error(
            f"neither summary.json beside it nor a block says of which model camera {camera} is; give the block"
        ) from None
