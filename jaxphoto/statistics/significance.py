"""Significance of parameters: tests of single interior parameters, of zero parameters, of camera changes in flight.

The parameters d have the cofactors Q. If all are truly zero,

    F = d' Q^-1 d / (f sigma0^2)

follows Fisher's distribution with f and r degrees of freedom, f the number of parameters and r the redundancy. If a
single parameter k has the true value D, the noncentrality of f F is D^2 (Q^-1)_kk / sigma0^2. With lambda(f) the
noncentrality for a test of level 5 % with a power of 80 % by chi-square of f degrees of freedom, the minimal detectable
value is

    D_k = sigma0 sqrt(lambda(f) / (Q^-1)_kk)

which is (1.96 + 0.84) sigma for one parameter. Priors of the parameters (with their covariances) are removed from Q and
d. Directions that are then undetermined, such as a change common to all strips, are not counted in f.

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Teunissen (2000), Testing theory.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jax.scipy.special import betainc, gammaincc
from jaxtyping import Array, Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.structure import observed_in
from jaxphoto.block import exposures
from jaxphoto.camera import (
    RATES,
    AbstractCameraRates,
    CameraSpline,
    InteriorOrientation,
    StripCamera,
    get_parameter,
    parameter_unit,
    set_parameter,
)
from jaxphoto.compiling import call_compiled
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.covariance import Covariance
from jaxphoto.statistics.quantiles import beta_tail, chi_square_shift
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import Weighted

SIGNIFICANCE_LEVEL = 0.05
"""Significance level of the tests of zero parameters."""


@pretty_repr
class Significance(eqx.Module):
    """One estimated interior parameter: value, sigma (a posteriori), |value| / sigma, two-sided p-value (H0: 0).

    Value and sigma are in `unit`: mm, 1/mm^2, "1" if dimensionless (`jaxphoto.camera.parameter_unit`).
    """

    camera: str
    parameter: str
    value: float
    sigma: float
    ratio: float
    p_value: float
    unit: str

    @property
    def significant(self) -> bool:
        """True if the p-value is below `SIGNIFICANCE_LEVEL`.

        Paper 000 uses the stricter criterion `ratio` > 10.
        """
        return self.p_value < SIGNIFICANCE_LEVEL


@outside_transformations
def significance(adjusted: Adjustment, covariance: Covariance) -> list[Significance]:
    """Test every estimated interior parameter, in the order of the cameras and their models."""
    sigma = dict(
        zip(covariance.labels[6 * covariance.n_images :], np.asarray(covariance.shared_sigma).tolist(), strict=True)
    )
    result = []
    for label, s in sigma.items():
        if not label.startswith("interior["):
            continue
        camera, parameter = label.removeprefix("interior[").rsplit("].", 1)
        interior = adjusted.unknowns.interior[camera]
        value, unit = float(get_parameter(interior, parameter)), parameter_unit(interior, parameter)
        ratio = abs(value) / s if s != 0 else np.inf
        result.append(Significance(camera, parameter, value, s, ratio, student_p(ratio, adjusted.redundancy), unit))
    return result


@pretty_repr
class FixedAtZero(NamedTuple):
    """First-order change of a camera when one interior parameter is fixed at zero."""

    in_sigmas: dict[str, float]
    """Change of every estimated parameter of the camera, in its standard deviations."""
    corner_mm: float
    """Displacement (mm) of the image of a direction at the corner of the format."""


def fix_at_zero(adjusted: Adjustment, covariance: Covariance, parameter: Significance) -> FixedAtZero:
    """Predict the change of all interior parameters of a camera when `parameter` is fixed at zero.

    d = -Q[:, k] / q_kk value, with the covariance Q of the interior parameters.
    """
    interior, sensor = adjusted.unknowns.interior[parameter.camera], adjusted.block.sensors[parameter.camera]
    prefix = f"interior[{parameter.camera}]."
    names = [label.removeprefix(prefix) for label in covariance.labels if label.startswith(prefix)]
    q, k = covariance.of_interior(parameter.camera, names), names.index(parameter.parameter)
    change = -q[:, k] / q[k, k] * parameter.value
    changed = interior
    for name, d in zip(names, change.tolist(), strict=True):
        changed = set_parameter(changed, name, get_parameter(interior, name) + d)
    corner = np.array([sensor.width_mm, sensor.height_mm]) / 2
    displacement = np.asarray(call_compiled(_reproject, interior, changed, corner)) - corner
    in_sigmas = dict(zip(names, (change / np.sqrt(np.diagonal(q))).tolist(), strict=True))
    return FixedAtZero(in_sigmas, float(np.hypot(*displacement)))


@eqx.filter_jit
def _reproject(interior: InteriorOrientation, changed: InteriorOrientation, xy: Array) -> Array:
    """Project into `changed` the direction that `interior` images at `xy`; return its image coordinates."""
    direction = interior.direction_from_ideal(interior.ideal_from_measured(xy))
    return changed.measured_from_ideal(changed.ideal_from_direction(*direction))


def student_p(t: float, degrees_of_freedom: int) -> float:
    """Return the two-sided p-value of Student's t; 1 without redundancy, NaN for NaN."""
    if np.isnan(t):
        return np.nan
    if degrees_of_freedom <= 0:
        return 1.0
    if not np.isfinite(t):
        return 0.0
    a, x = degrees_of_freedom / 2, degrees_of_freedom / (degrees_of_freedom + t * t)
    return float(call_compiled(_beta, np.array(a), np.array(x)))


def chi_square_p(sum_of_squares: float, redundancy: int) -> float:
    """Return the probability of a larger v'Pv if the a priori sigmas are correct; 1 without redundancy."""
    return float(gammaincc(redundancy / 2, sum_of_squares / 2)) if redundancy > 0 else 1.0


@eqx.filter_jit
def _beta(a, x):
    """Return the regularised incomplete beta function of a and 1/2."""
    return betainc(a, 0.5, x)


POWER = 0.80
"""Power of the test for a parameter of size `detectable`."""
# Fraction of the total information about a parameter below which the contribution of the observations is rounding.
_MIN_INFORMATION = 1e-6


@pretty_repr
class ZeroTest(NamedTuple):
    """Test of zero parameters. Arrays have one element per parameter.

    `value` and `sigma` (a posteriori) are results of the adjustment. `p_values` (each parameter zero), `p_value` (all
    zero) and `detectable` (minimal detectable value) exclude the priors.
    """

    value: Float[np.ndarray, "parameters"]
    sigma: Float[np.ndarray, "parameters"]
    p_values: Float[np.ndarray, "parameters"]
    detectable: Float[np.ndarray, "parameters"]
    p_value: float

    @property
    def rejected(self) -> bool:
        """True if `p_value` is below `SIGNIFICANCE_LEVEL`."""
        return self.p_value < SIGNIFICANCE_LEVEL


def zero_test(adjusted: Adjustment, covariance: Covariance, labels: Sequence[str], scale: float = 1.0) -> ZeroTest:
    """Test whether estimated shared parameters, each multiplied by `scale`, are zero.

    The priors of the tested parameters (with their covariances) are excluded. All other observations are used,
    including `KnownParameters` of other parameters.
    """
    places = [covariance.labels.index(label) for label in labels]
    s, free_index = adjusted.structure, {label: k for k, label in enumerate(adjusted.structure.labels)}
    index = np.asarray(s.free)[[free_index[label] for label in labels]]
    value = scale * np.asarray(adjusted.values.shared)[index]
    q = scale**2 * np.asarray(covariance.matrix)[np.ix_(places, places)]
    weight, prior = _priors(adjusted, index)
    weight, prior = weight / scale**2, scale * prior
    # In units of the standard deviations, the information matrix is the inverse of the correlation matrix.
    sigma = np.sqrt(np.diagonal(q))
    information = np.linalg.inv(q / np.outer(sigma, sigma))
    without_priors = information - weight * np.outer(sigma, sigma)
    right = information @ (value / sigma) - sigma * (weight @ prior)
    factor, r = float(covariance.variance_factor), adjusted.redundancy
    explained, freedom, inverse = _solved(without_priors, right)
    variance, precision = np.diagonal(inverse), np.maximum(np.diagonal(without_priors), 0.0)
    ratio = np.divide((inverse @ right) ** 2, variance, out=np.zeros(len(index)), where=variance > 0)
    least = chi_square_shift(max(freedom, 1), SIGNIFICANCE_LEVEL, POWER) * factor
    determined = precision > _MIN_INFORMATION
    return ZeroTest(
        value,
        sigma * factor**0.5,
        np.array([_tail(v / factor, 1, r) for v in ratio]),
        sigma * np.sqrt(np.divide(least, precision, out=np.full(len(index), np.inf), where=determined)),
        _tail(explained / factor, freedom, r),
    )


def _priors(
    adjusted: Adjustment, index: Int[np.ndarray, "k"]
) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k"]]:
    """Return weights and values of the priors of some parameters. `index`: indices among all shared parameters."""
    observed, place_of = observed_in(adjusted.block, adjusted.priors), {int(place): k for k, place in enumerate(index)}
    weight, value = np.zeros((len(index), len(index))), np.zeros(len(index))
    for k, place in enumerate(index):
        if isinstance(prior := observed.entries[place].prior, Weighted):
            weight[k, k], value[k] = 1 / float(prior.sigma) ** 2, float(prior.value)
    for joint in observed.together:
        inside = [k for k, place in enumerate(joint.parameters) if int(place) in place_of]
        if inside:
            rows = [place_of[int(joint.parameters[k])] for k in inside]
            weight[np.ix_(rows, rows)] = np.linalg.inv(np.asarray(joint.covariance)[np.ix_(inside, inside)])
    return weight, value


def _solved(
    matrix: Float[np.ndarray, "k k"], right: Float[np.ndarray, "k"]
) -> tuple[float, int, Float[np.ndarray, "k k"]]:
    """Return right' inverse right, rank and pseudoinverse of `matrix`, without eigenvalues that are rounding errors."""
    values, vectors = np.linalg.eigh(matrix)
    determined = values > _MIN_INFORMATION
    half = vectors[:, determined] / np.sqrt(values[determined])
    return float(np.sum((right @ half) ** 2)), int(determined.sum()), half @ half.T


def _tail(sum_of_squares: float, freedom: int, redundancy: int) -> float:
    """Return the probability of a larger sum of squares / a posteriori variance factor; 1 without redundancy."""
    if freedom == 0 or redundancy <= 0:
        return 1.0
    return beta_tail(sum_of_squares / (sum_of_squares + redundancy), freedom / 2, redundancy / 2)


@pretty_repr
class CameraDrift(NamedTuple):
    """Change of one camera over the flight or over the temperature range; one element per rate.

    The change is in mm (K1 in its unit), from the first to the last exposure or from the lowest to the highest
    temperature.
    """

    camera: str
    rates: type[AbstractCameraRates]
    span: float
    """Range of the exposures, in the unit of `rates.along`."""
    parameters: tuple[str, ...]
    """Names of the `AbstractCameraRates` parameters without suffix: c, xp, yp, k1."""
    change: ZeroTest


@pretty_repr
class CameraDifferences(NamedTuple):
    """Differences from the camera of the block (mm), by strip or by knot; one element per estimated parameter."""

    camera: str
    """Camera of the knots; "" for strips."""
    at: tuple[str, ...]
    """Strip name, or time of the knot in minutes from the middle of the flight."""
    parameters: tuple[str, ...]
    """Names of the `StripCamera` or `CameraSpline` parameters without suffix: c, xp, yp."""
    more: ZeroTest


def camera_drifts(adjusted: Adjustment, covariance: Covariance) -> list[CameraDrift]:
    """Test every camera with estimated rates; rates of time are first."""
    drifts, cameras = [], np.array(adjusted.block.image_camera)
    for rates in RATES:
        along = np.asarray(rates.argument(exposures(adjusted.block)))
        for camera in adjusted.unknowns.more.get(rates.kind, {}):
            if estimated := _estimated(adjusted, rates.kind, camera):
                span = float(np.ptp(along[cameras == camera]))
                names = tuple(name.split("_")[0] for name in estimated.values())
                test = zero_test(adjusted, covariance, [*estimated], span)
                drifts.append(CameraDrift(camera, rates, span, names, test))
    return drifts


def strip_differences(adjusted: Adjustment, covariance: Covariance) -> CameraDifferences | None:
    """Test all strips with estimated cameras; None without any.

    Differences between consecutive strips take part as observations.
    """
    strips, names, labels = [], [], []
    for strip in adjusted.unknowns.more.get(StripCamera.kind, {}):
        for label, name in _estimated(adjusted, StripCamera.kind, strip).items():
            strips.append(strip)
            names.append(name.split("_")[0])
            labels.append(label)
    if not labels:
        return None
    return CameraDifferences("", tuple(strips), tuple(names), zero_test(adjusted, covariance, labels))


def camera_spline_differences(adjusted: Adjustment, covariance: Covariance) -> list[CameraDifferences]:
    """Test every camera with an estimated spline."""
    differences: list[CameraDifferences] = []
    spline: Any
    for camera, spline in adjusted.unknowns.more.get(CameraSpline.kind, {}).items():
        if estimated := _estimated(adjusted, CameraSpline.kind, camera):
            names, knots, _ = zip(*(name.split("_") for name in estimated.values()), strict=True)
            minutes = tuple(f"{spline.times[int(knot) - 1] / 60:.3g}" for knot in knots)
            differences.append(CameraDifferences(camera, minutes, names, zero_test(adjusted, covariance, [*estimated])))
    return differences


def _estimated(adjusted: Adjustment, kind: str, owner: str) -> dict[str, str]:
    """Return the estimated parameters of an owner: label to name."""
    prefix = f"{kind}[{owner}]."
    return {label: label.removeprefix(prefix) for label in adjusted.structure.labels if label.startswith(prefix)}
