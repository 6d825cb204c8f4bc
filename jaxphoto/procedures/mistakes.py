"""Mistakes of a whole file that explain why most of it contradicts everything else: units, axes, signs.

The images say where control and stations should be that were left out. Where what was given is that in feet, or with X
and Y exchanged, no chance makes it so.
"""

from itertools import permutations

import numpy as np
from jaxtyping import Float

from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.errors import BlockError
from jaxphoto.initial import resect
from jaxphoto.initial.rays import ideal_coordinates
from jaxphoto.initial.resection import reprojection_errors
from jaxphoto.observations import AbstractCoordinates
from jaxphoto.procedures.snooping import Snooped, mostly_out

# What was given, over what it should be. The US survey foot differs from the international one by 2 ppm, which only
# few blocks would show.
_FACTORS = {
    1 / 0.3048: "in feet, not in metres",
    0.3048: "converted from feet, but were metres",
    1000.0: "in millimetres, not in metres",
    0.001: "in kilometres, not in metres",
    -1.0: "of the other sign",
}
_AXES = "XYZ"
# A mistake explains errors of which it leaves no more than this part, as a median: without the group, the others tell
# less well where it should be.
_LEFT = 0.1
# Image points that fit, times their standard deviations: distortion may be poorly known.
_FIT = 10.0


def coordinate_mistakes(snooped: Snooped, block: Block) -> dict[str, str]:
    """By group of coordinates of which most is left out, what they are instead, as far as it is one of the usual."""
    found = {}
    for name, counts in mostly_out(snooped, block).items():
        rows = block.named_observations[name]
        if isinstance(rows, AbstractCoordinates):
            said, seen = _said_and_seen(snooped, name, rows)
            if told := _exchanged(said, seen) or _scaled(said, seen, [_AXES.index(axis) for axis in counts]):
                found[name] = told
    return found


def is_mirrored(snooped: Snooped, block: Block, image: int) -> bool:
    """Whether an image of `block` that does not fit does so once it is turned over, seen from where the others are."""
    adjusted, p = snooped.adjusted, block.image_points
    place = dict(zip(adjusted.block.points, to_numpy(adjusted.unknowns.points), strict=True))
    own = np.flatnonzero((p.image == image) & np.isin(np.array(block.points, object)[p.point], list(place)))
    points = np.array([place[block.points[k]] for k in p.point[own]]).reshape(-1, 3)
    interior, xy = adjusted.unknowns.interior[block.image_camera[image]], to_numpy(p.xy)[own]
    mirrored = xy * [-1.0, 1.0]
    try:
        seen = resect(interior, mirrored, points, block.images[image])
    except BlockError:
        return False
    off = reprojection_errors(
        float(interior.c),
        ideal_coordinates(interior, mirrored),
        points,
        to_numpy(seen.position)[None],
        to_numpy(seen.camera_from_object)[None],
    )
    others = to_numpy(adjusted.unknowns.exterior.position).mean(axis=0)
    # Flat ground that is turned over is as well seen from beneath.
    if (others - points.mean(axis=0)) @ (to_numpy(seen.position) - points.mean(axis=0)) <= 0:
        return False
    return bool(np.median(off) < _FIT * np.median(to_numpy(p.sigma)[own]))


def _said_and_seen(
    snooped: Snooped, name: str, rows: AbstractCoordinates
) -> tuple[Float[np.ndarray, "who 3"], Float[np.ndarray, "who 3"]]:
    """What was given of each point or image, and where the others put it (m); no number where there is none."""
    said = np.full((int(rows.who.max()) + 1, 3), np.nan)
    said[rows.who, rows.axis] = to_numpy(rows.value)
    seen = said.copy()
    for s in snooped.left_out:
        if s.group == name:
            seen[rows.who[s.row], rows.axis[s.row]] -= s.error
    kept = np.isfinite(said).any(axis=1)
    return said[kept], seen[kept]


def _explains(given: np.ndarray, instead: np.ndarray, seen: np.ndarray) -> bool:
    """Whether what it is `instead` leaves next to nothing of what is off."""
    off = np.abs(given - seen)
    wrong = off > 0
    left = np.abs(instead - seen)[wrong]
    return bool(np.isfinite(left).any() and np.nanmedian(left) < _LEFT * np.nanmedian(off[wrong]))


def _exchanged(said: Float[np.ndarray, "who 3"], seen: Float[np.ndarray, "who 3"]) -> str:
    """Which axes stand in each other's place."""
    for order in permutations(range(3)):
        moved = [k for k in range(3) if order[k] != k]
        if moved and all(_explains(said[:, k], said[:, order[k]], seen[:, k]) for k in moved):
            return f"{' and '.join(_AXES[k] for k in moved)} are exchanged"
    return ""


def _scaled(said: Float[np.ndarray, "who 3"], seen: Float[np.ndarray, "who 3"], axes: list[int]) -> str:
    """Which axes are in other units."""
    told = []
    for factor, words in _FACTORS.items():
        if own := [k for k in axes if _explains(said[:, k], said[:, k] / factor, seen[:, k])]:
            told.append(f"{' and '.join(_AXES[k] for k in own)} {'is' if len(own) == 1 else 'are'} {words}")
    return ", ".join(told)
