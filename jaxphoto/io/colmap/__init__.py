"""Models of COLMAP: cameras, images and points, as text or binary -> the tables of a block folder; and back as text."""

from jaxphoto.io.colmap.model import recognises
from jaxphoto.io.colmap.model_reader import read_colmap_model
from jaxphoto.io.colmap.model_writer import check_model_target, write_colmap_model

__all__ = ["check_model_target", "read_colmap_model", "recognises", "write_colmap_model"]
