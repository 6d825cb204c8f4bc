"""Least-squares adjustment of a block: residuals, coloured Jacobians, normal equations, datum, solution, result."""

from jaxphoto.adjustment.adjust import MAX_STEPS, common_sizes, solve
from jaxphoto.adjustment.layout import LEAST, Sizes
from jaxphoto.adjustment.result import Adjustment, Outcome

__all__ = ["LEAST", "MAX_STEPS", "Adjustment", "Outcome", "Sizes", "common_sizes", "solve"]
