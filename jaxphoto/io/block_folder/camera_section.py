"""The tables [cameras.X] of block.toml: sensor, interior orientation and its priors, or an earlier calibration.

`calibration = "../last_year"` replaces format, models and interior orientation. The parameters that this calibration
estimated become prior information with their full covariance ([cameras.X.known]). Its fixed parameters are fixed,
unless [cameras.X.unknowns] sets them.
"""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from pydantic import StrictBool, StrictStr, create_model

from jaxphoto.arrays import as_jax_array
from jaxphoto.camera import (
    AbstractDistortion,
    AbstractProjection,
    InteriorOrientation,
    Perspective,
    Sensor,
    constant_names,
    get_parameter,
    model_keys,
    parameter_names,
    sensor_keys,
    set_parameter,
)
from jaxphoto.errors import InputError, quoted
from jaxphoto.io.toml import Count, Keys, Number, Positive, Section, status
from jaxphoto.observations import KnownParameters
from jaxphoto.unknowns import FIXED, FREE

# Maximum and minimum ratio of the principal distance to the format diagonal; beyond them, c_mm is not in millimetres.
_LONGEST, _SHORTEST = 20.0, 0.05
# Minimum and maximum pixel size (mm); known sensors have 0.5 to 50 micrometres.
PIXEL_MM = (2e-4, 0.1)
_CALIBRATION = "calibration"
# Keys that are allowed in addition to an earlier calibration.
_OTHER_KEYS = (_CALIBRATION, "residuals", "unknowns")


class SensorKeys(Keys):
    """Keys of the image format."""

    width_px: Count
    height_px: Count
    pixel_mm: Positive
    pixel_assumed: StrictBool = False


class CovarianceKeys(Keys):
    """Keys of [cameras.X.known]."""

    parameters: list[StrictStr]
    matrix: Any


class CameraKeys(SensorKeys):
    """Keys of [cameras.X], without the options of its camera models."""

    distortion: StrictStr
    projection: StrictStr = Perspective.name
    residuals: Literal["model", "measured"] = "measured"
    interior: dict[str, Number] = {}  # noqa: RUF012
    unknowns: dict[str, Any] = {}  # noqa: RUF012
    known: CovarianceKeys | None = None
    reservation: StrictStr = ""


class KnownTogether(NamedTuple):
    """Camera parameters that an earlier calibration estimated, with their joint covariance (in their own units)."""

    parameters: tuple[str, ...]
    covariance: np.ndarray


class Camera(NamedTuple):
    """A camera in block.toml; `priors` has the structure of `interior`, with a prior per parameter."""

    sensor: Sensor
    interior: InteriorOrientation
    priors: InteriorOrientation
    known: KnownTogether | None = None
    """Joint prior information; its parameters are free in `priors`."""
    reservation: str = ""
    """Warning about the earlier calibration; "" if none."""


@functools.cache
def _keys(distortion: type[AbstractDistortion], projection: type[AbstractProjection]) -> type[CameraKeys]:
    """Return the keys of a camera with these models; a model may add options, such as a sign."""
    defaults = {f.name: f.default for kind in (distortion, projection) for f in dataclasses.fields(kind)}
    choices: dict[str, Any] = {
        key: (Literal[words], defaults[key])  # type: ignore[valid-type]
        for key, words in {**distortion.choices, **projection.choices}.items()
    }
    return create_model("CameraKeys", __base__=CameraKeys, **choices)


def read_camera(section: Section) -> Camera:
    """Read the camera of a [cameras.X] table."""
    key = "distortion"
    try:
        distortion = AbstractDistortion.called(section.text(key))
        key = "projection"
        projection = AbstractProjection.called(section.text(key, Perspective.name))
    except InputError as error:
        message = str(error)
        raise error if message.startswith(section.file) else section.error(key, message) from None
    keys = section.model(_keys(distortion, projection))
    sensor = Sensor(keys.width_px, keys.height_px, keys.pixel_mm, keys.pixel_assumed)
    if not PIXEL_MM[0] <= sensor.pixel_mm <= PIXEL_MM[1]:
        raise section.error("pixel_mm", f"{sensor.pixel_mm:g} mm is not a valid pixel size; give it in millimetres")
    values = section.section("interior")
    parts = [
        kind(
            **{field: values.positive(name) for name, field in kind.needed().items()},
            **{key: getattr(keys, key) for key in kind.choices},
        )
        for kind in (distortion, projection)
    ]
    empty = InteriorOrientation(0.0, 0.0, 0.0, parts[0], keys.residuals, parts[1])  # type: ignore[arg-type]
    interior = jax.tree.map(as_jax_array, empty)
    names = parameter_names(interior)
    values.known(*names, *constant_names(interior))
    for name, value in keys.interior.items():
        interior = set_parameter(interior, name, as_jax_array(value))
    _check_interior(values, sensor)
    return Camera(sensor, interior, *_priors(section, keys, interior), keys.reservation)


def _check_interior(values: Section, sensor: Sensor) -> None:
    """Raise InputError for a principal distance or principal point that is not in millimetres."""
    c, diagonal = values.number("c_mm"), float(np.hypot(sensor.width_mm, sensor.height_mm))
    if not _SHORTEST * diagonal < c < _LONGEST * diagonal:
        raise values.error(
            "c_mm",
            f"{c:g} mm is not a valid principal distance for the format {sensor.width_mm:g} x {sensor.height_mm:g} mm; "
            "give it positive and in millimetres, not in pixels or metres",
        )
    for name, side in (("xp_mm", sensor.width_mm), ("yp_mm", sensor.height_mm)):
        if abs(values.number(name, 0.0)) > side / 2:
            raise values.error(
                name, "the principal point is outside the format; give it in millimetres from the image centre"
            )


def _priors(section: Section, keys: CameraKeys, interior: InteriorOrientation) -> tuple[Any, KnownTogether | None]:
    names, table = parameter_names(interior), section.section("unknowns")
    table.known(*names)
    priors = jax.tree.map(lambda _: FIXED, interior)
    for name in table:
        priors = set_parameter(priors, name, table.prior(name, get_parameter(interior, name)))
    if keys.known is None:
        return priors, None
    known, parameters = section.section("known"), tuple(keys.known.parameters)
    for name in parameters:
        if name not in names or parameters.count(name) > 1:
            raise known.error("parameters", f"{quoted(name)} is unknown or given twice; use {', '.join(names)}")
        if table.values.get(name, "free") != "free":
            raise table.error(
                name, f"it has prior information in [{known.path}]; remove it here, or there with its covariance"
            )
        priors = set_parameter(priors, name, FREE)
    return priors, KnownTogether(parameters, known.covariance("matrix", keys.known.matrix, len(parameters)))


def read_sensor(section: Section) -> Sensor:
    """Return the sensor of a table; other keys of the table are ignored."""
    keys = section.values
    return Sensor(
        section.count("width_px"), section.count("height_px"), section.positive("pixel_mm"),
        pixel_assumed=keys.get("pixel_assumed") is True,
    )  # fmt: skip


def known_together(interior: InteriorOrientation, covariance: np.ndarray) -> KnownTogether:
    """Select the estimated parameters, those with a positive variance, from a full covariance."""
    names = parameter_names(interior)
    free = np.flatnonzero(np.diagonal(covariance) > 0)
    part = covariance[np.ix_(free, free)]
    return KnownTogether(tuple(names[k] for k in free), (part + part.T) / 2)


def camera_section(camera: Camera) -> dict[str, Any]:
    """Return the [cameras.X] table from which `read_camera` restores `camera`."""
    sensor, interior, priors, known, reservation = camera
    written: dict[str, Any] = sensor_keys(sensor) | model_keys(interior)
    if interior.residuals != "measured":
        written["residuals"] = interior.residuals
    names = parameter_names(interior)
    written["interior"] = {n: float(get_parameter(interior, n)) for n in (*names, *constant_names(interior))}
    written["unknowns"] = {name: status(get_parameter(priors, name), get_parameter(interior, name)) for name in names}
    if reservation:
        written["reservation"] = reservation
    if known is not None:
        written["known"] = {"parameters": list(known.parameters), "matrix": known.covariance.tolist()}
    return written


def with_earlier_calibrations(settings: dict[str, Any], file: str, folder: Path) -> dict[str, Any]:
    """Return the content of block.toml in `folder`, replacing references to earlier calibrations by camera tables.

    Raises InputError for invalid calibrations, calibrations without covariance, and keys that the calibration sets.
    """
    cameras = settings.get("cameras", {})
    if not isinstance(cameras, dict) or not any(isinstance(t, dict) and _CALIBRATION in t for t in cameras.values()):
        return settings
    # Import here to avoid a cycle: `camera_files` imports this module to read a block.toml.
    from jaxphoto.io.camera_files import read_camera_file

    completed: dict[str, Any] = {}
    for name, table in cameras.items():
        section = Section(file, f"cameras.{name}", table)
        completed[name] = table
        if _CALIBRATION not in section:
            continue
        for key in section:
            if key not in _OTHER_KEYS:
                only = ", ".join(_OTHER_KEYS[1:])
                raise section.error(
                    key, f"already given by the calibration, which permits only {only} in addition; remove it"
                )
        given = table[_CALIBRATION] if isinstance(table[_CALIBRATION], dict) else {"file": table[_CALIBRATION]}
        named = Section(file, f"cameras.{name}.{_CALIBRATION}", given)
        named.known("file", "camera")
        camera = named.text("camera") if "camera" in named else None
        read = read_camera_file(folder / named.text("file"), camera=camera)
        if read.covariance is None:
            raise section.error(
                _CALIBRATION,
                f"{named.text('file')} has no covariance; give a result folder of jaxphoto adjust, or a camera file "
                "written from one",
            )
        known = known_together(read.interior, read.covariance)
        fixed = jax.tree.map(lambda _: FIXED, read.interior)
        calibrated = camera_section(Camera(read.sensor, read.interior, fixed, known, read.note))
        unknowns = {key: value for key, value in calibrated["unknowns"].items() if key not in known.parameters}
        completed[name] = calibrated | table | {"unknowns": unknowns | table.get("unknowns", {})}
        del completed[name][_CALIBRATION]
    return settings | {"cameras": completed}


def known_cameras(cameras: Mapping[str, Camera]) -> tuple[KnownParameters, ...]:
    """Return the joint prior information of each camera that has any."""
    known = []
    for name, camera in cameras.items():
        if camera.known is not None:
            parameters, covariance = camera.known
            values = np.array([float(get_parameter(camera.interior, parameter)) for parameter in parameters])
            labels = [f"interior[{name}].{p}" for p in parameters]
            known.append(KnownParameters(labels, values, covariance, camera.reservation))
    return tuple(known)
