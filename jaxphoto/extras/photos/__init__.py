"""Image measurement by OpenCV, COLMAP and least squares: board targets, features, matches."""

from jaxphoto.extras.photos.features import Features, SiftFeatures, interest_points, read_grey, sift_features
from jaxphoto.extras.photos.matching import MatchedPhotographs, TieFeatures, match_photographs, tie_features
from jaxphoto.extras.photos.photograph_pairs import photograph_pairs
from jaxphoto.extras.photos.targets import Targets, find_targets, read_board, rendered

__all__ = [
    "Features", "MatchedPhotographs", "SiftFeatures", "Targets", "TieFeatures", "find_targets", "interest_points",
    "match_photographs", "photograph_pairs", "read_board", "read_grey", "rendered", "sift_features", "tie_features",
]  # fmt: skip
