"""Approximate values for an adjustment: resection of images, intersection of points, and both in turn."""

from jaxphoto.orientation.approximate import approximate
from jaxphoto.orientation.intersection import intersect_points
from jaxphoto.orientation.resection import resect

__all__ = ["approximate", "intersect_points", "resect"]
