"""What follows from a `Sensitivity`: where a station bias ends, what an estimate's variance hangs on, reliability.

Each function takes the derivatives A (an estimate a row, an observation a column) that `sensitivity` gives, exact or of
first order, and the a priori standard deviations of the observations.
"""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.errors import InputError
from jaxphoto.observations import AbstractObservations, Correlated
from jaxphoto.sensitivity.biased_numbers import OBSERVED
from jaxphoto.sensitivity.exact import Sensitivity
from jaxphoto.short_repr import shown
from jaxphoto.statistics import DELTA0, covariance, minimal_detectable_biases, observation_groups, redundancy_numbers

Per = Literal["block", "strip", "image"]


@shown
class StationBias(eqx.Module):
    """Change of every estimate (as `Sensitivity.labels`) where all stations of a unit are off along one axis."""

    change: Float[np.ndarray, "estimates units 3"]
    units: tuple[str, ...] = eqx.field(static=True)
    bias_m: float = eqx.field(static=True)


@shown
class VarianceShares(eqx.Module):
    """Shares of each estimate's variance by observation; over all groups a row sums to 1.

    Shaped like `Sensitivity.groups`; rows of what is held fixed are zero. `variance` is their common measure: the a
    priori variance A diag(sigma^2) A' of the estimate, in its unit squared.
    """

    groups: dict[str, Float[np.ndarray, "estimates _"]]
    variance: Float[np.ndarray, "estimates"]

    @property
    def by_group(self) -> dict[str, Float[np.ndarray, "estimates"]]:
        """The shares of whole groups of observations."""
        return {name: share.sum(axis=1) for name, share in self.groups.items()}


@shown
class ExternalReliability(eqx.Module):
    """Minimal detectable errors, and what one of that size does to every estimate if it is not detected.

    Shaped like `Sensitivity.groups`, in the observations' and the estimates' units. Infinite where nothing checks an
    observation: no error there would be found.
    """

    detectable: dict[str, Float[np.ndarray, "_"]]
    effect: dict[str, Float[np.ndarray, "estimates _"]]
    delta0: float = eqx.field(static=True)


def station_bias(
    adjusted: Adjustment, derivatives: Sensitivity, per: Per = "strip", bias_m: float = 0.10
) -> StationBias:
    """What a bias (m) of all observed stations of the block, of each strip, or of each image does to the estimates.

    Of exposures on the trajectory of a scanner, too: they alone have it, its laser returns have not.

        change = bias sum_k A_k     over the station rows k of the unit along one axis, X, Y or Z

    Raises InputError for another `per`, where no station is observed, and where no image has a strip.
    """
    block = adjusted.block
    whose = {"block": ("block",) * len(block.images), "strip": block.image_strip, "image": block.images}
    if per not in whose:
        raise InputError(f"a station bias is per {', '.join(whose)}, not per {per}: name one of these")
    stations = {name: rows for name, rows in block.named_observations.items() if isinstance(rows, OBSERVED["station"])}
    if not stations:
        raise InputError("the block has no observed stations that could have a bias: add stations")
    of_row = [whose[per][i] for rows in stations.values() for i in rows.who]  # type: ignore[attr-defined]
    units = tuple(unit for unit in dict.fromkeys(of_row) if unit)
    if not units:
        raise InputError("no image with an observed station has a strip: ask for the bias per block or per image")
    place = {unit: k for k, unit in enumerate(units)}
    unit = np.array([place.get(name, len(units)) for name in of_row])
    change = np.zeros((len(units) + 1, 3, len(derivatives.labels)))
    axis = np.concatenate([rows.axis for rows in stations.values()])  # type: ignore[attr-defined]
    by_row = np.concatenate([derivatives[name].T for name in stations])
    np.add.at(change, (unit, axis), bias_m * by_row)
    return StationBias(change[:-1].transpose(2, 0, 1), units, bias_m)


def variance_shares(adjusted: Adjustment, derivatives: Sensitivity) -> VarianceShares:
    """Which observations an estimate hangs on: the share A_k^2 sigma_k^2 of each in the estimate's variance."""
    rows = observation_groups(adjusted)
    parts = {name: _shares(a, rows[name]) for name, a in derivatives.groups.items()}
    variance = np.sum([part.sum(axis=1) for part in parts.values()], axis=0)
    known = np.where(variance > 0, variance, 1.0)[:, None]
    return VarianceShares({name: part / known for name, part in parts.items()}, variance)


def _shares(a: Float[np.ndarray, "estimates n"], rows: AbstractObservations) -> Float[np.ndarray, "estimates n"]:
    """What each observation adds to A C A', whose sum over the observations it is."""
    if isinstance(rows, Correlated):
        by_set = a.reshape(len(a), len(rows), -1)
        return (by_set * np.einsum("esn,snm->esm", by_set, np.asarray(rows.covariance))).reshape(a.shape)
    return (a * np.ravel(rows.sigmas)) ** 2


def external_reliability(adjusted: Adjustment, derivatives: Sensitivity, delta0: float = DELTA0) -> ExternalReliability:
    """The effect on every estimate of an error that the test of normalised residuals just fails to detect (Baarda).

        detectable_k = delta0 sigma_k / sqrt(r_k),   effect_k = A_k detectable_k

    with the redundancy number r_k of the observation. `delta0` is the non-centrality of the test: 4.13 for a level of
    0.1 % and a power of 80 %.

    Raises InputError for a delta0 that is not positive.
    """
    if not delta0 > 0:
        raise InputError(f"delta0 is the shift that a test detects, a positive number, not {delta0}")
    numbers = redundancy_numbers(adjusted, covariance(adjusted, rows=True))
    detectable, effect = {}, {}
    for name, errors in minimal_detectable_biases(adjusted, numbers, delta0).items():
        detectable[name] = _in_rows(errors)
        a = derivatives.groups[name]
        effect[name] = np.multiply(a, detectable[name], out=np.zeros_like(a), where=a != 0)
    return ExternalReliability(detectable, effect, delta0)


def _in_rows(values: np.ndarray) -> Float[np.ndarray, "n"]:
    """Components first, rows last, as one list: the components of a row in turn."""
    return values.T.ravel()
