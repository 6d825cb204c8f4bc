"""Files of control points and of their marks in photographs, told apart by what is in them."""

from jaxphoto.io.control_files.reader import FORMS, read_control

__all__ = ["FORMS", "read_control"]
