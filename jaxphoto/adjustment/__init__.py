"""Least-squares adjustment of a block.

`model` defines unknowns and residuals, `layout` their arrangement in memory, `solver` the solution. Other packages use
`NormalEquations` rather than the last two.
"""

from jaxphoto.adjustment.adjust import MAX_STEPS, Problem, build_problem, common_sizes, linearise, solve
from jaxphoto.adjustment.layout.padded import PaddedResiduals, PaddedStructure, PaddedValues
from jaxphoto.adjustment.layout.padding import PaddedBlock
from jaxphoto.adjustment.layout.rays import MINIMAL_SIZES, PaddedSizes
from jaxphoto.adjustment.normal_equations import (
    Cofactors,
    CoupledUnknowns,
    Linearised,
    NormalEquations,
    RowCofactors,
    optimise,
)
from jaxphoto.adjustment.result import Adjustment, Outcome
from jaxphoto.adjustment.solver.levenberg_marquardt import TOLERANCE, SolveMode, to_factor, to_optimum

__all__ = [
    "MAX_STEPS", "MINIMAL_SIZES", "TOLERANCE", "Adjustment", "Cofactors", "CoupledUnknowns", "Linearised",
    "NormalEquations", "Outcome", "PaddedBlock", "PaddedResiduals", "PaddedSizes", "PaddedStructure",
    "PaddedValues", "Problem", "RowCofactors", "SolveMode", "build_problem", "common_sizes", "linearise",
    "optimise", "solve", "to_factor", "to_optimum",
]  # fmt: skip
