"""Orientation of images without approximate values: resection, relative orientation, intersection, whole blocks."""

from jaxphoto.orientation.approximate import approximate
from jaxphoto.orientation.averaging import average_rotation, best_triplet, intersect_directions
from jaxphoto.orientation.block_intersection import intersect_points, intersect_with_covariance
from jaxphoto.orientation.quaternion_resection import Resection, resect_by_quaternions
from jaxphoto.orientation.relative import RelativeOrientation, relative_orientation, relative_orientations
from jaxphoto.orientation.resection import resect

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
