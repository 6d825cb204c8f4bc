"""Experiments: variants of simulated blocks whose results are compared with the tables of published papers."""

from jaxphoto.experiment.experiment import (
    Cells,
    Experiment,
    Measure,
    Results,
    Run,
    Variant,
    compare,
    find_experiments,
    load_experiment,
    read_published,
    run_experiment,
    side_by_side,
    simulated,
    summary,
)
from jaxphoto.experiment.measures import (
    boresight_correlation,
    check_points,
    effects,
    iops,
    mean_correlations,
    misalignment,
    misalignment_agreement,
    named,
    orientation_differences,
    principal_point,
    recovered,
    residuals,
    tie_point_differences,
)
from jaxphoto.experiment.monte_carlo_run import MonteCarlo
from jaxphoto.experiment.page import comparison_figure, plot_agreement, plot_comparison, write_runs
from jaxphoto.experiment.simulated_flights import simulate_flights

__all__ = [
    "Cells", "Experiment", "Measure", "MonteCarlo", "Results", "Run", "Variant", "boresight_correlation",
    "check_points", "compare", "comparison_figure", "effects", "find_experiments", "iops", "load_experiment",
    "mean_correlations", "misalignment", "misalignment_agreement", "named", "orientation_differences", "plot_agreement",
    "plot_comparison", "principal_point", "read_published", "recovered", "residuals", "run_experiment", "side_by_side",
    "simulate_flights", "simulated", "summary", "tie_point_differences", "write_runs",
]  # fmt: skip
