"""Least-squares adjustment of a block: residuals, coloured Jacobians, normal equations, datum, solution, result."""

from jaxphoto.adjustment.adjust import MAX_STEPS, solve
from jaxphoto.adjustment.result import Adjustment, Outcome

__all__ = ["MAX_STEPS", "Adjustment", "Outcome", "solve"]
