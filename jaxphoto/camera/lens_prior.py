"""Prior information about a lens before any measurement: by make and model, or by class of camera.

A flat block at one height determines neither the principal distance apart from its own height nor barrel distortion
apart from a dome. The result then depends on how far lenses deviate from EXIF: table `lens_priors.toml`, with the
source of each figure.
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

# Places on the edge of the format at which the effect of a coefficient is evaluated.
_ON_AN_EDGE = 9


class LensPrior(NamedTuple):
    """Standard deviations of the lenses of a model, or of a class of cameras, about the values of EXIF."""

    name: str
    c_percent: float
    """Of c about the focal length in EXIF."""
    point_percent: float
    """Of the principal point about the centre, in x and in y, relative to the longer side of the format."""
    radial_percent: float
    """Effect of each radial distortion term at the corner, relative to the distance of the corner."""
    decentring_percent: float
    """The same for all other terms."""
    drift_ppm_per_K: float
    """Change of c with temperature."""
    published: bool
    """True if the figures rest on published ones."""
    source: str


@functools.cache
def lens_priors() -> tuple[tuple[tuple[str, ...], tuple[str, ...], LensPrior], ...]:
    """Return the table of models or beginnings of makes (and models) with their priors; the first match is used."""
    table = tomllib.loads(resources.files(__package__).joinpath("lens_priors.toml").read_text("utf-8"))
    return tuple((tuple(row.pop("models", ())), tuple(row.pop("makes", ())), LensPrior(**row)) for row in table["lens"])


def lens_prior(make: str | None, model: str | None) -> LensPrior:
    """Return the prior of a camera by make and model in EXIF (None if EXIF lacks them)."""
    make, model = (make or "").strip(), (model or "").strip()
    # Some makers repeat their name in the model.
    told = {f"{make} {model}".lower(), f"{make.split(' ')[0]} {model}".lower(), model.lower()}
    for models, makes, prior in lens_priors():
        if model in models or any(name.startswith(own.lower()) for own in makes for name in told):
            return prior
    raise AssertionError("the last entry of the table matches every camera")


def prior_sigmas(
    prior: LensPrior, interior: InteriorOrientation, sensor: Sensor, rounding: float = 0.0
) -> dict[str, float]:
    """Return standard deviations of the parameters of `interior` about its values, by name (their own units).

    `rounding` is the relative standard deviation of c due to its rounding in EXIF. A coefficient has the standard
    deviation whose largest displacement at the edge of the format is the percentage of the table.
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
        # Without effect: the centre of a distortion that is zero. Treat it as the principal point.
        found[name] = percent / 100 * corner / most if most > 0 else point
    return found


def _edge(sensor: Sensor) -> Float[np.ndarray, "places 2"]:
    """Return places along two edges of the format and its corner (mm, from the centre)."""
    half, part = np.array([sensor.width_mm, sensor.height_mm]) / 2, np.linspace(0.0, 1.0, _ON_AN_EDGE)
    ones = np.ones_like(part)
    return half * np.concatenate([np.column_stack([part, ones]), np.column_stack([ones, part])])


def _moved(interior: InteriorOrientation, name: str, edge: np.ndarray) -> Float[np.ndarray, "places 2"]:
    """Return the displacement (mm) per unit of a coefficient."""
    move = lambda v: jax.vmap(set_parameter(interior, name, v).closed_form)(jnp.asarray(edge))  # noqa: E731
    return np.asarray(jax.jit(lambda: jax.jvp(move, (0.0,), (1.0,))[1])())
