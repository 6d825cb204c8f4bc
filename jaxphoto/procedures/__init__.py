"""Procedures: short scripts that combine the packages below."""

from jaxphoto.procedures.adjust import adjust, adjust_for_tables
from jaxphoto.procedures.boresight import BoresightEstimate, Step, boresight, judge, step_block
from jaxphoto.procedures.exchanges import Exchange
from jaxphoto.procedures.georeference import Georeferenced, georeference
from jaxphoto.procedures.robust import Robust, robust
from jaxphoto.procedures.snooping import Snooped, snoop

__all__ = [
    "BoresightEstimate", "Exchange", "Georeferenced", "Robust", "Snooped", "Step", "adjust", "adjust_for_tables",
    "boresight", "georeference", "judge", "robust", "snoop", "step_block",
]  # fmt: skip
