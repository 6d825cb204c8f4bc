"""Formats of other programs. Each module converts between its files and `Project`, and declares its formats.

Modules declare FORMATS (oriented projects), CAMERAS (camera files) and CONTROL (control points and image marks);
`convert` registers them.
"""

from jaxphoto.extras.formats.convert import (
    CAMERA_FORMATS,
    CAMERAS_WRITTEN,
    CONTROL_FORMATS,
    EXPORTS,
    FORMATS,
    LOSS_PX,
    convert,
    export,
    read_control,
    read_source,
    read_tables,
    recognise,
    write_camera_file,
)
from jaxphoto.extras.formats.project import ControlPoints, Project, ProjectCamera

__all__ = [
    "CAMERAS_WRITTEN", "CAMERA_FORMATS", "CONTROL_FORMATS", "EXPORTS", "FORMATS", "LOSS_PX",
    "ControlPoints", "Project", "ProjectCamera", "convert", "export", "read_control",
    "read_source", "read_tables", "recognise", "write_camera_file",
]  # fmt: skip
