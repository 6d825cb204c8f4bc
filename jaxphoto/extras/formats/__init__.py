"""Formats of other programs. Each module converts between its files and `Project`, and declares its formats.

Modules declare FORMATS (oriented projects), CAMERAS (camera files) and CONTROL (control points and image marks);
`convert` registers them.
"""

from jaxphoto.extras.formats.camera_models import ProjectCamera
from jaxphoto.extras.formats.convert import (
    CAMERA_FORMATS,
    CAMERA_MODELS,
    CAMERAS_WRITTEN,
    CONTROL_FORMATS,
    EXPORTS,
    FORMATS,
    FORMS,
    LOSS_PX,
    Exported,
    convert,
    export,
    read_control,
    read_source,
    read_tables,
    recognise,
    write_camera_file,
)
from jaxphoto.extras.formats.project import ControlPoints, Project

__all__ = [
    "CAMERAS_WRITTEN", "CAMERA_FORMATS", "CAMERA_MODELS", "CONTROL_FORMATS", "EXPORTS", "FORMATS", "FORMS", "LOSS_PX",
    "ControlPoints", "Exported", "Project", "ProjectCamera", "convert", "export", "read_control",
    "read_source", "read_tables", "recognise", "write_camera_file",
]  # fmt: skip
