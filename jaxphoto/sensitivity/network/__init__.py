"""Network design: planned layouts, their covariance as a differentiable function, and gradient-based search."""

from jaxphoto.sensitivity.network.covariance import (
    NetworkCovariance,
    a_criterion,
    d_criterion,
    design_covariance,
    e_criterion,
    largest_correlation,
    mean_correlation,
    point_rmse,
    sigma_of,
)
from jaxphoto.sensitivity.network.layout import Layout, StripDesign, StripPlan, block_from_layout
from jaxphoto.sensitivity.network.search import (
    best_designs,
    evaluate_designs,
    grid_designs,
    optimise_design,
    stack_designs,
)

__all__ = [
    "Layout", "NetworkCovariance", "StripDesign", "StripPlan", "a_criterion", "best_designs", "block_from_layout",
    "d_criterion", "design_covariance", "e_criterion", "evaluate_designs", "grid_designs", "largest_correlation",
    "mean_correlation", "optimise_design", "point_rmse", "sigma_of", "stack_designs",
]  # fmt: skip
