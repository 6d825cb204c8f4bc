"""Did a camera change during its flight, and how small a change would the flight have shown?

The changes d = (rate times duration) of all estimated rates of a camera have the cofactors Q. Where none is true,

    F = d' Q^-1 d / (f sigma0^2)

of f rates follows the distribution of Fisher with f and r degrees of freedom, r the redundancy. A change of parameter k
alone, by D, gives f F the noncentrality D^2 (Q^-1)_kk / sigma0^2. Where that is lambda(f), the noncentral chi-square of
f degrees of freedom is beyond its limit of 5 % with the power of 80 %. So the least change that is found so is

    D_k = sigma0 sqrt(lambda(f) / (Q^-1)_kk)

which is (1.96 + 0.84) sigma of the change where one rate is estimated. What was known of rates beforehand has no part
in this: it is taken out of Q and d.

Sources: Baarda (1968), A testing procedure for use in geodetic networks; Teunissen (2000), Testing theory.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import exposures
from jaxphoto.camera import CameraRates
from jaxphoto.camera.camera_rates import HOUR_S
from jaxphoto.statistics.covariance import Covariance
from jaxphoto.statistics.quantiles import beta_tail, chi_square_shift
from jaxphoto.statistics.significance import SIGNIFICANCE_LEVEL
from jaxphoto.unknowns import Weighted

POWER = 0.80
"""Probability with which a change of the `detectable` size is found."""
# Of what an adjustment knows of a change: where the flight itself adds no more, it shows nothing.
_SHOWS = 1e-6


class CameraDrift(NamedTuple):
    """How one camera changed from its first exposure to its last; one entry an estimated rate.

    Changes are in mm, that of K1 in its unit. `change` and `sigma` (a posteriori) are those of the adjustment;
    `p_values`, of each change alone, `p_value`, of all together, and `detectable` leave out what was known beforehand.
    """

    camera: str
    hours: float
    parameters: tuple[str, ...]
    """As `CameraRates` names them, without their ends: c, xp, yp, k1."""
    change: Float[np.ndarray, "rates"]
    sigma: Float[np.ndarray, "rates"]
    p_values: Float[np.ndarray, "rates"]
    detectable: Float[np.ndarray, "rates"]
    p_value: float

    @property
    def moved(self) -> bool:
        """Whether a camera that did not change is less likely to look like this than `SIGNIFICANCE_LEVEL`."""
        return self.p_value < SIGNIFICANCE_LEVEL


def camera_drifts(adjusted: Adjustment, covariance: Covariance) -> list[CameraDrift]:
    """Of every camera with estimated rates. KnownParameters of rates count as shown by the flight."""
    found, times = [], np.asarray(exposures(adjusted.block).in_flight)
    cameras = np.array(adjusted.block.image_camera)
    for camera, rates in adjusted.unknowns.more.get(CameraRates.kind, {}).items():
        fields = {rates.labels(camera)[k]: field for k, field in enumerate(CameraRates.names)}
        labels = [label for label in fields if label in covariance.labels]
        if labels:
            hours = float(np.ptp(times[cameras == camera])) / HOUR_S
            found.append(_tested(adjusted, covariance, camera, {label: fields[label] for label in labels}, hours))
    return found


def _tested(
    adjusted: Adjustment, covariance: Covariance, camera: str, fields: dict[str, str], hours: float
) -> CameraDrift:
    places = [covariance.labels.index(label) for label in fields]
    rates, known = (u.more[CameraRates.kind][camera] for u in (adjusted.unknowns, adjusted.priors))
    change = hours * np.array([float(getattr(rates, field)) for field in fields.values()])
    q = hours**2 * np.asarray(covariance.matrix)[np.ix_(places, places)]
    weight, value = np.zeros(len(places)), np.zeros(len(places))
    for k, field in enumerate(fields.values()):
        if isinstance(prior := getattr(known, field), Weighted):
            weight[k], value[k] = 1 / (hours * float(prior.sigma)) ** 2, hours * float(prior.value)
    # In units of the standard deviations that the adjustment gives, all that it knows is the inverse correlation.
    sigma = np.sqrt(np.diagonal(q))
    whole = np.linalg.inv(q / np.outer(sigma, sigma))
    shown = whole - np.diag(weight * sigma**2)
    right = whole @ (change / sigma) - weight * sigma * value
    factor, r = float(covariance.variance_factor), adjusted.redundancy
    explained, freedom, inverse = _solved(shown, right)
    alone = np.diagonal(inverse)
    ratio = np.divide((inverse @ right) ** 2, alone, out=np.zeros(len(places)), where=alone > 0)
    own = np.maximum(np.diagonal(shown), 0.0)
    shift = chi_square_shift(max(freedom, 1), SIGNIFICANCE_LEVEL, POWER) * factor
    least = np.divide(shift, own, out=np.full(len(places), np.inf), where=own > _SHOWS)
    return CameraDrift(
        camera,
        hours,
        tuple(field.removesuffix("_rate") for field in fields.values()),
        change,
        sigma * factor**0.5,
        np.array([_tail(v / factor, 1, r) for v in ratio]),
        sigma * np.sqrt(least),
        _tail(explained / factor, freedom, r),
    )


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
