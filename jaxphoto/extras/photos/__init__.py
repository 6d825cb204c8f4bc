"""Image measurement by OpenCV, COLMAP and least squares: board targets, features, matches."""

from jaxphoto.extras.photos.features import SiftFeatures, read_grey, sift_features
from jaxphoto.extras.photos.matching import MatchedPhotographs, match_photographs, photograph_pairs
from jaxphoto.extras.photos.targets import Targets, find_targets, read_board, rendered

__all__ = [
    "MatchedPhotographs", "SiftFeatures", "Targets", "find_targets", "match_photographs", "photograph_pairs",
    "read_board", "read_grey", "rendered", "sift_features",
]  # fmt: skip
