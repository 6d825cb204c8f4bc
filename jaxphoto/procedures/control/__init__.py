"""Control of a block: surveyed points and their marks, transformation to the control frame, adjustment and tests."""

from jaxphoto.procedures.control.control_block import ControlledBlock, at_optimum, control_block, retest
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints
from jaxphoto.procedures.control.targets import control_block_with_targets

__all__ = [
    "ControlledBlock",
    "GivenControl",
    "Marks",
    "SurveyedPoints",
    "at_optimum",
    "control_block",
    "control_block_with_targets",
    "retest",
]
