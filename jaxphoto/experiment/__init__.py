"""Experiments: variants of simulated blocks whose tables stand beside what papers print."""

from jaxphoto.experiment.comparison import compare, read_published, side_by_side
from jaxphoto.experiment.declaration import Cells, Experiment, Measure, Results, Variant
from jaxphoto.experiment.folder import find_experiments, load_experiment, write_runs
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
from jaxphoto.experiment.monte_carlo import MonteCarlo
from jaxphoto.experiment.plots import comparison_figure, plot_agreement, plot_comparison
from jaxphoto.experiment.runner import Run, run_experiment, simulated, summary

__all__ = [
    "Cells", "Experiment", "Measure", "MonteCarlo", "Results", "Run", "Variant", "boresight_correlation",
    "check_points", "compare", "comparison_figure", "effects", "find_experiments", "iops",
    "load_experiment", "mean_correlations", "misalignment", "misalignment_agreement", "named",
    "orientation_differences", "plot_agreement", "plot_comparison",
    "principal_point", "read_published", "recovered", "residuals", "run_experiment",
    "side_by_side", "simulated", "summary", "tie_point_differences", "write_runs",
]  # fmt: skip
