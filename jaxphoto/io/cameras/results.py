"""Cameras of jaxphoto itself: interior.csv of a folder of results, with its covariance, and those of a block.toml."""

import json
from pathlib import Path

import jax
import numpy as np
import pandas as pd

from jaxphoto.arrays import on_device
from jaxphoto.camera import (
    DISTORTIONS,
    InteriorOrientation,
    Sensor,
    Smac,
    constant_names,
    parameter_names,
    set_parameter,
)
from jaxphoto.io.block_folder.camera_section import Camera, camera_section
from jaxphoto.io.block_folder.layout import TOML
from jaxphoto.io.block_folder.settings import read_settings, read_toml, toml_text
from jaxphoto.io.cameras.camera_file import CameraFile, Source
from jaxphoto.io.tables import read_csv
from jaxphoto.unknowns import FIXED

INTERIOR = "interior.csv"
_COLUMNS = ("camera", "parameter", "value")
_CORRELATION = ("parameter_a", "parameter_b", "rho")


def read_block_camera(source: Source) -> CameraFile:
    """A camera of a block.toml (or of a file with its [cameras.NAME] tables alone): the start of an adjustment."""
    cameras = read_settings(read_toml(source.path), source.path.name).cameras
    name = source.chosen(list(cameras))
    camera = cameras[name]
    return CameraFile(name, camera.sensor, camera.interior)


def write_block_camera(path: Path, name: str, sensor: Sensor, interior: InteriorOrientation) -> None:
    """Write the [cameras.NAME] table of a block.toml, everything fixed."""
    section = camera_section(Camera(sensor, interior, jax.tree.map(lambda _: FIXED, interior)))
    path.write_text(toml_text({"cameras": {name: section}}), encoding="utf-8")


def read_results(source: Source) -> CameraFile:
    """A camera of interior.csv, with the covariance that its sigmas and the table of correlations make.

    Model and sensor are those of summary.json beside it, or of the block that `source.block` names.
    Raises InputError where neither tells them, and for tables that do not fit.
    """
    table = read_csv(source.path, _COLUMNS, ("sigma", "significant"))
    of = table.ids("camera")
    name = source.chosen(list(dict.fromkeys(of.tolist())))
    sensor, empty = _described(source, name)
    own = table.take(of == name)
    values = dict(zip(own.ids("parameter").tolist(), own.numbers("value").tolist(), strict=True))
    sigmas = dict(zip(values, own.numbers("sigma", empty=True).tolist(), strict=True))
    names = parameter_names(empty)
    constants = constant_names(type(empty.distortion))
    if missing := [n for n in (*names, *constants) if n not in values]:
        model = type(empty.distortion).__name__
        raise source.error(f"camera {name} has no {', '.join(missing)}, which {model} needs; give the block it is of")
    interior = empty
    for parameter in (*names, *constants):
        interior = set_parameter(interior, parameter, on_device(values[parameter]))
    sigma = np.nan_to_num(np.array([sigmas[n] for n in names]))
    return CameraFile(name, sensor, interior, _covariance(source, name, names, sigma))


def _covariance(source: Source, camera: str, names: tuple[str, ...], sigma: np.ndarray) -> np.ndarray | None:
    """sigma_i rho_ij sigma_j, zero for what was fixed; None where nothing was estimated or no correlations are kept."""
    path = source.path.with_name("correlation.csv")
    free = [n for n, s in zip(names, sigma, strict=True) if s > 0]
    if not free or not path.is_file():
        return None
    table: pd.DataFrame = pd.read_csv(path, usecols=list(_CORRELATION))
    labels = {f"interior[{camera}].{n}": k for k, n in enumerate(names) if n in free}
    rows = table[table.parameter_a.isin(labels) & table.parameter_b.isin(labels)]
    if len(rows) != len(free) * (len(free) - 1):
        raise source.error(f"{path.name} beside it is not of the same adjustment; adjust again or remove it")
    rho = np.eye(len(names))
    rho[rows.parameter_a.map(labels), rows.parameter_b.map(labels)] = rows.rho
    return sigma[:, None] * rho * sigma


def _described(source: Source, camera: str) -> tuple[Sensor, InteriorOrientation]:
    """Sensor and model (with zeros for numbers) of a camera of the results."""
    if source.block is not None:
        path = source.block / TOML if source.block.is_dir() else source.block
        cameras = read_settings(read_toml(path), path.name).cameras
        if camera not in cameras:
            raise source.error(f"{path} has no camera {camera!r}; give the block that was adjusted")
        return cameras[camera].sensor, cameras[camera].interior
    path = source.path.with_name("summary.json")
    try:
        told = json.loads(path.read_text(encoding="utf-8"))["cameras"][camera]
        kind = DISTORTIONS[told["distortion"]]
        sensor = Sensor(told["width_px"], told["height_px"], told["pixel_mm"])
        sign = {"sign": told["sign"]} if kind is Smac else {}
    except (OSError, ValueError, KeyError, TypeError):
        raise source.error(
            f"neither summary.json beside it nor a block says of which model camera {camera} is; give the block"
        ) from None
    constants = dict.fromkeys(constant_names(kind).values(), 1.0)
    return sensor, InteriorOrientation(1.0, 0.0, 0.0, kind(**constants, **sign))
