"""Gap between each surveyed point and each strip after the adjustment, with its expected scatter.

A gap g = n . (X - F') of a surveyed place X above the foot F' on the plane of a strip has the variance s^2 of plane and
survey, and F' depends on the unknowns x, of covariance C, by a = d(n . F')/dx. Adjusted observations have absorbed part
of their errors, others have not:

    var(g) = s^2 - a C a'    for adjusted control,        s^2 + a C a'    for check points, and rejected control

and g over its standard deviation is the test value w (Baarda 1968), standard normal without errors.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.compiling import call_compiled
from jaxphoto.georeferencing import Scanner, ScannerCalibration, StripErrors, TrajectoryKnot
from jaxphoto.lidar.correction import ScannerPath
from jaxphoto.observations.strip_planes import return_at
from jaxphoto.procedures.control.surveyed import SurveyedPoints
from jaxphoto.procedures.lidar.strip_control import OnStrips
from jaxphoto.procedures.lidar.strip_rows import Side, side_of
from jaxphoto.procedures.lidar.tie_point_search import PointPlanes
from jaxphoto.statistics import Covariance

# Fractions of its noise below which an adjusted gap is uninformative: nothing else checks it.
_UNTESTED = 1e-3


class SurveyedGap(NamedTuple):
    """Surveyed point above the plane of a strip."""

    point: str
    role: Literal["control", "check"]
    strip: str
    dX_m: float
    """Surveyed minus the nearest place on the plane of the strip, corrected."""
    dY_m: float
    dZ_m: float
    gap_m: float
    """Their length, positive if the point lies above."""
    noise_m: float
    """Of plane and survey."""
    sigma_m: float
    """Of `gap_m`, a priori."""
    w: float
    """gap / sigma; NaN if nothing checks it."""
    used: bool
    """True if it is in the adjustment."""


def surveyed_gaps(
    control: SurveyedPoints,
    met: OnStrips,
    errors: StripErrors,
    path: ScannerPath | None,
    adjusted: Adjustment,
    known: Covariance,
) -> tuple[SurveyedGap, ...]:
    """Return the gaps of surveyed points for each strip with a plane about them; `errors` are the adjusted ones."""
    found: list[SurveyedGap] = []
    roles: tuple[tuple[Literal["control", "check"], list[PointPlanes]], ...]
    roles = (("control", met.control), ("check", met.check))
    for role, looks in roles:
        for f in (f for f in looks if len(f.fits)):
            moves, used = _moves(f, errors, path, adjusted, known), f.fits & (role == "control")
            variance = f.sigma**2 + np.where(used, -moves, moves)
            sigma = np.sqrt(np.maximum(variance, 0.0))
            w = np.where(sigma > _UNTESTED * f.sigma, f.found.gap / np.maximum(sigma, np.finfo(float).tiny), np.nan)
            off = f.found.gap[:, None] * f.patches.normal[f.found.patch]
            rows = zip(f.found.point, off.tolist(), f.found.gap, f.sigma, sigma, w, used, strict=True)
            for p, (dx, dy, dz), *numbers, within in rows:
                gap, noise, own, test = map(float, numbers)
                name, strip = control.ids[p], f.look.name
                found.append(SurveyedGap(name, role, strip, dx, dy, dz, gap, noise, own, test, bool(within)))
    return tuple(found)


def _moves(
    f: PointPlanes, errors: StripErrors, path: ScannerPath | None, adjusted: Adjustment, known: Covariance
) -> Float[np.ndarray, "n"]:
    """Return a C a', a priori."""
    side = side_of(f.patches, f.found.patch, f.found.foot, f.look.strip, errors, path)
    off = np.concatenate([errors.position, errors.attitude], axis=1)[side.knots]
    off = np.einsum("nk,nkc->nc", side.weights, off)
    normal = f.patches.normal[f.found.patch]
    by_knots, *by_scanner = call_compiled(_slopes, side, normal, off, errors.boresight, errors.calibration)
    place = {label: k for k, label in enumerate(adjusted.structure.labels)}
    # Fixed unknowns have no place, and contribute nothing.
    a = np.zeros((len(normal), len(place) + 1))
    knot = TrajectoryKnot(np.zeros(3), np.zeros(3))  # type: ignore[arg-type]
    owners, rows = list(adjusted.unknowns.more[TrajectoryKnot.kind]), np.arange(len(normal))
    at = np.array([[place.get(label, -1) for label in knot.labels(owner)] for owner in owners])
    for k in range(side.knots.shape[1]):
        np.add.at(a, (rows[:, None], at[side.knots[:, k]]), side.weights[:, k, None] * np.asarray(by_knots))
    labels = *Scanner(errors.boresight, {}).labels(""), *errors.calibration.labels("")  # type: ignore[arg-type]
    for label, slopes in zip(labels, np.concatenate(by_scanner, axis=1).T, strict=True):
        a[:, place.get(label, -1)] = slopes
    a = a[:, :-1]
    return np.einsum("ni,ij,nj->n", a, np.asarray(known.matrix)[-a.shape[1] :, -a.shape[1] :], a)


@eqx.filter_jit
def _slopes(
    side: Side,
    normal: Float[Array, "n 3"],
    off: Float[Array, "n 6"],
    boresight: Float[Array, "3"],
    calibration: ScannerCalibration,
) -> tuple[Float[Array, "n 6"], Float[Array, "n 3"], Float[Array, "n calibrated"]]:
    """Differentiate the height of the foot along the normal by the trajectory's error, the boresight and the rest."""
    numbers, back = ravel_pytree(calibration)

    def height(off, boresight, numbers, normal, point, position, angles, velocity, rate):
        errors = TrajectoryKnot(off[:3], off[3:]), Scanner(boresight, {}), back(numbers)
        return jnp.sum(normal * return_at(point, position, angles, velocity, rate, *errors))

    pose = side.point, side.scanner, side.roll_pitch_yaw, side.velocity, side.rate
    slopes = jax.vmap(jax.grad(height, argnums=(0, 1, 2)), (0, None, None, *[0] * 6))
    return slopes(off, boresight, numbers, normal, *pose)
