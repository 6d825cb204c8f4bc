"""Comparison of calibrations: uncertainty of RMSE_offset, stability analysis, change detection.

Uncertainty. The offsets are v = v0 + J e with the errors e of both parameter sets, e ~ N(0, Q), and the exact Jacobian
J (`BundleOffsets.jacobian`). RMSE_offset is a norm: for nearly equal bundles it is not normally distributed, and
first-order propagation is invalid. v'v is therefore evaluated as a quadratic form in normal variables
(`QuadraticForm`): about the estimated offsets (v0 = v) for the uncertainty, about zero (v0 = 0) for the hypothesis of
one camera.
"""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.arrays import ArrayLike
from jaxphoto.camera import (
    InteriorOrientation,
    constant_names,
    get_parameter,
    model_keys,
    parameter_names,
    parameter_unit,
)
from jaxphoto.errors import InputError
from jaxphoto.short_repr import change_html, change_repr, pretty_repr
from jaxphoto.stability.band import LEVEL, square_radius
from jaxphoto.stability.bundles import (
    METHODS,
    BundleOffsets,
    Method,
    bundle_offsets,
    check_rays,
    parameter_vector,
)
from jaxphoto.stability.quadratic_form import QuadraticForm


@pretty_repr
class OffsetUncertainty(NamedTuple):
    """Distribution of RMSE_offset from the covariances of both sets; in mm, except the p-value."""

    sigma_mm: float
    """Standard deviation of RMSE_offset over repeated calibrations of these two cameras."""
    low_mm: float
    """2.5 % quantile of RMSE_offset over repeated calibrations."""
    high_mm: float
    """97.5 % quantile of RMSE_offset over repeated calibrations."""
    expected_of_one_mm: float
    """Expected RMSE_offset of two such calibrations of one camera."""
    limit_of_one_mm: float
    """95 % quantile of RMSE_offset of two such calibrations of one camera."""
    p_value: float
    """Probability that two calibrations of one camera differ by at least this much."""
    unexplained_mm: float
    """Part of RMSE_offset not explained by the covariances: sqrt((v'v - E) / (2n - u)), E = tr(J Q J'); 0 if E > v'v.
    """


def offset_uncertainty(
    offsets: BundleOffsets,
    first: Float[ArrayLike, "p p"] | None = None,
    second: Float[ArrayLike, "p p"] | None = None,
) -> OffsetUncertainty | None:
    """Compute the uncertainty of RMSE_offset from the covariances of the parameter sets; None if both are None.

    `first` and `second` are a posteriori covariances in the order of `jaxphoto.camera.parameter_names`, with zero rows
    for fixed parameters; a set without covariance is treated as error-free. The sets must be independent, from
    different images. Raises ValueError if the size of a covariance does not match its parameters.
    """
    if first is None and second is None:
        return None
    jacobian = np.asarray(offsets.jacobian)
    # Infer the size of a missing covariance from the other one.
    p1 = len(first) if first is not None else jacobian.shape[1] - len(second)  # type: ignore[arg-type]
    p2 = jacobian.shape[1] - p1
    if (second is not None and len(second) != p2) or p1 < 0:
        sizes = " and ".join(str(len(q)) for q in (first, second) if q is not None)
        raise ValueError(
            f"covariances have {sizes} parameters, but the two sets have {jacobian.shape[1]} in total; give "
            "covariances of matching size"
        )
    covariance = np.zeros((p1 + p2, p1 + p2))
    covariance[:p1, :p1] = 0.0 if first is None else first
    covariance[p1:, p1:] = 0.0 if second is None else second
    v, f = np.asarray(offsets.offsets).ravel(), offsets.redundancy
    estimated = QuadraticForm.of_normal(v, jacobian, covariance)
    one_camera = QuadraticForm.of_normal(np.zeros_like(v), jacobian, covariance)

    def root(sum_of_squares: float) -> float:
        return float(np.sqrt(sum_of_squares / f))

    tail = (1 - LEVEL) / 2
    sum_of_squares = float(v @ v)
    return OffsetUncertainty(
        sigma_mm=estimated.sigma_of_root / f**0.5,
        low_mm=root(estimated.quantile(tail)),
        high_mm=root(estimated.quantile(1 - tail)),
        expected_of_one_mm=one_camera.mean_of_root / f**0.5,
        limit_of_one_mm=root(one_camera.quantile(LEVEL)),
        p_value=one_camera.tail_probability(sum_of_squares),
        unexplained_mm=root(max(sum_of_squares - one_camera.mean, 0.0)),
    )


# Maximum p-value of a significant change.
SIGNIFICANT_P = 0.05
# Minimum p-value reported.
_MIN_P = 1e-300


@pretty_repr
class Analysis(NamedTuple):
    """Comparison of two parameter sets by one method; `uncertainty` is None without covariances."""

    method: Method
    offsets: BundleOffsets
    uncertainty: OffsetUncertainty | None

    def similar(self, noise_mm: float) -> bool:
        """Return True if RMSE_offset does not exceed the noise of image coordinates (paper 002: about one pixel)."""
        return bool(self.offsets.rmse_mm <= noise_mm)

    def verdict(self, noise_mm: float) -> str:
        """Summarise the result of the comparison in one or two sentences."""
        rmse, uncertainty = float(self.offsets.rmse_mm), self.uncertainty
        result, side = ("similar", "within") if self.similar(noise_mm) else ("not similar", "beyond")
        text = f"{result}: RMSE_offset of {1e3 * rmse:.3g} um is {side} the noise of {1e3 * noise_mm:.3g} um"
        if uncertainty is None:
            return text + "; its uncertainty is unknown without covariances."
        if uncertainty.low_mm <= noise_mm <= uncertainty.high_mm:
            low, high = 1e3 * uncertainty.low_mm, 1e3 * uncertainty.high_mm
            text += f", but repeated calibrations would give {low:.3g} to {high:.3g} um"
        expected = f"Two calibrations of one camera would differ by {1e3 * uncertainty.expected_of_one_mm:.3g} um"
        p_value, meaning = max(uncertainty.p_value, _MIN_P), change_meaning(uncertainty.p_value)
        return f"{text}. {expected}, and by as much as this with p = {p_value:.2g}: {meaning}."


def change_meaning(p_value: float) -> str:
    """Describe the conclusion from the probability `p_value` that two calibrations of one camera differ this much."""
    changed = "the camera has changed, or many image points of a calibration share errors (see jaxphoto halves)"
    return changed if p_value < SIGNIFICANT_P else "no significant change"


def analyse(
    first: InteriorOrientation,
    second: InteriorOrientation,
    points: Float[ArrayLike, "points 2"],
    covariances: tuple[Float[ArrayLike, "p p"] | None, Float[ArrayLike, "q q"] | None] = (None, None),
    relief: float = 0.0,
) -> dict[Method, Analysis]:
    """Compare two parameter sets by zrot, rot and spr over image points (mm from the centre; see `image_grid`).

    `covariances` are a posteriori, in the order of `parameter_names` of each set. The object points of spr have
    distances alternately increased and decreased by the fraction `relief`. Raises InputError for points where a
    distortion is not invertible and for bundles too different to align, ValueError for a `relief` of 1 or more.
    """
    if not 0 <= relief < 1:
        raise ValueError(f"relief, a fraction of the object distance, must be at least 0 and below 1, got {relief:g}")
    for name, interior in (("the first camera", first), ("the second camera", second)):
        check_rays(interior, points, name)
    depth = 1 + relief * (-1.0) ** np.arange(len(points))
    analyses = {}
    for method in METHODS:
        offsets = bundle_offsets(first, second, points, method, depth)
        if not bool(offsets.converged):
            raise InputError(f"the two bundles cannot be aligned by {method}: they are not from one camera")
        analyses[method] = Analysis(method, offsets, offset_uncertainty(offsets, *covariances))
    return analyses


# Ratio to the largest eigenvalue of a correlation matrix below which an eigenvalue is treated as zero (rounding).
_ROUNDING = 1e-12


@pretty_repr
class ParameterChange(NamedTuple):
    """Change of one parameter between two calibrations, in its own unit: second minus first, with its significance."""

    parameter: str
    first: float
    second: float
    difference: float
    sigma: float
    """Standard deviation of the difference; 0 if both are fixed."""
    p_value: float
    """Probability of a larger difference without a change of the parameter; NaN if both are fixed."""
    unit: str
    """Unit of the parameter: mm, 1/mm^2, or "1" if dimensionless."""


class Change(NamedTuple):
    """Comparison of two calibrations of a camera."""

    parameters: tuple[ParameterChange, ...]
    """Changes of the parameters; None for different models."""
    chi_square: float
    """d' Q^-1 d of all differences, with the sum Q of both covariances; NaN without parameters."""
    degrees_of_freedom: int
    p_parameters: float
    """Probability of a larger chi-square without a change of the camera."""
    field: Analysis
    """Comparison of the two bundles of rays after alignment, with the p-value of their difference."""
    limit_mm: Float[np.ndarray, "points"]
    """95 % quantile, at each point, of the offsets of two such calibrations of one camera, in the measured image."""

    @property
    def offset_mm(self) -> Float[np.ndarray, "points"]:
        """Return the lengths (mm) of the offsets in the measured image."""
        return np.linalg.norm(np.asarray(self.field.offsets.measured), axis=1)

    @property
    def beyond(self) -> Bool[np.ndarray, "points"]:
        """Return True where offsets exceed `limit_mm`; expected at 5 % of the points without a change of the camera."""
        return self.offset_mm > self.limit_mm

    @property
    def p_field(self) -> float:
        """Return the p-value of the bundle difference for an unchanged camera; NaN without covariances."""
        uncertainty = self.field.uncertainty
        return float("nan") if uncertainty is None else float(uncertainty.p_value)

    @property
    def changed(self) -> bool:
        """Return True if the test of the parameters or of the bundles is significant."""
        return self.p_parameters < SIGNIFICANT_P or self.p_field < SIGNIFICANT_P

    def __repr__(self) -> str:
        return change_repr(self)

    def _repr_html_(self) -> str:
        return change_html(self)


def change(
    first: InteriorOrientation,
    second: InteriorOrientation,
    points: Float[np.ndarray, "points 2"],
    covariances: tuple[Float[np.ndarray, "p p"] | None, Float[np.ndarray, "q q"] | None],
    method: Method = "rot",
) -> Change:
    """Compare two calibrations from independent images: parameters, and bundles over image points (mm).

    `covariances` are a posteriori, in the order of `parameter_names`; a set without covariance is treated as
    error-free. Raises InputError if both are None, for points where a distortion is not invertible, and for bundles
    that cannot be aligned.
    """
    if covariances[0] is None and covariances[1] is None:
        raise InputError("neither calibration has a covariance: a change cannot be tested")
    for name, interior in (("the first camera", first), ("the second camera", second)):
        check_rays(interior, points, name)
    offsets = bundle_offsets(first, second, points, method)
    if not bool(offsets.converged):
        raise InputError(f"the two bundles cannot be aligned by {method}: they are not from one camera")
    names = [parameter_names(interior) for interior in (first, second)]
    q1, q2 = (
        np.zeros((len(n), len(n))) if q is None else np.asarray(q) for n, q in zip(names, covariances, strict=True)
    )
    p = len(q1)
    rows = np.asarray(offsets.measured_jacobian).reshape(len(points), 2, -1)
    by_point = np.einsum("nip,pq,njq->nij", rows[..., :p], q1, rows[..., :p])
    by_point += np.einsum("nip,pq,njq->nij", rows[..., p:], q2, rows[..., p:])
    parameters: tuple[ParameterChange, ...] = ()
    chi_square, freedom, p_value = float("nan"), 0, float("nan")
    if same_model(first, second):
        parameters = _parameters(first, second, q1 + q2)
        chi_square, freedom = mahalanobis(np.array([p.difference for p in parameters]), q1 + q2)
        p_value = float(scipy.special.chdtrc(freedom, chi_square)) if freedom else float("nan")
    field = Analysis(method, offsets, offset_uncertainty(offsets, *covariances))
    return Change(parameters, chi_square, freedom, p_value, field, np.sqrt(square_radius(by_point)))


def mahalanobis(difference: Float[np.ndarray, "n"], covariance: Float[np.ndarray, "n n"]) -> tuple[float, int]:
    """Return d' Q^-1 d and its degrees of freedom, restricted to the directions in which Q is not zero."""
    free = np.diagonal(covariance) > 0
    sigma = np.sqrt(np.diagonal(covariance)[free])
    values, axes = np.linalg.eigh(covariance[np.ix_(free, free)] / sigma[:, None] / sigma)
    positive = values > _ROUNDING * values.max(initial=0.0)
    along = (difference[free] / sigma) @ axes[:, positive]
    return float((along**2 / values[positive]).sum()), int(positive.sum())


def same_model(first: InteriorOrientation, second: InteriorOrientation) -> bool:
    """Return True if both cameras have the same models and constants."""
    constants = [{n: float(get_parameter(i, n)) for n in constant_names(i)} for i in (first, second)]
    return model_keys(first) == model_keys(second) and constants[0] == constants[1]


def _parameters(
    first: InteriorOrientation, second: InteriorOrientation, covariance: Float[np.ndarray, "n n"]
) -> tuple[ParameterChange, ...]:
    vectors = (np.asarray(parameter_vector(interior)) for interior in (first, second))
    sigma = np.sqrt(np.diagonal(covariance))
    changes = []
    for name, a, b, s in zip(parameter_names(first), *vectors, sigma, strict=True):
        p_value = 2 * float(scipy.special.ndtr(-abs(b - a) / s)) if s > 0 else float("nan")
        values = float(a), float(b), float(b - a), float(s), p_value
        changes.append(ParameterChange(name, *values, parameter_unit(first, name)))
    return tuple(changes)
