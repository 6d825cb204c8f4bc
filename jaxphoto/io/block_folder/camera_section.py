"""One [cameras.X] table of block.toml: sensor, starting interior orientation and what of it is free."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from jaxphoto.arrays import on_device
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
from jaxphoto.camera.declared import Declared
from jaxphoto.errors import BlockError, InputError, quoted
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.names import control_in
from jaxphoto.unknowns import FIXED, FREE, Prior, Weighted

_KEYS = ("width_px", "height_px", "pixel_mm", "pixel_assumed", "distortion", "projection", "residuals")
# A principal distance beyond these multiples of the format's diagonal is in another unit than millimetres.
_LONGEST, _SHORTEST = 20.0, 0.05
# Pixels of known sensors are 0.5 to 50 micrometres.
PIXEL_MM = (2e-4, 0.1)

Part = TypeVar("Part", bound=Declared)


class KnownTogether(NamedTuple):
    """Parameters of a camera that an earlier calibration knows: as they stand in its interior orientation, with this
    covariance (in their own units)."""

    parameters: tuple[str, ...]
    covariance: np.ndarray


class Camera(NamedTuple):
    """A camera as block.toml gives it; `priors` has a prior in place of each number of `interior`."""

    sensor: Sensor
    interior: InteriorOrientation
    priors: InteriorOrientation
    known: KnownTogether | None = None
    """What is known beforehand together; free in `priors`."""
    reservation: str = ""
    """What speaks against the calibration that it is from."""


def read_camera(section: Section) -> Camera:
    """The camera that a [cameras.X] table describes. Raises InputError for what cannot be one."""
    distortion = _kind(section, "distortion", AbstractDistortion.called)
    projection = _kind(section, "projection", AbstractProjection.called, Perspective.name)
    section.known(*_KEYS, *distortion.choices, *projection.choices, "interior", "unknowns", "known", "reservation")
    sensor = read_sensor(section)
    if not PIXEL_MM[0] <= sensor.pixel_mm <= PIXEL_MM[1]:
        raise section.error("pixel_mm", f"a pixel of {sensor.pixel_mm:g} mm cannot be; give its size in millimetres")
    empty = _empty_interior(section, distortion, projection)
    interior = _read_interior(section.section("interior"), empty, sensor)
    status = section.section("unknowns")
    status.known(*parameter_names(interior))
    priors = jax.tree.map(lambda _: FIXED, interior)
    for name in status:
        priors = set_parameter(priors, name, status.prior(name, get_parameter(interior, name)))
    known = _read_known(section.section("known"), parameter_names(interior))
    for name in () if known is None else known.parameters:
        if status.values.get(name, "free") != "free":
            raise status.error(
                name, f"it is known beforehand by [{section.path}.known]; remove it here, or there with its covariance"
            )
        priors = set_parameter(priors, name, FREE)
    reservation = section.text("reservation", "")
    if control_in(reservation):
        raise section.error("reservation", "it has a control character, which a terminal would obey; remove it")
    return Camera(sensor, interior, priors, known, reservation)


def read_sensor(section: Section) -> Sensor:
    """The sensor by the keys that `sensor_keys` writes. Raises InputError for what cannot be one."""
    size = section.count("width_px"), section.count("height_px"), section.positive("pixel_mm")
    return Sensor(*size, pixel_assumed=section.truth("pixel_assumed"))


def known_together(interior: InteriorOrientation, covariance: np.ndarray) -> KnownTogether:
    """What a covariance of all parameters knows: those that it does not hold at their values."""
    names = parameter_names(interior)
    free = np.flatnonzero(np.diagonal(covariance) > 0)
    own = covariance[np.ix_(free, free)]
    return KnownTogether(tuple(names[k] for k in free), (own + own.T) / 2)


def camera_section(camera: Camera) -> dict[str, Any]:
    """The [cameras.X] table that `read_camera` reads as `camera`."""
    sensor, interior, priors, known, reservation = camera
    written: dict[str, Any] = sensor_keys(sensor) | model_keys(interior)
    if interior.residuals != "model":
        written["residuals"] = interior.residuals
    names = parameter_names(interior)
    written["interior"] = {n: float(get_parameter(interior, n)) for n in (*names, *constant_names(interior))}
    written["unknowns"] = {name: status(get_parameter(priors, name), get_parameter(interior, name)) for name in names}
    if reservation:
        written["reservation"] = reservation
    if known is not None:
        written["known"] = {"parameters": list(known.parameters), "matrix": known.covariance.tolist()}
    return written


def status(prior: Any, start, scale: float = 1.0) -> str | dict[str, Any]:
    """How block.toml writes a prior of an unknown whose start is `start`; `scale` is as in `Section.prior`."""
    if isinstance(prior, Prior):
        return prior.name.lower()
    if not isinstance(prior, Weighted):
        raise BlockError(f"{prior!r} is no prior; use FREE, FIXED or Weighted(value, sigma)")
    if prior.covariance is None:
        written: dict[str, Any] = {"sigma": (np.asarray(prior.sigma) / scale).tolist()}
    else:
        written = {"covariance": (np.asarray(prior.covariance) / scale**2).tolist()}
    if not np.array_equal(np.asarray(prior.value), np.asarray(start)):
        written["value"] = (np.asarray(prior.value) / scale).tolist()
    return written


def _read_known(section: Section, names: tuple[str, ...]) -> KnownTogether | None:
    if not section.values:
        return None
    section.known("parameters", "matrix")
    parameters = section.texts("parameters")
    for name in parameters:
        if name not in names or parameters.count(name) > 1:
            raise section.error("parameters", f"{quoted(name)} is none, or stands there twice; {', '.join(names)} are")
    matrix = section.covariance("matrix", section.values.get("matrix"), len(parameters))
    return KnownTogether(parameters, matrix)


def _kind(section: Section, key: str, called: Callable[[str], type[Part]], usual: str | None = None) -> type[Part]:
    name = section.text(key, usual)
    try:
        return called(name)
    except InputError as error:
        raise section.error(key, str(error)) from None


def _empty_interior(
    section: Section, distortion: type[AbstractDistortion], projection: type[AbstractProjection]
) -> InteriorOrientation:
    residuals = _one_of(section, "residuals", ("model", "measured"), "model")
    parts = _empty(section, distortion), _empty(section, projection)
    empty = InteriorOrientation(0.0, 0.0, 0.0, parts[0], residuals, parts[1])  # type: ignore[arg-type]
    return jax.tree.map(on_device, empty)


def _empty(section: Section, kind: type[Part]) -> Part:
    """A model with zeros for numbers, but for the constants that it needs."""
    values = section.section("interior")
    usual: dict[str, Any] = {f.name: f.default for f in dataclasses.fields(kind)}
    chosen = {key: _one_of(section, key, words, usual[key]) for key, words in kind.choices.items()}
    return kind(**{field: values.positive(name) for name, field in kind.needed().items()}, **chosen)


def _one_of(section: Section, key: str, words: tuple[str, ...], usual: str) -> str:
    word = section.text(key, usual)
    if word not in words:
        known = " nor ".join(f'"{w}"' for w in words)
        raise section.error(key, f"{quoted(word)} is neither {known}; choose one of them")
    return word


def _read_interior(section: Section, empty: InteriorOrientation, sensor: Sensor) -> InteriorOrientation:
    section.known(*parameter_names(empty), *constant_names(empty))
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
