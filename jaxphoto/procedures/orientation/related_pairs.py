"""The relative orientations of all pairs of images, and the matches that they bear out."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.errors import BlockError, GroupsError
from jaxphoto.initial.matches import PairMatches, connected_images
from jaxphoto.initial.relative import RelativeOrientation, relative_orientations

LENS_PX = 1.2
"""What an unknown lens does to a match, in pixels, while relative orientations are found."""
MOST = 8.0
"""Rays that miss their points by so many standard deviations, an unknown lens included, are gross errors."""
# Of the matches of a pair, those that must agree: where fewer do, they agree by chance.
_LEAST_PART = 0.25

Report = Callable[[str], object]


class Pair(NamedTuple):
    """Two images oriented to one another; the length of the base is open."""

    first: int
    second: int
    second_from_first: Float[np.ndarray, "3 3"]
    """Between the camera frames."""
    base: Float[np.ndarray, "3"]
    """Unit vector from the first to the second, in the first camera's frame."""
    n: int
    """Matches that agree."""
    angle: float
    """Median angle (rad) at which their rays meet."""

    def of(self, image: int) -> tuple[int, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
        """The other image, what takes `image`'s camera frame to the other's, and the direction to it in the former."""
        if image == self.first:
            return self.second, self.second_from_first, self.base
        return self.first, self.second_from_first.T, -self.second_from_first @ self.base


class Related(NamedTuple):
    """What the matches of all pairs came to."""

    pairs: tuple[Pair, ...]
    """Two entries for a pair with two orientations that fit equally well, as points of a flat scene leave them."""
    matches: tuple[PairMatches, ...]
    """Those that agree with the relative orientation of their pair."""
    refused: dict[tuple[int, int], str]
    """Pairs without a relative orientation, and why."""


def relate(
    names: Sequence[str],
    rays: Sequence[Float[np.ndarray, "_ 3"]],
    sigma_rad: float,
    matches: Sequence[PairMatches],
    least: int,
    report: Report = lambda text: None,
) -> Related:
    """The relative orientation of every pair in `matches` that has one.

    `rays` are unit vectors in the camera frames of the images `names`, by feature; `sigma_rad` is the standard
    deviation of a feature as a fraction of c. A pair needs `least` matches.
    """
    pairs: list[Pair] = []
    kept: list[PairMatches] = []
    refused: dict[tuple[int, int], str] = {}

    def orientations(match: PairMatches) -> list[RelativeOrientation] | str:
        one, other = match.features.T
        both = f"images {names[match.first]} and {names[match.second]}"
        return _orientations(rays[match.first][one], rays[match.second][other], sigma_rad, least, both)

    with ThreadPoolExecutor(os.cpu_count()) as workers:
        for k, (match, found) in enumerate(zip(matches, workers.map(orientations, matches), strict=True)):
            if k % 10 == 0:
                report(f"relative orientation of pair {k + 1} of {len(matches)}")
            if isinstance(found, str):
                refused[match.first, match.second] = found
                continue
            agrees = found[0].agrees
            kept.append(match._replace(features=match.features[agrees]))
            for r in found:
                n = int(r.agrees.sum())
                ends = (match.first, match.second)
                pairs.append(Pair(*ends, r.camera_2_from_camera_1, r.base, n, r.parallactic_angle))
    return Related(tuple(pairs), tuple(kept), refused)


def _orientations(rays_1, rays_2, sigma_rad: float, least: int, images: str) -> list[RelativeOrientation] | str:
    """The relative orientations that fit, best first; or why there is none."""
    n = len(rays_1)
    if n < least:
        return f"{images} have {n} matches, and {least} are needed"
    try:
        found = relative_orientations(rays_1, rays_2, sigma_rad, images=images)
    except BlockError as error:
        return str(error)
    agree = int(found[0].agrees.sum())
    if agree < max(least, _LEAST_PART * n):
        return f"only {agree} of the {n} matches of {images} agree with one relative orientation"
    return found


def check_connected(names: Sequence[str], related: Related) -> None:
    """Raise BlockError where no pair is left, and GroupsError where groups have none between them (all named)."""
    if not related.pairs:
        why = f" ({next(iter(related.refused.values()))})" if related.refused else ""
        raise BlockError(
            f"no two of the {len(names)} images can be oriented to one another{why}: take photographs that overlap by "
            "more than half, from different places"
        )
    joined = [PairMatches(pair.first, pair.second, np.zeros((pair.n, 2), int)) for pair in related.pairs]
    groups = [g for g in connected_images(len(names), joined) if len(g) > 1]
    if len(groups) > 1:
        by_name = [[names[i] for i in group] for group in groups]
        named = "; ".join(map(", ".join, by_name))
        raise GroupsError(
            f"the images are {len(groups)} groups that have too few points in common to be oriented to one another "
            f"({named}): orient each by itself, or add images that connect them",
            by_name,
        )
