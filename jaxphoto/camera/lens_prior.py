"""Prior information about lenses by make and model, or by class of camera.

In a flat block at one flying height, the principal distance is not separable from the flying height, nor barrel
distortion from a doming error. The result then depends on the prior: the deviation of lenses from EXIF. The table
`lens_priors.toml` contains the values with their sources.
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

# Number of points per edge of the format at which the effect of a coefficient is evaluated.
_ON_AN_EDGE = 9


class LensPrior(NamedTuple):
    """Standard deviations of lens parameters relative to EXIF, for a camera model or a class of cameras."""

    name: str
    c_percent: float
    """Standard deviation of c relative to the focal length in EXIF (%)."""
    point_percent: float
    """Standard deviation of x_p and y_p in percent of the longer side of the format."""
    radial_percent: float
    """Effect of each radial term at the corner of the format, in percent of the distance of the corner."""
    decentring_percent: float
    """Effect of each other term at the corner of the format, in percent of the distance of the corner."""
    drift_ppm_per_K: float
    """Relative change of c with temperature (ppm/K)."""
    published: bool
    """True if the values are based on published values."""
    source: str


@functools.cache
def lens_priors() -> tuple[tuple[tuple[str, ...], tuple[str, ...], LensPrior], ...]:
    """Return the table of priors by prefix of make and model; the first match applies."""
    table = tomllib.loads(resources.files(__package__).joinpath("lens_priors.toml").read_text("utf-8"))
    return tuple((tuple(row.pop("models", ())), tuple(row.pop("makes", ())), LensPrior(**row)) for row in table["lens"])


def lens_prior(make: str | None, model: str | None) -> LensPrior:
    """Return the prior of a camera by make and model in EXIF (None if missing)."""
    make, model = (make or "").strip(), (model or "").strip()
    # Some model names already contain the make.
    told = {f"{make} {model}".lower(), f"{make.split(' ')[0]} {model}".lower(), model.lower()}
    for models, makes, prior in lens_priors():
        if model in models or any(name.startswith(own.lower()) for own in makes for name in told):
            return prior
    raise AssertionError("the last entry of the table matches every camera")


def prior_sigmas(
    prior: LensPrior, interior: InteriorOrientation, sensor: Sensor, rounding: float = 0.0
) -> dict[str, float]:
    """Return the prior standard deviations of the parameters of `interior`, by name, in their own units.

    `rounding`: relative standard deviation of c due to its rounding in EXIF. The standard deviation of a coefficient is
    the value whose maximum displacement along the edge of the format equals the percentage in the table.
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
        # The centre of a zero distortion has no effect: treat it like the principal point.
        found[name] = percent / 100 * corner / most if most > 0 else point
    return found


def _edge(sensor: Sensor) -> Float[np.ndarray, "places 2"]:
    """Return points (mm, from the centre) along two edges of the format, including their common corner."""
    half, part = np.array([sensor.width_mm, sensor.height_mm]) / 2, np.linspace(0.0, 1.0, _ON_AN_EDGE)
    ones = np.ones_like(part)
    return half * np.concatenate([np.column_stack([part, ones]), np.column_stack([ones, part])])


def _moved(interior: InteriorOrientation, name: str, edge: np.ndarray) -> Float[np.ndarray, "places 2"]:
    """Return the displacement (mm) per unit of a coefficient."""
    move = lambda v: jax.vmap(set_parameter(interior, name, v).closed_form)(jnp.asarray(edge))  # noqa: E731
    return np.asarray(jax.jit(lambda: jax.jvp(move, (0.0,), (1.0,))[1])())
