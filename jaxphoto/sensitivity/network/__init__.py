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
from jaxphoto.sensitivity.network.layout import (
    Layout,
    StripDesign,
    StripPlan,
    block_from_layout,
    check_layout,
    design_from_plan,
    strip_images,
)
from jaxphoto.sensitivity.network.search import (
    DesignSearch,
    best_designs,
    evaluate_designs,
    grid_designs,
    optimise_design,
    random_designs,
    stack_designs,
)

__all__ = [
    "DesignSearch",
    "Layout",
    "NetworkCovariance",
    "StripDesign",
    "StripPlan",
    "a_criterion",
    "best_designs",
    "block_from_layout",
    "check_layout",
    "d_criterion",
    "design_covariance",
    "design_from_plan",
    "e_criterion",
    "evaluate_designs",
    "grid_designs",
    "largest_correlation",
    "mean_correlation",
    "optimise_design",
    "point_rmse",
    "random_designs",
    "sigma_of",
    "stack_designs",
    "strip_images",
]  # fmt: skip
