"""Search for targets of surveyed points in photographs near their predicted image coordinates."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxphoto.extras.photos.features import read_grey
from jaxphoto.extras.photos.targets.on_ground import GroundTarget
from jaxphoto.procedures.control.targets import Candidates, Predicted, TargetSearch

# Standard deviation (px) due to blur, compression and shadows; added in quadrature to the standard deviation of the
# fit.
_MIN_SIGMA_PX = 0.1
_HALF = 0.5


def make_target_search(
    target: GroundTarget, paths: Mapping[str, Path], progress: Callable[[str], object] = lambda image: None
) -> TargetSearch:
    """Return the search function for `target`. `paths`: photograph by image name; other images are skipped."""

    def look(
        at: Predicted, radius: Float[np.ndarray, "n"], images: tuple[str, ...], ids: tuple[str, ...]
    ) -> Candidates:
        row: list[int] = []
        place: list[np.ndarray] = []
        fit: list[float] = []
        for image in np.unique(at.image).tolist():
            if images[image] not in paths:
                continue
            progress(images[image])
            picture = read_grey(paths[images[image]])
            for k in np.flatnonzero(at.image == image).tolist():
                across = at.px_per_m[k][:, :2]
                reach = radius[k] + target.reach_px(across)
                low = np.maximum(np.floor(at.column_row[k] - reach).astype(int), 0)
                high = np.minimum(np.ceil(at.column_row[k] + reach).astype(int), picture.shape[::-1])
                window = np.ascontiguousarray(picture[low[1] : high[1], low[0] : high[0]])
                if min(window.shape) < 2 * _HALF + 8:
                    continue
                targets = target.find(window, ids[at.point[k]], across)
                there = targets.column_row + low + _HALF
                near = np.linalg.norm(there - at.column_row[k], axis=1) < radius[k]
                row += [k] * int(near.sum())
                place += list(there[near])
                fit += np.sqrt(np.mean(targets.sigma_px[near] ** 2, axis=1)).tolist()
        sigma = np.hypot(np.array(fit, float), _MIN_SIGMA_PX)
        return Candidates(np.array(row, int), np.array(place, float).reshape(-1, 2), sigma, np.array(fit, float))

    return TargetSearch(look, target.named)
