"""One [cameras.X] table of block.toml: sensor, starting interior orientation and what of it is free."""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxphoto.arrays import on_device
from jaxphoto.camera import (
    DISTORTIONS,
    InteriorOrientation,
    Sensor,
    Smac,
    constant_names,
    get_parameter,
    needed_constants,
    parameter_names,
    set_parameter,
)
from jaxphoto.errors import BlockError
from jaxphoto.io.block_folder.section import Section
from jaxphoto.unknowns import FIXED, Prior, Weighted

# A principal distance beyond these multiples of the format's diagonal is in another unit than millimetres.
_LONGEST, _SHORTEST = 20.0, 0.05
# Pixels of known sensors are 0.5 to 50 micrometres.
_PIXEL_MM = (2e-4, 0.1)


class Camera(NamedTuple):
    """A camera as block.toml gives it; `priors` has a prior in place of each number of `interior`."""

    sensor: Sensor
    interior: InteriorOrientation
    priors: InteriorOrientation


def read_camera(section: Section) -> Camera:
    """The camera that a [cameras.X] table describes. Raises InputError for what cannot be one."""
    section.known("width_px", "height_px", "pixel_mm", "distortion", "sign", "residuals", "interior", "unknowns")
    sensor = Sensor(section.count("width_px"), section.count("height_px"), section.positive("pixel_mm"))
    if not _PIXEL_MM[0] <= sensor.pixel_mm <= _PIXEL_MM[1]:
        raise section.error("pixel_mm", f"a pixel of {sensor.pixel_mm:g} mm cannot be; give its size in millimetres")
    empty = _empty_interior(section)
    interior = _read_interior(section.section("interior"), empty, sensor)
    status = section.section("unknowns")
    status.known(*parameter_names(interior))
    priors = jax.tree.map(lambda _: FIXED, interior)
    for name in status:
        priors = set_parameter(priors, name, status.prior(name, get_parameter(interior, name)))
    return Camera(sensor, interior, priors)


def camera_section(camera: Camera) -> dict[str, Any]:
    """The [cameras.X] table that `read_camera` reads as `camera`."""
    sensor, interior, priors = camera
    distortion = interior.distortion
    name = next(key for key, kind in DISTORTIONS.items() if kind is type(distortion))
    written: dict[str, Any] = {
        "width_px": sensor.width_px,
        "height_px": sensor.height_px,
        "pixel_mm": sensor.pixel_mm,
        "distortion": name,
    }
    if isinstance(distortion, Smac):
        written["sign"] = distortion.sign
    if interior.residuals != "model":
        written["residuals"] = interior.residuals
    names = parameter_names(interior)
    constants = {name: getattr(distortion, field) for name, field in constant_names(type(distortion)).items()}
    written["interior"] = {name: float(get_parameter(interior, name)) for name in names}
    written["interior"] |= {name: float(value) for name, value in constants.items()}
    written["unknowns"] = {name: status(get_parameter(priors, name), get_parameter(interior, name)) for name in names}
    return written


def status(prior: Any, start, scale: float = 1.0) -> str | dict[str, Any]:
    """How block.toml writes a prior of an unknown whose start is `start`; `scale` is as in `Section.prior`."""
    if isinstance(prior, Prior):
        return prior.value
    if not isinstance(prior, Weighted):
        raise BlockError(f"{prior!r} is no prior; use FREE, FIXED or Weighted(value, sigma)")
    written: dict[str, Any] = {"sigma": (np.asarray(prior.sigma) / scale).tolist()}
    if not np.array_equal(np.asarray(prior.value), np.asarray(start)):
        written["value"] = (np.asarray(prior.value) / scale).tolist()
    return written


def _empty_interior(section: Section) -> InteriorOrientation:
    residuals = section.text("residuals", "model")
    if residuals not in ("model", "measured"):
        raise section.error("residuals", f'{residuals!r} is neither "model" nor "measured"; choose one of them')
    return dataclasses.replace(_empty_model(section), residuals=residuals)  # type: ignore[arg-type]


def _empty_model(section: Section) -> InteriorOrientation:
    model = section.text("distortion")
    if model not in DISTORTIONS:
        known = ", ".join(DISTORTIONS)
        raise section.error("distortion", f"no distortion model is called {model!r}; choose one of {known}")
    kind = DISTORTIONS[model]
    if kind is not Smac:
        if "sign" in section:
            raise section.error("sign", f"the model {model} has its sign by definition; remove the key")
        values = section.section("interior")
        constants = {field: values.positive(name) for name, field in needed_constants(kind).items()}
        return _as_arrays(InteriorOrientation(0.0, 0.0, 0.0, kind(**constants)))
    sign = section.text("sign", "subtract")
    if sign not in ("subtract", "add"):
        raise section.error("sign", f'{sign!r} is neither "subtract" nor "add"; choose one of them')
    return _as_arrays(InteriorOrientation(0.0, 0.0, 0.0, Smac(sign=sign)))  # type: ignore[arg-type]


def _as_arrays(interior: InteriorOrientation) -> InteriorOrientation:
    return jax.tree.map(on_device, interior)


def _read_interior(section: Section, empty: InteriorOrientation, sensor: Sensor) -> InteriorOrientation:
    names = (*parameter_names(empty), *constant_names(type(empty.distortion)))
    section.known(*names)
    interior = empty
    for name in section:
        interior = set_parameter(interior, name, on_device(section.number(name)))
    c, diagonal = section.number("c_mm"), float(np.hypot(sensor.width_mm, sensor.height_mm))
    if not _SHORTEST * diagonal < c < _LONGEST * diagonal:
        raise section.error(
            "c_mm",
            f"a principal distance of {c:g} mm cannot be with a format of {sensor.width_mm:g} x {sensor.height_mm:g} "
            "mm; give it positive and in millimetres, not in pixels or metres",
        )
    for name, half in (("xp_mm", sensor.width_mm / 2), ("yp_mm", sensor.height_mm / 2)):
        if abs(float(get_parameter(interior, name))) > half:
            raise section.error(
                name, "the principal point lies outside the format; give it in millimetres from the image centre"
            )
    return interior
