"""Image orientation from common points alone: for photographs, or for a block without initial values."""

from jaxphoto.procedures.orientation.blocks import orient_block
from jaxphoto.procedures.orientation.orient_photographs import GrossErrors, OrientationReport, Oriented, orient

__all__ = ["GrossErrors", "OrientationReport", "Oriented", "orient", "orient_block"]
