"""What is known of a lens before anything was measured with it: by make and model, or by class of camera.

A flat block at one height cannot tell the principal distance from its own height, nor a barrel from a dome. What
decides then is how far lenses are from what EXIF says of them: the table `lens_priors.toml`, with the source of each
figure.
"""

import functools
import math
import tomllib
from importlib import resources
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxphoto.camera.interior import InteriorOrientation, parameter_names, set_parameter
from jaxphoto.camera.sensor import Sensor

# Places on the edge of the format at which a coefficient shows what it does.
_ON_AN_EDGE = 9


class LensPrior(NamedTuple):
    """How far the lenses of a model, or of a class of cameras, are from what EXIF says; standard deviations."""

    name: str
    c_percent: float
    """Of c, from the focal length of EXIF."""
    point_percent: float
    """Of the longer side of the format: of the principal point from its middle, in x and in y."""
    radial_percent: float
    """Of the distance of the corner: what each radial term of the distortion does there."""
    decentring_percent: float
    """Likewise of all other terms."""
    drift_ppm_per_K: float
    """By how much c changes with the temperature."""
    published: bool
    """Whether the figures rest on published ones."""
    source: str


@functools.cache
def lens_priors() -> tuple[tuple[tuple[str, ...], tuple[str, ...], LensPrior], ...]:
    """The table: models, beginnings of makes (and models), and the prior; the first that fits is taken."""
    table = tomllib.loads(resources.files(__package__).joinpath("lens_priors.toml").read_text("utf-8"))
    return tuple((tuple(row.pop("models", ())), tuple(row.pop("makes", ())), LensPrior(**row)) for row in table["lens"])


def lens_prior(make: str | None, model: str | None) -> LensPrior:
    """The prior of a camera by the make and model of its EXIF (None: EXIF does not say)."""
    make, model = (make or "").strip(), (model or "").strip()
    # Some makers write their name into the model again.
    told = {f"{make} {model}".lower(), f"{make.split(' ')[0]} {model}".lower(), model.lower()}
    for models, makes, prior in lens_priors():
        if model in models or any(name.startswith(own.lower()) for own in makes for name in told):
            return prior
    raise AssertionError("the last entry of the table fits all")


def prior_sigmas(
    prior: LensPrior, interior: InteriorOrientation, sensor: Sensor, rounding: float = 0.0
) -> dict[str, float]:
    """Standard deviations of the parameters of `interior` about its own values, by name (their own units).

    `rounding` is the relative standard deviation of c that comes from how it was noted. A coefficient has that by which
    its term moves the edge of the format, where it moves it most, by the percentage that the table says.
    """
    c = float(interior.c)
    point = prior.point_percent / 100 * max(sensor.width_mm, sensor.height_mm)
    found = {"c_mm": c * math.hypot(prior.c_percent / 100, rounding), "xp_mm": point, "yp_mm": point}
    corner = math.hypot(sensor.width_mm, sensor.height_mm) / 2
    edge = _edge(sensor)
    for name in parameter_names(interior):
        if name in found:
            continue
        moved = _moved(interior, name, edge)
        across = np.abs(moved[:, 0] * edge[:, 1] - moved[:, 1] * edge[:, 0]).max()
        most = np.hypot(*moved.T).max()
        radial = across < 1e-6 * corner * most
        percent = prior.radial_percent if radial else prior.decentring_percent
        # What moves nothing is the place that distortion is about, where there is none yet: as the principal point.
        found[name] = percent / 100 * corner / most if most > 0 else point
    return found


def _edge(sensor: Sensor) -> Float[np.ndarray, "places 2"]:
    """Places along two edges of the format and its corner (mm, from the middle)."""
    half, part = np.array([sensor.width_mm, sensor.height_mm]) / 2, np.linspace(0.0, 1.0, _ON_AN_EDGE)
    ones = np.ones_like(part)
    return half * np.concatenate([np.column_stack([part, ones]), np.column_stack([ones, part])])


def _moved(interior: InteriorOrientation, name: str, edge: np.ndarray) -> Float[np.ndarray, "places 2"]:
    """What a coefficient moves places by (mm), for each of its units."""
    move = lambda v: jax.vmap(set_parameter(interior, name, v).closed_form)(jnp.asarray(edge))  # noqa: E731
    return np.asarray(jax.jit(lambda: jax.jvp(move, (0.0,), (1.0,))[1])())
