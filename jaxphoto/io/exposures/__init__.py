"""Positions of photographs in separate files (docs/exposures.md)."""

from jaxphoto.io.exposures.files import exposure_files, read_exposures
from jaxphoto.io.exposures.located import Assigned, located, with_exposures
from jaxphoto.io.exposures.records import Exposures

__all__ = ["Assigned", "Exposures", "exposure_files", "located", "read_exposures", "with_exposures"]
