"""Files beside photographs that say where and when they were exposed (docs/exposures.md)."""

from jaxphoto.io.exposures.assigned import Assigned, with_exposures
from jaxphoto.io.exposures.located import exposure_files, located, read_exposures
from jaxphoto.io.exposures.marks import read_marks
from jaxphoto.io.exposures.records import Exposures
from jaxphoto.io.exposures.rtklib import read_pos
from jaxphoto.io.exposures.sbet import read_sbet_exposures
from jaxphoto.io.exposures.table import read_table

__all__ = [
    "Assigned", "Exposures", "exposure_files", "located", "read_exposures", "read_marks", "read_pos",
    "read_sbet_exposures", "read_table", "with_exposures",
]  # fmt: skip
