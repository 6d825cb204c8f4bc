"""Orientation of images without approximate values: resection, intersection, whole blocks."""

from jaxphoto.initial.approximate import approximate
from jaxphoto.initial.intersection import intersect_points, intersect_with_covariance
from jaxphoto.initial.quaternion_resection import Resection, resect_by_quaternions
from jaxphoto.initial.quaternions import average_rotation
from jaxphoto.initial.resection import resect

__all__ = [
    "Resection", "approximate", "average_rotation", "intersect_points", "intersect_with_covariance", "resect",
    "resect_by_quaternions",
]  # fmt: skip
