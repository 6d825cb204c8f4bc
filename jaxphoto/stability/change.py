"""Has a camera changed between two calibrations? By its parameters, by its bundle of rays, and where in the format."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.camera import (
    InteriorOrientation,
    constant_names,
    get_parameter,
    model_keys,
    parameter_names,
    parameter_unit,
)
from jaxphoto.errors import InputError
from jaxphoto.short_repr import change_html, change_repr, shown
from jaxphoto.stability.alignment import Method
from jaxphoto.stability.analysis import SIGNIFICANT_P, Analysis
from jaxphoto.stability.band import square_radius
from jaxphoto.stability.bundles import parameter_vector
from jaxphoto.stability.comparison import bundle_offsets, check_rays
from jaxphoto.stability.uncertainty import offset_uncertainty

# Parts of the largest eigenvalue of a matrix of correlations below which there is nothing but rounding.
_ROUNDING = 1e-12


@shown
class ParameterChange(NamedTuple):
    """One parameter in two calibrations, in its own unit: second minus first, and how sure that is."""

    parameter: str
    first: float
    second: float
    difference: float
    sigma: float
    """Of the difference; 0 where both hold the parameter,"""
    p_value: float
    """and NaN then: how probable so large a difference is if the parameter did not change."""
    unit: str
    """Of the numbers above: mm, 1/mm^2, "1" of a number without one."""


class Change(NamedTuple):
    """Two calibrations of a camera compared."""

    parameters: tuple[ParameterChange, ...]
    """None where they are of different models."""
    chi_square: float
    """d' Q^-1 d of all differences together, Q the sum of both covariances; NaN where there are no parameters,"""
    degrees_of_freedom: int
    p_parameters: float
    """and how probable a larger one is if the camera did not change."""
    field: Analysis
    """The two bundles of rays after alignment, and the same probability of what is between them."""
    limit_mm: Float[np.ndarray, "points"]
    """What 95 % of the offsets of two such calibrations of one camera stay below at each point, in the measured
    image."""

    @property
    def offset_mm(self) -> Float[np.ndarray, "points"]:
        """Lengths of the offsets in the measured image."""
        return np.linalg.norm(np.asarray(self.field.offsets.measured), axis=1)

    @property
    def beyond(self) -> Bool[np.ndarray, "points"]:
        """Where offsets are larger than `limit_mm`: at one point in twenty, if the camera did not change."""
        return self.offset_mm > self.limit_mm

    @property
    def p_field(self) -> float:
        """How probable a larger difference of the bundles is if the camera did not change; NaN where none is known."""
        known = self.field.uncertainty
        return float("nan") if known is None else float(known.p_value)

    @property
    def changed(self) -> bool:
        """Whether a test, of parameters or of bundles, says so."""
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
    """Compare two calibrations by independent photographs: parameters, and bundles over image points (mm).

    `covariances` are a posteriori, in the order of `parameter_names`; a set without is taken as exact. Raises
    InputError where both are None, a distortion means nothing at some of the points, or bundles cannot be aligned.
    """
    if covariances[0] is None and covariances[1] is None:
        raise InputError("neither calibration has a covariance, so nothing tells whether a difference is a change")
    for name, interior in (("the first camera", first), ("the second camera", second)):
        check_rays(interior, points, name)
    offsets = bundle_offsets(first, second, points, method)
    if not bool(offsets.converged):
        raise InputError(f"the two bundles cannot be aligned by {method}: they are not of one camera")
    q1, q2 = (
        np.zeros((len(parameter_names(interior)), len(parameter_names(interior)))) if own is None else np.asarray(own)
        for interior, own in zip((first, second), covariances, strict=True)
    )
    p = len(q1)
    rows = np.asarray(offsets.measured_jacobian).reshape(len(points), 2, -1)
    by_point = np.einsum("nip,pq,njq->nij", rows[..., :p], q1, rows[..., :p])
    by_point += np.einsum("nip,pq,njq->nij", rows[..., p:], q2, rows[..., p:])
    parameters: tuple[ParameterChange, ...] = ()
    chi_square, freedom, p_value = float("nan"), 0, float("nan")
    if of_one_model(first, second):
        parameters = _parameters(first, second, q1 + q2)
        chi_square, freedom = mahalanobis(np.array([one.difference for one in parameters]), q1 + q2)
        p_value = float(scipy.special.chdtrc(freedom, chi_square)) if freedom else float("nan")
    field = Analysis(method, offsets, offset_uncertainty(offsets, *covariances))
    return Change(parameters, chi_square, freedom, p_value, field, np.sqrt(square_radius(by_point)))


def mahalanobis(difference: Float[np.ndarray, "n"], covariance: Float[np.ndarray, "n n"]) -> tuple[float, int]:
    """d' Q^-1 d and its degrees of freedom, in the directions in which Q is not zero."""
    known = np.diagonal(covariance) > 0
    sigma = np.sqrt(np.diagonal(covariance)[known])
    values, axes = np.linalg.eigh(covariance[np.ix_(known, known)] / sigma[:, None] / sigma)
    kept = values > _ROUNDING * values.max(initial=0.0)
    along = (difference[known] / sigma) @ axes[:, kept]
    return float((along**2 / values[kept]).sum()), int(kept.sum())


def of_one_model(first: InteriorOrientation, second: InteriorOrientation) -> bool:
    """Whether the parameters of both mean the same."""
    constants = [{n: float(get_parameter(i, n)) for n in constant_names(i)} for i in (first, second)]
    return model_keys(first) == model_keys(second) and constants[0] == constants[1]


def _parameters(
    first: InteriorOrientation, second: InteriorOrientation, covariance: Float[np.ndarray, "n n"]
) -> tuple[ParameterChange, ...]:
    one, other = (np.asarray(parameter_vector(interior)) for interior in (first, second))
    sigma = np.sqrt(np.diagonal(covariance))
    found = []
    for name, a, b, s in zip(parameter_names(first), one, other, sigma, strict=True):
        p_value = 2 * float(scipy.special.ndtr(-abs(b - a) / s)) if s > 0 else float("nan")
        numbers = float(a), float(b), float(b - a), float(s), p_value
        found.append(ParameterChange(name, *numbers, parameter_unit(first, name)))
    return tuple(found)
