"""An adjustment as a function of its observations, priors and design: derivatives, Monte Carlo, network design."""

from jaxphoto.sensitivity.monte_carlo import Draws, Readjustment, check_draws, joined_draws, monte_carlo, readjust
from jaxphoto.sensitivity.perturbation import PER, Bias, Perturbation, bias, noise

__all__ = [
    "PER", "Bias", "Draws", "Perturbation", "Readjustment", "bias", "check_draws", "joined_draws", "monte_carlo",
    "noise", "readjust",
]  # fmt: skip
