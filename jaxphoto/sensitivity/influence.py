"""Influence of observations on estimates: station bias, variance fractions, external reliability.

Each function uses the derivatives A of `sensitivity` (one row per estimate, one column per observation; exact or first
order) and the a priori standard deviations of the observations.
"""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.errors import InputError
from jaxphoto.observations import AbstractObservations, Correlated
from jaxphoto.sensitivity.exact import Sensitivity
from jaxphoto.sensitivity.perturbation import OBSERVED
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics import DELTA0, covariance, minimal_detectable_biases, observation_groups, redundancy_numbers

Per = Literal["block", "strip", "image"]


@pretty_repr
class StationBias(eqx.Module):
    """Change of every estimate (`Sensitivity.labels`) due to a bias of all stations of a unit along one axis."""

    change: Float[np.ndarray, "estimates units 3"]
    units: tuple[str, ...] = eqx.field(static=True)
    bias_m: float = eqx.field(static=True)


@pretty_repr
class VarianceShares(eqx.Module):
    """Fraction of each estimate's variance due to each observation.

    Over all groups the fractions of an estimate sum to 1. Shaped like `Sensitivity.groups`. Rows of fixed parameters
    are zero. `variance` is the a priori variance of each estimate, diag(A diag(sigma^2) A'), in its unit squared.
    """

    groups: dict[str, Float[np.ndarray, "estimates _"]]
    variance: Float[np.ndarray, "estimates"]

    @property
    def by_group(self) -> dict[str, Float[np.ndarray, "estimates"]]:
        """Sum of the fractions of each group of observations."""
        return {name: fraction.sum(axis=1) for name, fraction in self.groups.items()}


@pretty_repr
class ExternalReliability(eqx.Module):
    """Minimal detectable biases (MDB), and the effect of each on every estimate if it is undetected.

    Shaped like `Sensitivity.groups`, in the units of observations and estimates. Infinite for observations with
    redundancy number zero, whose errors are undetectable.
    """

    mdb: dict[str, Float[np.ndarray, "_"]]
    effect: dict[str, Float[np.ndarray, "estimates _"]]
    delta0: float = eqx.field(static=True)


def station_bias(
    adjusted: Adjustment, derivatives: Sensitivity, per: Per = "strip", bias_m: float = 0.10
) -> StationBias:
    """Compute the change of the estimates due to a bias (m) of all observed stations.

        change = bias sum_k A_k     over the station rows k of the unit along one axis, X, Y or Z

    The unit is the block, each strip or each image. Stations include exposures on the trajectory of a scanner; its
    laser returns are not affected. Raises InputError for an invalid `per`, without observed stations, and without
    strips.
    """
    block = adjusted.block
    unit_of = {"block": ("block",) * len(block.images), "strip": block.image_strip, "image": block.images}
    if per not in unit_of:
        raise InputError(f"unknown unit {per} of a station bias: choose among {', '.join(unit_of)}")
    stations = {name: rows for name, rows in block.named_observations.items() if isinstance(rows, OBSERVED["station"])}
    if not stations:
        raise InputError("the block has no observed stations: add stations to compute a station bias")
    row_units = [unit_of[per][i] for rows in stations.values() for i in rows.who]  # type: ignore[attr-defined]
    units = tuple(unit for unit in dict.fromkeys(row_units) if unit)
    if not units:
        raise InputError("no image with an observed station has a strip: compute the bias per block or per image")
    place = {unit: k for k, unit in enumerate(units)}
    unit = np.array([place.get(name, len(units)) for name in row_units])
    change = np.zeros((len(units) + 1, 3, len(derivatives.labels)))
    axis = np.concatenate([rows.axis for rows in stations.values()])  # type: ignore[attr-defined]
    by_row = np.concatenate([derivatives[name].T for name in stations])
    np.add.at(change, (unit, axis), bias_m * by_row)
    return StationBias(change[:-1].transpose(2, 0, 1), units, bias_m)


def variance_shares(adjusted: Adjustment, derivatives: Sensitivity) -> VarianceShares:
    """Compute the fraction A_k^2 sigma_k^2 / variance of each observation for every estimate."""
    rows = observation_groups(adjusted)
    parts = {name: _shares(a, rows[name]) for name, a in derivatives.groups.items()}
    variance = np.sum([part.sum(axis=1) for part in parts.values()], axis=0)
    divisor = np.where(variance > 0, variance, 1.0)[:, None]
    return VarianceShares({name: part / divisor for name, part in parts.items()}, variance)


def _shares(a: Float[np.ndarray, "estimates n"], rows: AbstractObservations) -> Float[np.ndarray, "estimates n"]:
    """Return the contribution of each observation to A C A'."""
    if isinstance(rows, Correlated):
        by_set = a.reshape(len(a), len(rows), -1)
        return (by_set * np.einsum("esn,snm->esm", by_set, np.asarray(rows.covariance))).reshape(a.shape)
    return (a * np.ravel(rows.sigmas)) ** 2


def external_reliability(adjusted: Adjustment, derivatives: Sensitivity, delta0: float = DELTA0) -> ExternalReliability:
    """Compute the effect on every estimate of an error at the detection limit (external reliability, Baarda).

        MDB_k = delta0 sigma_k / sqrt(r_k),   effect_k = A_k MDB_k

    r_k is the redundancy number of the observation. `delta0` is the noncentrality of the test: 4.13 for a level of 0.1
    % and a power of 80 %. Raises InputError for a delta0 that is not positive.
    """
    if not delta0 > 0:
        raise InputError(f"delta0, the noncentrality of the test, must be positive, got {delta0}")
    numbers = redundancy_numbers(adjusted, covariance(adjusted, rows=True))
    mdb, effect = {}, {}
    for name, values in minimal_detectable_biases(adjusted, numbers, delta0).items():
        # The components of a row are consecutive.
        mdb[name] = values.T.ravel()
        a = derivatives.groups[name]
        effect[name] = np.multiply(a, mdb[name], out=np.zeros_like(a), where=a != 0)
    return ExternalReliability(mdb, effect, delta0)
