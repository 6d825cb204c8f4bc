"""DBAT (Damped Bundle Adjustment Toolbox) scripts."""

from jaxphoto.io.dbat.dbat_reader import CAMERA, control_table, read_dbat, recognises

__all__ = ["CAMERA", "control_table", "read_dbat", "recognises"]
