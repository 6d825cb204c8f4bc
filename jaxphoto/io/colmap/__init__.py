"""Models of COLMAP: cameras, images and points, as text or binary -> the tables of a block folder; and written."""

from jaxphoto.io.colmap.model import recognises
from jaxphoto.io.colmap.model_reader import read_colmap_model

__all__ = ["read_colmap_model", "recognises"]
