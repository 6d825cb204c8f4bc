"""Least-squares adjustment of a block.

`model` defines unknowns and residuals, `layout` their arrangement in memory, `solver` the solution. Other packages use
`NormalEquations` rather than the last two.
"""

from jaxphoto.adjustment.adjust import MAX_STEPS, LaidOut, common_sizes, lay_out, linearise, solve
from jaxphoto.adjustment.layout.padded import PaddedResiduals, PaddedStructure, PaddedValues
from jaxphoto.adjustment.layout.padding import PaddedBlock
from jaxphoto.adjustment.layout.rays import LEAST, Sizes
from jaxphoto.adjustment.normal_equations import Cofactors, Linearised, Met, NormalEquations, RowCofactors, optimise
from jaxphoto.adjustment.result import Adjustment, Outcome
from jaxphoto.adjustment.solver.levenberg_marquardt import Task, to_factor, to_optimum
from jaxphoto.adjustment.solver.optimum import TOLERANCE
from jaxphoto.adjustment.weak_directions import POOR, WeakDirection, weak_directions, yardsticks
from jaxphoto.adjustment.weak_words import WeakUnknowns, weaknesses_of

__all__ = [
    "LEAST",
    "MAX_STEPS",
    "POOR",
    "TOLERANCE",
    "Adjustment",
    "Cofactors",
    "LaidOut",
    "Linearised",
    "Met",
    "NormalEquations",
    "Outcome",
    "PaddedBlock",
    "PaddedResiduals",
    "PaddedStructure",
    "PaddedValues",
    "RowCofactors",
    "Sizes",
    "Task",
    "WeakDirection",
    "WeakUnknowns",
    "common_sizes",
    "lay_out",
    "linearise",
    "optimise",
    "solve",
    "to_factor",
    "to_optimum",
    "weak_directions",
    "weaknesses_of",
    "yardsticks",
]  # fmt: skip
