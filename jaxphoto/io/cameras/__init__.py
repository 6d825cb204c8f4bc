"""Camera files of this and other programs: one interior orientation in, one out."""

from jaxphoto.io.cameras.camera_file import ASSUMED_PIXEL_MM, CameraFile
from jaxphoto.io.cameras.camera_reader import CAMERAS_READ, read_camera_file
from jaxphoto.io.cameras.camera_writer import CAMERA_FORMATS, CAMERA_MODELS, LOSS_PX, write_camera_file

__all__ = [
    "ASSUMED_PIXEL_MM",
    "CAMERAS_READ",
    "CAMERA_FORMATS",
    "CAMERA_MODELS",
    "LOSS_PX",
    "CameraFile",
    "read_camera_file",
    "write_camera_file",
]
