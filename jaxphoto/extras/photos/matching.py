"""Matching of photographs by descriptors and epipolar geometry.

COLMAP matches descriptors (mutual nearest neighbours with Lowe's ratio test) and verifies pairs by the inliers of a
fundamental matrix or homography. Neither requires the principal distance. The EXIF value may be wrong by a third, so an
essential matrix would reject correct matches.
"""

import os
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.compiling.freed_memory import freed_memory_kept
from jaxphoto.errors import InputError
from jaxphoto.extras.photos.features import LONGEST_PX, SiftFeatures, sift_features
from jaxphoto.extras.photos.photograph_pairs import MostSimilar, largest_of, most_similar, usual_count
from jaxphoto.initial.matches import MatchedPart, PairMatches, connected_images
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.io.photographs import Photograph
from jaxphoto.procedures.orientation.colmap import MappedCamera, import_pycolmap, write_database

MIN_MATCHES = 15
"""Minimum number of verified matches of a pair; fewer may agree by chance."""
# Minimum ratio of inliers to matches of a pair.
_MIN_RATIO = 0.3
# Maximum distance from the epipolar line as a fraction of the image diagonal (4 of 1,300 px); allows for unknown
# distortion.
_OFF_LINE = 0.003
# Quantile that defines the scatter, and the same quantile in standard deviations of a normal distribution. The median
# ignores the long tails of the features; the sum of squares is sensitive to remaining false matches.
_QUANTILE, _QUANTILE_SIGMA = 0.9, 1.6449
_BLANK = "no features: blank or out of focus"
_ALONE = f"fewer than {MIN_MATCHES} points in common with each compared photograph"
# Number of pairs matched and stored in one batch.
_CHUNK = 200
Progress = Callable[[str, int, int], None]
"""Called with the step, the number of items done, and the total number."""


class MatchedPhotographs(NamedTuple):
    """Features of photographs and their matches."""

    xy_mm: list[Float[np.ndarray, "n 2"]]
    """Image coordinates by photograph, as in `SiftFeatures`."""
    sigma_mm: list[Float[np.ndarray, "n"]]
    """Standard deviations by photograph: `SiftFeatures` times `sigma_factor`."""
    sigma_factor: float
    """Ratio of the scatter about the epipolar lines to the standard deviations of `SiftFeatures`."""
    pairs: list[PairMatches]
    """Pairs with enough matches."""
    counts: Int[np.ndarray, "compared 4"]
    """Rows for all compared pairs: first, second, descriptor matches, verified matches (0 if too few)."""
    left_out: dict[str, str]
    """Reason by name of each photograph without matches."""

    @property
    def n_gross(self) -> int:
        """Total number of rejected matches."""
        return int((self.counts[:, 2] - self.counts[:, 3]).sum())

    def named(self, names: list[str]) -> MatchedPart:
        """Return the matches with these photograph names, as the input of `calibrate_flight`."""
        gross = np.column_stack([self.counts[:, :2], self.counts[:, 2] - self.counts[:, 3]])
        return MatchedPart(names, self.xy_mm, self.sigma_mm, self.pairs, gross, self.sigma_factor)


def match_photographs(
    photographs: Sequence[Photograph],
    sensor: Sensor,
    interior: InteriorOrientation,
    pairs: Iterable[tuple[int, int]] | MostSimilar,
    *,
    count: int | None = None,
    longest_px: int = LONGEST_PX,
    in_parts: bool = False,
    progress: Progress = lambda step, done, of: None,
) -> MatchedPhotographs:
    """Match SIFT features between photographs of one camera; `pairs` contains index pairs.

    `count` limits the features per photograph: default 5,000, or 10,000 for up to 40 photographs. Photographs are
    reduced to `longest_px`. `interior` is the known camera; only its distortion and principal point are used.
    Photographs without features or matches are in `left_out`.

    Raises InputError as `sift_features`, if no two photographs match, and, unless `in_parts`, for unconnected groups;
    BlockError if pycolmap is not installed.
    """
    if len(photographs) < 2:
        raise InputError("an orientation needs at least two overlapping photographs; give them all")
    pycolmap, paths, most = import_pycolmap(), [p.path for p in photographs], count or usual_count(len(photographs))
    features: list[SiftFeatures] = []
    with freed_memory_kept(), ThreadPoolExecutor(os.cpu_count()) as workers:
        for found in workers.map(lambda path: sift_features(path, sensor, most, longest_px), paths):
            features.append(found)
            progress("features", len(features), len(paths))
    if isinstance(pairs, MostSimilar):
        largest = [largest_of(of_photograph) for of_photograph in features]
        pairs = most_similar(
            largest, pairs.number, lambda done, of: progress("comparing the largest features", done, of)
        )
    compared = sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})
    ideal_px = [sensor.px_from_mm(ideal_coordinates(interior, f.xy_mm)) for f in features]
    off_line_px = _OFF_LINE * float(np.hypot(sensor.width_px, sensor.height_px))
    counts, matched, off_line = [np.zeros((0, 2), int)], list[np.ndarray](), [np.zeros(0)]
    with tempfile.TemporaryDirectory() as folder:
        database = _database(pycolmap, Path(folder), sensor, features, ideal_px)
        for begin in range(0, len(compared), _CHUNK):
            chunk = compared[begin : begin + _CHUNK]
            of_chunk = _match_pairs(pycolmap, database, chunk, features, ideal_px, sensor, off_line_px)
            counts.append(of_chunk[0])
            matched += of_chunk[1]
            off_line += of_chunk[2]
            progress("matches", begin + len(chunk), len(compared))
    scatter = np.abs(np.concatenate(off_line))
    factor = float(np.quantile(scatter, _QUANTILE)) / _QUANTILE_SIGMA if len(scatter) else 1.0
    result = MatchedPhotographs(
        [f.xy_mm for f in features],
        [factor * f.sigma_mm for f in features],
        factor,
        [PairMatches(*pair, matches) for pair, matches in zip(compared, matched, strict=True) if len(matches)],
        np.column_stack([np.array(compared, int).reshape(-1, 2), np.concatenate(counts)]),
        {},
    )
    blank = [len(xy) == 0 for xy in result.xy_mm]
    alone = _alone([path.name for path in paths], blank, result.pairs, in_parts)
    return result._replace(left_out={photographs[k].name: _BLANK if blank[k] else _ALONE for k in alone})


def _database(pycolmap: Any, folder: Path, sensor: Sensor, features: list[SiftFeatures], ideal_px: list) -> Path:
    """Write a COLMAP database of descriptors; a feature with several descriptors becomes several keypoints."""
    camera = MappedCamera(sensor.width_px, sensor.height_px, float(sensor.width_px), False)
    keypoints = [xy[f.feature] for xy, f in zip(ideal_px, features, strict=True)]
    write_database(folder / "photographs.db", [camera], [0] * len(features), keypoints, (), prior_c=False)
    with pycolmap.Database.open(folder / "photographs.db") as stored:
        for k, f in enumerate(features):
            kind = pycolmap.FeatureExtractorType.SIFT
            stored.write_descriptors(k + 1, pycolmap.FeatureDescriptors(kind, f.descriptors))
    return folder / "photographs.db"


def _match_pairs(
    pycolmap: Any, database: Path, pairs: list[tuple[int, int]], features, ideal_px, sensor: Sensor, off_line_px: float
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Match pairs; return counts of descriptor and verified matches, verified matches, and `_over_sigma` of these."""
    (database.parent / "pairs.txt").write_text("".join(f"{a} {b}\n" for a, b in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(database.parent / "pairs.txt")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.min_num_inliers, verification.min_inlier_ratio = MIN_MATCHES, _MIN_RATIO
    verification.ransac.max_error, verification.ransac.random_seed = off_line_px, 0
    verification.detect_watermark = False
    pycolmap.match_image_pairs(
        database, pairing_options=pairing, verification_options=verification, device=pycolmap.Device.cpu
    )
    counts, verified, off_line = [], [], []
    with pycolmap.Database.open(database) as stored:
        for a, b in pairs:
            geometry = stored.read_two_view_geometry(a + 1, b + 1).inlier_matches
            inliers = np.asarray(geometry, int).reshape(-1, 2)
            rows = _places(inliers, features[a].feature, features[b].feature)
            if len(rows) < MIN_MATCHES:
                rows = rows[:0]
            matched = np.asarray(stored.read_matches(a + 1, b + 1), int).reshape(-1, 2)
            counts.append((len(_places(matched, features[a].feature, features[b].feature)), len(rows)))
            verified.append(rows)
            if len(rows):
                one, other = ideal_px[a][rows[:, 0]], ideal_px[b][rows[:, 1]]
                sigmas = (features[k].sigma_mm[r] / sensor.pixel_mm for k, r in zip((a, b), rows.T, strict=True))
                off_line.append(_over_sigma(off_line_px, one, other, *sigmas))
    return np.array(counts, int).reshape(-1, 2), verified, off_line


def _places(matches: Int[np.ndarray, "n 2"], one: np.ndarray, other: np.ndarray) -> Int[np.ndarray, "places 2"]:
    """Convert descriptor matches to one-to-one feature matches."""
    pairs = np.unique(np.column_stack([one[matches[:, 0]], other[matches[:, 1]]]), axis=0)
    once = np.ones(len(pairs), bool)
    for side in pairs.T:
        _, inverse, times = np.unique(side, return_inverse=True, return_counts=True)
        once &= times[inverse] == 1
    return pairs[once]


def _over_sigma(off_line_px: float, one: np.ndarray, other: np.ndarray, *sigmas: np.ndarray) -> np.ndarray:
    """Return the misclosures other' F one of verified matches, divided by their standard deviations; same unit in
    `sigmas`.
    """
    # Sample with the weights of MAGSAC++ (Barath and others, 2020) from OpenCV's fixed seed.
    matrix, _ = cv2.findFundamentalMat(one, other, cv2.USAC_MAGSAC, off_line_px, 0.9999, 10_000)
    if matrix is None:
        return np.zeros(0)
    one, other = (np.column_stack([xy, np.ones(len(xy))]) for xy in (one, other))
    in_other, in_one = one @ matrix.T, other @ matrix
    slopes = (np.square(line[:, :2]).sum(axis=1) for line in (in_one, in_other))
    variance = sum(slope * sigma**2 for slope, sigma in zip(slopes, sigmas, strict=True))
    return (in_other * other).sum(axis=1) / np.sqrt(variance)


def _alone(names: list[str], blank: list[bool], pairs: list[PairMatches], in_parts: bool) -> list[int]:
    """Return the photographs without matches. Raise InputError for unconnected groups, unless `in_parts`."""
    groups = connected_images(len(names), pairs)
    joined = [group for group in groups if len(group) > 1]
    if not joined:
        empty = [name for name, nothing in zip(names, blank, strict=True) if nothing]
        beside = f"; {_listed(empty)} have no features: blank or out of focus" if empty else ""
        raise InputError(
            f"no two of the {len(names)} photographs ({_listed(names)}) have {MIN_MATCHES} points in "
            f"common{beside}; give sharp photographs that overlap by at least half, or compare more pairs"
        )
    if len(joined) > 1 and not in_parts:
        each = "; ".join(_listed([names[k] for k in group]) for group in joined)
        raise InputError(
            f"{len(joined)} groups of photographs without matches between them ({each}); add photographs "
            "that overlap both, compare more pairs, or orient each group separately"
        )
    return [int(group[0]) for group in groups if len(group) == 1]


def _listed(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 12 else f"{', '.join(names[:10])} and {len(names) - 10} more"
