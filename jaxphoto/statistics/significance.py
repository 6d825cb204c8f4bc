"""Is an interior orientation parameter significant, a square sum too large? Ratio and tests.

Are several parameters zero, and how large would one have to be to be seen?

The parameters d have the cofactors Q. Where all are truly zero,

    F = d' Q^-1 d / (f sigma0^2)

of f parameters follows the distribution of Fisher with f and r degrees of freedom, r the redundancy. A parameter k that
is D, and it alone, gives f F the noncentrality D^2 (Q^-1)_kk / sigma0^2. Where that is lambda(f), the noncentral
chi-square of f degrees of freedom is beyond its limit of 5 % with the power of 80 %. So the least D that is found so is

    D_k = sigma0 sqrt(lambda(f) / (Q^-1)_kk)

which is (1.96 + 0.84) sigma where there is one parameter. The priors of parameters, of vectors with their covariance,
have no part in this: they are taken out of Q and d. What then shows in no observation, such as a change of all strips
together beside that of their camera, has no part in f.

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Teunissen (2000), Testing theory.


Did a camera change during its flight: along a straight line of time or temperature, along a
spline of time, or from strip to strip? See `zero_test`.
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
from jaxphoto.short_repr import shown
from jaxphoto.statistics.covariance import Covariance
from jaxphoto.statistics.quantiles import beta_tail, chi_square_shift
from jaxphoto.tracing import outside_transformations
from jaxphoto.unknowns import Weighted

SIGNIFICANCE_LEVEL = 0.05
"""Probability up to which "the true value is zero" is not believed."""


@shown
class Significance(eqx.Module):
    """One estimated interior parameter: value, a posteriori sigma, |value| / sigma, and two-sided p of value = 0.

    Value and sigma are in `unit`: mm, 1/mm^2, "1" of a number without one (`jaxphoto.camera.parameter_unit`).
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
        """Whether a true value of zero is less likely than `SIGNIFICANCE_LEVEL`.

        Paper 000 asks for a ratio of 10, which is far stricter; `ratio` tells.
        """
        return self.p_value < SIGNIFICANCE_LEVEL


@outside_transformations
def significance(adjusted: Adjustment, covariance: Covariance) -> list[Significance]:
    """Of every estimated interior parameter, in the order of the cameras and their models."""
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


@shown
class IfZero(NamedTuple):
    """What changes where an interior parameter is held at zero, to first order."""

    in_sigmas: dict[str, float]
    """Of every estimated parameter of the camera, over its standard deviation."""
    corner_mm: float
    """By how far the image of a direction, at the corner of the format, moves."""


def if_zero(adjusted: Adjustment, covariance: Covariance, of: Significance) -> IfZero:
    """All other interior parameters of the camera follow by their covariance: d = -Q[:, k] / q_kk value."""
    interior, sensor = adjusted.unknowns.interior[of.camera], adjusted.block.sensors[of.camera]
    prefix = f"interior[{of.camera}]."
    names = [label.removeprefix(prefix) for label in covariance.labels if label.startswith(prefix)]
    q, k = covariance.of_interior(of.camera, names), names.index(of.parameter)
    change = -q[:, k] / q[k, k] * of.value
    changed = interior
    for name, d in zip(names, change.tolist(), strict=True):
        changed = set_parameter(changed, name, get_parameter(interior, name) + d)
    corner = np.array([sensor.width_mm, sensor.height_mm]) / 2
    moved = np.asarray(call_compiled(_image_of_the_same, interior, changed, corner)) - corner
    in_sigmas = dict(zip(names, (change / np.sqrt(np.diagonal(q))).tolist(), strict=True))
    return IfZero(in_sigmas, float(np.hypot(*moved)))


@eqx.filter_jit
def _image_of_the_same(interior: InteriorOrientation, changed: InteriorOrientation, xy: Array) -> Array:
    """Where `changed` sees the direction that `interior` sees at `xy`."""
    direction = interior.direction_from_ideal(interior.ideal_from_measured(xy))
    return changed.measured_from_ideal(changed.ideal_from_direction(*direction))


def student_p(t: float, degrees_of_freedom: int) -> float:
    """Two-sided p-value of Student's t; 1 where there is no redundancy to test with, NaN where t is no number."""
    if np.isnan(t):
        return np.nan
    if degrees_of_freedom <= 0:
        return 1.0
    if not np.isfinite(t):
        return 0.0
    a, x = degrees_of_freedom / 2, degrees_of_freedom / (degrees_of_freedom + t * t)
    return float(call_compiled(_beta, np.array(a), np.array(x)))


def chi_square_p(square_sum: float, redundancy: int) -> float:
    """Probability that v'Pv is as large as this or larger if the a priori sigmas are true; 1 without redundancy."""
    return float(gammaincc(redundancy / 2, square_sum / 2)) if redundancy > 0 else 1.0


@eqx.filter_jit
def _beta(a, x):
    """The regularised incomplete beta function of a and 1/2."""
    return betainc(a, 0.5, x)


POWER = 0.80
"""Probability with which a parameter of the `detectable` size is found."""
# Of what an adjustment knows of a parameter: where observations add no more than this, they show nothing.
_SHOWS = 1e-6


@shown
class ZeroTest(NamedTuple):
    """One entry a parameter. `value` and `sigma` (a posteriori) are those of the adjustment; `p_values`, of each being
    zero, `p_value`, of all being zero, and `detectable` leave out what was known beforehand."""

    value: Float[np.ndarray, "parameters"]
    sigma: Float[np.ndarray, "parameters"]
    p_values: Float[np.ndarray, "parameters"]
    detectable: Float[np.ndarray, "parameters"]
    p_value: float

    @property
    def rejected(self) -> bool:
        """Whether zeros are less likely to look like this than `SIGNIFICANCE_LEVEL`."""
        return self.p_value < SIGNIFICANCE_LEVEL


def zero_test(adjusted: Adjustment, covariance: Covariance, labels: Sequence[str], times: float = 1.0) -> ZeroTest:
    """The test of estimated shared parameters, each multiplied by `times`.

    KnownParameters and all other observations take part in it.
    """
    places = [covariance.labels.index(label) for label in labels]
    s, of = adjusted.structure, {label: k for k, label in enumerate(adjusted.structure.labels)}
    own = np.asarray(s.free)[[of[label] for label in labels]]
    value = times * np.asarray(adjusted.values.shared)[own]
    q = times**2 * np.asarray(covariance.matrix)[np.ix_(places, places)]
    weight, known = _known(adjusted, own)
    weight, known = weight / times**2, times * known
    # In units of the standard deviations that the adjustment gives, all that it knows is the inverse correlation.
    sigma = np.sqrt(np.diagonal(q))
    whole = np.linalg.inv(q / np.outer(sigma, sigma))
    shown = whole - weight * np.outer(sigma, sigma)
    right = whole @ (value / sigma) - sigma * (weight @ known)
    factor, r = float(covariance.variance_factor), adjusted.redundancy
    explained, freedom, inverse = _solved(shown, right)
    alone, precision = np.diagonal(inverse), np.maximum(np.diagonal(shown), 0.0)
    ratio = np.divide((inverse @ right) ** 2, alone, out=np.zeros(len(own)), where=alone > 0)
    least = chi_square_shift(max(freedom, 1), SIGNIFICANCE_LEVEL, POWER) * factor
    return ZeroTest(
        value,
        sigma * factor**0.5,
        np.array([_tail(v / factor, 1, r) for v in ratio]),
        sigma * np.sqrt(np.divide(least, precision, out=np.full(len(own), np.inf), where=precision > _SHOWS)),
        _tail(explained / factor, freedom, r),
    )


def _known(adjusted: Adjustment, own: Int[np.ndarray, "k"]) -> tuple[Float[np.ndarray, "k k"], Float[np.ndarray, "k"]]:
    """Weights and values of what was known of parameters beforehand; `own` are their places among all shared ones."""
    given, at = observed_in(adjusted.block, adjusted.priors), {int(place): k for k, place in enumerate(own)}
    weight, known = np.zeros((len(own), len(own))), np.zeros(len(own))
    for k, place in enumerate(own):
        if isinstance(prior := given.entries[place].prior, Weighted):
            weight[k, k], known[k] = 1 / float(prior.sigma) ** 2, float(prior.value)
    for joint in given.together:
        inside = [k for k, place in enumerate(joint.parameters) if int(place) in at]
        if inside:
            mine = [at[int(joint.parameters[k])] for k in inside]
            weight[np.ix_(mine, mine)] = np.linalg.inv(np.asarray(joint.covariance)[np.ix_(inside, inside)])
    return weight, known


def _solved(
    matrix: Float[np.ndarray, "k k"], right: Float[np.ndarray, "k"]
) -> tuple[float, int, Float[np.ndarray, "k k"]]:
    """right' inverse right, the rank and the inverse over what is not zero by rounding."""
    values, vectors = np.linalg.eigh(matrix)
    kept = values > _SHOWS
    half = vectors[:, kept] / np.sqrt(values[kept])
    return float(np.sum((right @ half) ** 2)), int(kept.sum()), half @ half.T


def _tail(square_sum: float, freedom: int, redundancy: int) -> float:
    """Probability that a square sum over the a posteriori variance factor is as large as this; 1 without redundancy."""
    if freedom == 0 or redundancy <= 0:
        return 1.0
    return beta_tail(square_sum / (square_sum + redundancy), freedom / 2, redundancy / 2)


@shown
class CameraDrift(NamedTuple):
    """How one camera changed from its first exposure to its last, or from the coldest to the warmest (mm; K1 in its
    unit); one entry a rate."""

    camera: str
    rates: type[AbstractCameraRates]
    span: float
    """From end to end, in the unit of `rates.along`."""
    parameters: tuple[str, ...]
    """As `AbstractCameraRates` names them, without their ends: c, xp, yp, k1."""
    change: ZeroTest


@shown
class CameraDifferences(NamedTuple):
    """What cameras have more than the camera of the block (mm), by strip or by knot; one entry an estimated number."""

    camera: str
    """Whose knots; "" of strips."""
    at: tuple[str, ...]
    """The strip, or the time of the knot from the middle of the flight in minutes."""
    parameters: tuple[str, ...]
    """As `StripCamera` and `CameraSpline` name them, without their ends: c, xp, yp."""
    more: ZeroTest


def camera_drifts(adjusted: Adjustment, covariance: Covariance) -> list[CameraDrift]:
    """Of every camera with estimated rates, those of time first."""
    found, cameras = [], np.array(adjusted.block.image_camera)
    for rates in RATES:
        along = np.asarray(rates.argument(exposures(adjusted.block)))
        for camera in adjusted.unknowns.more.get(rates.kind, {}):
            if estimated := _estimated(adjusted, rates.kind, camera):
                span = float(np.ptp(along[cameras == camera]))
                names = tuple(name.split("_")[0] for name in estimated.values())
                test = zero_test(adjusted, covariance, [*estimated], span)
                found.append(CameraDrift(camera, rates, span, names, test))
    return found


def strip_differences(adjusted: Adjustment, covariance: Covariance) -> CameraDifferences | None:
    """Of all strips whose cameras were estimated; None where none was. Steps from strip to strip are observations."""
    strips, names, labels = [], [], []
    for strip in adjusted.unknowns.more.get(StripCamera.kind, {}):
        for label, name in _estimated(adjusted, StripCamera.kind, strip).items():
            strips.append(strip)
            names.append(name.split("_")[0])
            labels.append(label)
    if not labels:
        return None
    return CameraDifferences("", tuple(strips), tuple(names), zero_test(adjusted, covariance, labels))


def camera_wanderings(adjusted: Adjustment, covariance: Covariance) -> list[CameraDifferences]:
    """Of every camera with an estimated spline."""
    found: list[CameraDifferences] = []
    spline: Any
    for camera, spline in adjusted.unknowns.more.get(CameraSpline.kind, {}).items():
        if estimated := _estimated(adjusted, CameraSpline.kind, camera):
            names, knots, _ = zip(*(name.split("_") for name in estimated.values()), strict=True)
            minutes = tuple(f"{spline.times[int(knot) - 1] / 60:.3g}" for knot in knots)
            found.append(CameraDifferences(camera, minutes, names, zero_test(adjusted, covariance, [*estimated])))
    return found


def _estimated(adjusted: Adjustment, kind: str, owner: str) -> dict[str, str]:
    """The names of the estimated parameters of an owner, by their labels."""
    own = f"{kind}[{owner}]."
    return {label: label.removeprefix(own) for label in adjusted.structure.labels if label.startswith(own)}
