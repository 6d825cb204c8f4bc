"""Control of a block: surveyed points and their marks, transformation to the control frame, adjustment and tests."""

from jaxphoto.procedures.control.control_block import ControlledBlock, at_optimum, control_block, retest
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints

__all__ = [
    "ControlledBlock",
    "GivenControl",
    "Marks",
    "SurveyedPoints",
    "at_optimum",
    "control_block",
    "retest",
]
