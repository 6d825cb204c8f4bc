"""Orientation of images without approximate values: resection, relative orientation, intersection, whole blocks."""

from jaxphoto.initial.approximate import approximate
from jaxphoto.initial.averaging import average_rotation, best_triplet, intersect_directions
from jaxphoto.initial.intersection import intersect_points, intersect_with_covariance
from jaxphoto.initial.quaternion_resection import Resection, resect_by_quaternions
from jaxphoto.initial.relative import RelativeOrientation, relative_orientation, relative_orientations
from jaxphoto.initial.resection import resect

__all__ = [
    "RelativeOrientation",
    "Resection",
    "approximate",
    "average_rotation",
    "best_triplet",
    "intersect_directions",
    "intersect_points",
    "intersect_with_covariance",
    "relative_orientation",
    "relative_orientations",
    "resect",
    "resect_by_quaternions",
]
