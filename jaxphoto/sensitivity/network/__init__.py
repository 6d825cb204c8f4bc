"""Network design: layouts on paper, their covariance as a differentiable function, and the search by its gradient."""

from jaxphoto.sensitivity.network.block import check_layout, measured_block
from jaxphoto.sensitivity.network.covariance import NetworkCovariance, design_covariance
from jaxphoto.sensitivity.network.criteria import (
    a_criterion,
    d_criterion,
    e_criterion,
    largest_correlation,
    mean_correlation,
    point_rmse,
    sigma_of,
)
from jaxphoto.sensitivity.network.layout import Layout
from jaxphoto.sensitivity.network.search import (
    DesignSearch,
    evaluate_designs,
    grid_designs,
    optimise_design,
    promising,
    random_designs,
    stacked,
)
from jaxphoto.sensitivity.network.strips import StripDesign, StripPlan, planned_design, strip_images

__all__ = [
    "DesignSearch", "Layout", "NetworkCovariance", "StripDesign", "StripPlan", "a_criterion", "check_layout",
    "d_criterion", "design_covariance", "e_criterion", "evaluate_designs", "grid_designs", "largest_correlation",
    "mean_correlation", "measured_block", "optimise_design", "planned_design", "point_rmse", "promising",
    "random_designs", "sigma_of", "stacked", "strip_images",
]  # fmt: skip
