"""Sensitivity of an adjustment to observations, priors and design: derivatives, Monte Carlo, network design."""

from jaxphoto.sensitivity.exact import Sensitivity, response, sensitivity
from jaxphoto.sensitivity.influence import external_reliability, station_bias, variance_shares
from jaxphoto.sensitivity.monte_carlo import Draws, Readjustment, check_draws, join_draws, monte_carlo, readjust
from jaxphoto.sensitivity.perturbation import PER, Bias, bias, noise

__all__ = [
    "PER", "Bias", "Draws", "Readjustment", "Sensitivity", "bias", "check_draws", "external_reliability",
    "join_draws", "monte_carlo", "noise", "readjust", "response", "sensitivity", "station_bias", "variance_shares",
]  # fmt: skip
