"""Conversion of a camera to another distortion model: exact where possible (`exact`), otherwise fitted."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxphoto.camera.distortion import AbstractDistortion, invert
from jaxphoto.camera.equivalence import exact
from jaxphoto.camera.interior import InteriorOrientation, get_parameter, parameter_names, set_parameter
from jaxphoto.camera.projection import AbstractProjection
from jaxphoto.camera.sensor import Sensor
from jaxphoto.compiling import call_compiled
from jaxphoto.least_squares import least_squares
from jaxphoto.linear_algebra import solve

# Number of image points along each side of the format, corners included, at which cameras are compared.
_SIDE = 25
# Maximum error (px) of a fit without rarely needed terms.
_GOOD_PX = 0.01
# Maximum number of iterations. Rational models converge slowly along a flat valley.
_MAX_STEPS = 300


class Conversion(NamedTuple):
    """Camera converted to another model, and displacement (px) of the image points of the same rays."""

    interior: InteriorOrientation
    rms_px: float
    """RMS length of the displacement over the format; 0 for an exact conversion."""
    max_px: float
    covered: float
    """Fraction of the format that was compared; below 1 if the given camera is undefined in the corners."""
    worst_px: tuple[float, float] | None = None
    """Column and row of the image point with the largest displacement; None for an exact conversion."""

    @property
    def lost(self) -> str:
        """Describe the loss of the conversion."""
        if self.worst_px is None:
            return "the conversion is exact"
        column, row = self.worst_px
        return (
            f"fitted over the format: rms {self.rms_px:.3g} px, largest {self.max_px:.3g} px at column {column:.0f}, "
            f"row {row:.0f}"
        )


def converted(
    interior: InteriorOrientation,
    target: type[AbstractDistortion],
    sensor: Sensor,
    held: tuple[str, ...] = (),
    projection: AbstractProjection | None = None,
) -> Conversion:
    """Convert by `exact` if possible, otherwise by `fitted`; `held` names coefficients of `target` that must be 0.

    `projection`: projection of the result; None retains the projection of the camera. Raises the errors of `fitted`.
    """
    own = projection is None or eqx.tree_equal(projection, interior.projection) is True
    same = exact(interior, target) if own else None
    if same is not None and all(float(get_parameter(same, name)) == 0 for name in held):
        return Conversion(same, 0.0, 0.0, 1.0)
    return fitted(interior, target, sensor, held, projection)


def fitted(
    interior: InteriorOrientation,
    target: type[AbstractDistortion],
    sensor: Sensor,
    held: tuple[str, ...] = (),
    projection: AbstractProjection | None = None,
) -> Conversion:
    """Fit the model `target` to the rays of `interior` by least squares in the image.

    c, x_p, y_p and the coefficients of `target` except `held` are fitted to 25 x 25 evenly spaced image points of the
    format with equal weights; the camera is not rotated. Rare terms (affinity, rational and highest-order terms) are
    used only if the error without them exceeds 0.01 px. R0 of SMAC and of the balanced model is 0. `projection`:
    projection of the result; None retains the projection of the camera.

    Raises ValueError if `interior` is undefined in more than half of the format, if `projection` does not cover the
    directions of the format, or if the fitted model is not invertible in the format.
    """
    points, rays, covered = _sampled(interior, sensor)
    scales = (*held, *target.scales)
    rare = tuple(n for n in target.coefficients if n not in (*target.usual(), *scales))
    first = _plain(interior, target, sensor, interior.projection if projection is None else projection)
    if not np.all(np.asarray(first.projection.sees(*rays.T))):
        raise ValueError(
            f"the projection {first.projection.name} does not cover all directions in the format of this camera: "
            "choose one that does, such as equidistant"
        )
    found = _fit(first, sensor, points, rays, (*scales, *rare))
    if rare and not found.max_px <= _GOOD_PX:
        fuller = _fit(found.interior, sensor, points, rays, scales)
        # max_px is NaN for a model that is not invertible; prefer any other model.
        found = fuller if not found.rms_px <= fuller.rms_px else found
    if not np.isfinite(found.max_px):
        raise ValueError(
            f"{target.__name__} cannot represent this camera up to the edge of its format: the fitted model is not "
            "invertible there; choose a model with more terms"
        )
    return found._replace(covered=covered)


def _sampled(interior: InteriorOrientation, sensor: Sensor) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the image points (mm) where the camera is defined, their directions, and their fraction of all points."""
    x, y = (np.linspace(-0.5, 0.5, _SIDE) * side for side in (sensor.width_mm, sensor.height_mm))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays, good = (np.asarray(v) for v in call_compiled(_rays, _arrays(interior), points))
    if good.mean() < 0.5:
        raise ValueError(
            f"the distortion of this camera is not invertible over {1 - good.mean():.0%} of its format: check its "
            "coefficients, their unit and the size of the image"
        )
    return points[good], rays[good], float(good.mean())


@eqx.filter_jit
def _rays(interior: InteriorOrientation, points):
    """Return the directions (divided by c) of image points, and True where the model is invertible."""
    d, c = interior.distortion, interior.c

    def of_one(xy):
        ideal, reduced = interior.ideal_from_measured(xy), xy - interior.principal_point
        unit = c if d.normalised else 1.0
        if d.domain == "ideal":
            good = invert(d, reduced / unit)[1]
        else:
            # Check by a round trip: the inverse returns the same point only within the monotone range.
            back, monotone = invert(d, ideal / unit)
            good = monotone & (jnp.max(jnp.abs(unit * back - reduced)) < 1e-6 * c)
        ray = jnp.stack(interior.direction_from_ideal(ideal)) / c
        return ray, good & jnp.all(jnp.isfinite(ray))

    return jax.vmap(of_one)(points)


def _fit(
    first: InteriorOrientation, sensor: Sensor, points: np.ndarray, rays: np.ndarray, held: tuple[str, ...]
) -> Conversion:
    """Fit all parameters of `first` except `held`; its values are the initial values."""
    names = parameter_names(first)
    free = np.array([name not in held for name in names])
    begin = np.array([float(get_parameter(first, name)) for name in names])
    data = (_arrays(first), np.array(sensor.pixel_mm), _padded(points), _padded(rays))
    # Pass all parameters as arguments, including fixed parameters, to compile one program per model.
    interior = _with(first, np.asarray(call_compiled(_fitted_values, begin, free, *data)))
    moved = np.asarray(call_compiled(_moved, _arrays(interior), *data[1:]))[: len(points)]
    column, row = sensor.px_from_mm(points[[np.argmax(moved)]])[0].tolist()
    return Conversion(interior, float(np.sqrt(np.mean(moved**2))), float(np.max(moved)), 1.0, (column, row))


def _padded(values: np.ndarray) -> np.ndarray:
    """Pad the points of the format by NaN to a common shape, to compile one program."""
    return np.concatenate([values, np.full((_SIDE**2 - len(values), values.shape[1]), np.nan)])


@eqx.filter_jit
def _fitted_values(start, free, first: InteriorOrientation, pixel_mm, points, rays):
    """Minimise the squared displacements over the `free` parameters, from `start`; return all parameters."""
    displacements = lambda v, _: _displacements(jnp.where(free, v, start), first, pixel_mm, points, rays)  # noqa: E731
    return least_squares(displacements, start, atol=1e-9, max_steps=_MAX_STEPS).unknowns


def _displacements(values, first: InteriorOrientation, pixel_mm, points, rays):
    """Return the displacements (px) of the image points of given rays; first order for measured-domain models."""
    interior = _with(first, values)

    def of_one(xy, ray):
        here = jnp.all(jnp.isfinite(xy))
        xy, ray = jnp.where(here, xy, 0.0), jnp.where(here, ray, jnp.array([0.0, 0.0, -1.0]))
        aimed = interior.ideal_from_direction(*ray)
        if interior.distortion.domain == "ideal":
            apart = interior.measured_from_ideal(aimed) - xy
        else:
            # Compare ideal coordinates divided by c; transform the difference to the image by the model's derivative.
            ideal = lambda m: interior.ideal_from_measured(m) / interior.c  # noqa: E731
            j = jax.lax.stop_gradient(jax.jacfwd(ideal)(xy))
            apart = solve(j, aimed / interior.c - ideal(xy))
        return jnp.where(here, apart / pixel_mm, 0.0)

    return jax.vmap(of_one)(points, rays).ravel()


@eqx.filter_jit
def _moved(interior: InteriorOrientation, pixel_mm, points, rays):
    """Return the exact lengths (px) of the displacements; NaN where the model is not invertible."""

    def of_one(xy, ray):
        ideal = interior.ideal_from_direction(*ray)
        apart = interior.measured_from_ideal(ideal) - xy
        return jnp.where(interior.valid(ideal), jnp.linalg.norm(apart) / pixel_mm, jnp.nan)

    return jax.vmap(of_one)(points, rays)


def _plain(
    interior: InteriorOrientation, target: type[AbstractDistortion], sensor: Sensor, projection: AbstractProjection
) -> InteriorOrientation:
    """Return the camera with the model `target` and the given projection, without distortion."""
    plain = target.plain(sensor)
    camera = InteriorOrientation(interior.c, interior.xp, interior.yp, plain, projection=projection)
    return jax.tree.map(lambda v: jnp.asarray(v, float), camera)


def _with(interior: InteriorOrientation, values) -> InteriorOrientation:
    for name, value in zip(parameter_names(interior), values, strict=True):
        interior = set_parameter(interior, name, value)
    return interior


def _arrays(interior: InteriorOrientation) -> InteriorOrientation:
    return jax.tree.map(lambda v: np.asarray(v, float), interior)
