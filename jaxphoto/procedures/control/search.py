"""Targets of surveyed points looked for where photographs should show them, and believed where their rays meet.

What looks into pictures gives candidates; those of a point in different photographs are of one target where their rays
meet at one place, near enough to where the point should be. A place that fewer photographs tell, or another place that
nearly as many tell, is not believed.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.orientation.block_intersection import intersect_points
from jaxphoto.orientation.rays import turn_to_object
from jaxphoto.procedures.control.intersected import misses, rays_of
from jaxphoto.procedures.control.marked import Marked
from jaxphoto.procedures.control.predicted import Predicted, predicted
from jaxphoto.procedures.control.surveyed import Marks

# Standard deviations within which a target is looked for, and pixels at least.
_WITHIN, _LEAST_PX = 3.5, 5.0
# Of a block that no control has placed yet, m in plan: what receivers without corrections have in common.
COMMON_M = 3.0
# Ties about a point whose height is that of the ground there.
_NEAR_TIES = 8
# By how many pixels a candidate may miss the place where the rays of its point meet.
_MISS_PX = 2.0
_LEAST_IMAGES, _LEAST_UNNAMED = 2, 3
# Of the photographs that show a target, how many show another place for that to be as good.
_ALIKE = 0.6
_PARALLEL = np.deg2rad(0.5)
_MOST_PAIRS = 2000


class Candidates(NamedTuple):
    """What might be a target, by row of what was predicted."""

    row: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    sigma_px: Float[np.ndarray, "n"]


class Looker(NamedTuple):
    """What finds targets in the pictures."""

    look: Callable[[Predicted, Float[np.ndarray, "n"], tuple[str, ...], tuple[str, ...]], Candidates]
    """Candidates within the radius (px) of each place; with the names of all images and points."""
    named: bool
    """Whether a target tells which point it is."""


class FoundTargets(NamedTuple):
    """Marks of targets that were found, and a sentence for every point that was looked for."""

    marks: Marks
    said: dict[str, str]
    """By the name of the point."""


def found_marks(
    adjusted: Adjustment,
    ids: tuple[str, ...],
    xyz: Float[np.ndarray, "points 3"],
    sigma: Float[np.ndarray, "points 3"],
    marks: Marked | None,
    looker: Looker,
    placed: bool,
) -> FoundTargets:
    """Targets of the points `ids` at `xyz` (m, +- `sigma`) in the images of `adjusted` that have no mark of them yet.

    `placed`: control has placed the block; else its plan is that of receivers, and heights are those of its own ground.
    """
    of_points = np.einsum("ni,ij->nij", sigma**2, np.eye(3))
    if not placed:
        xyz, scatter = _on_own_ground(adjusted, xyz)
        of_points = of_points + np.diag([COMMON_M**2, COMMON_M**2, scatter**2])
    at = predicted(adjusted, xyz, of_points)
    if marks is not None:
        there = set(zip(marks.image.tolist(), marks.point.tolist(), strict=True))
        at = at.take(
            np.array([key not in there for key in zip(at.image.tolist(), at.point.tolist(), strict=True)], bool)
        )
    spread = np.sqrt(np.linalg.eigvalsh(at.covariance)[:, 1]) if len(at.image) else np.zeros(0)
    radius = np.maximum(_WITHIN * spread, _LEAST_PX)
    seen = looker.look(at, radius, adjusted.block.images, ids)
    return _believed(adjusted, ids, xyz, of_points, at, seen, looker.named, radius)


def _on_own_ground(adjusted: Adjustment, xyz) -> tuple[Float[np.ndarray, "points 3"], float]:
    """`xyz` with heights shifted in common onto the ground that the block has there, and how far single ones are."""
    ties = np.asarray(adjusted.unknowns.points, float)
    above = []
    for point in xyz:
        near = np.argsort(np.linalg.norm(ties[:, :2] - point[:2], axis=1))[:_NEAR_TIES]
        above.append(point[2] - np.median(ties[near, 2]))
    shift = float(np.median(above))
    scatter = 1.4826 * float(np.median(np.abs(np.array(above) - shift)))
    return xyz - [0.0, 0.0, shift], max(scatter, 1.0)


def _believed(adjusted, ids, xyz, of_points, at: Predicted, seen: Candidates, named: bool, radius) -> FoundTargets:
    block, unknowns = adjusted.block, adjusted.unknowns
    image, point = at.image[seen.row], at.point[seen.row]
    sensors = [block.sensors[block.image_camera[i]] for i in image]
    xy = [s.mm_from_px(place[None])[0] for s, place in zip(sensors, seen.column_row, strict=True)]
    pixel = np.array([s.pixel_mm for s in sensors])
    rows = Marked(image, point, np.array(xy).reshape(-1, 2), seen.sigma_px * pixel)
    positions, matrices = (
        np.asarray(v, float) for v in (unknowns.exterior.position, unknowns.exterior.camera_from_object)
    )
    directions = turn_to_object(matrices, image, rays_of(block, unknowns, rows)) if len(image) else np.zeros((0, 3))
    c = np.array([float(unknowns.interior[block.image_camera[i]].c) for i in image])
    limit = _MISS_PX * pixel / np.maximum(c, 1e-300)
    kept: list[int] = []
    said: dict[str, str] = {}
    for p in np.unique(at.point).tolist():
        own, looked = np.flatnonzero(point == p), int((at.point == p).sum())
        chosen, why = _meeting(positions[image[own]], directions[own], image[own], limit[own], xyz[p], of_points[p])
        sure = named or radius[at.point == p].max() < 3 * _LEAST_PX
        least = _LEAST_IMAGES if sure else _LEAST_UNNAMED
        if not why and len(chosen) < least:
            why = f"it was seen in {len(chosen)}, and {least} are needed" if len(own) else "it was not seen"
        if why:
            said[ids[p]] = f"the target of {ids[p]} was looked for in {looked} photographs: {why}"
            continue
        kept += own[chosen].tolist()
        said[ids[p]] = f"the target of {ids[p]} was found in {len(chosen)} of {looked} photographs"
    marks = Marks(
        tuple(block.images[i] for i in image[kept]),
        tuple(ids[p] for p in point[kept]),
        seen.column_row[kept],
        seen.sigma_px[kept],
        tuple(f"found in {block.images[i]}" for i in image[kept]),
    )
    return FoundTargets(marks, said)


def _meeting(origins, directions, image, limit, near, of_point) -> tuple[np.ndarray, str]:
    """The candidates, one of an image, whose rays meet at one place near a point; or why there are none."""
    one, other = np.triu_indices(len(image), 1)
    apart = image[one] != image[other]
    one, other = one[apart], other[apart]
    if len(one) > _MOST_PAIRS:
        pick = np.linspace(0, len(one) - 1, _MOST_PAIRS).astype(int)
        one, other = one[pick], other[pick]
    none = np.zeros(0, int)
    if not len(one):
        return (np.arange(len(image)) if len(image) == 1 else none), ""
    ray = np.stack([one, other], axis=1).ravel()
    met, sure = intersect_points(
        origins[ray], directions[ray], np.arange(len(one)).repeat(2), len(one), min_angle=_PARALLEL
    )
    off = met - near
    # Two rays may be off by more than the survey: what they are good for is in the limit.
    room = np.linalg.norm(near - origins[one], axis=1) * limit[one] * 5
    distance = np.sqrt(np.einsum("ni,ij,nj->n", off, np.linalg.inv(of_point + 1e-12 * np.eye(3)), off))
    sure &= (distance < _WITHIN * 1.5) | (np.linalg.norm(off, axis=1) < room)
    if not sure.any():
        return none, "nothing that was seen lies where it should"
    inside = misses(met[sure], origins, directions) < limit
    images = np.unique(image)
    score = np.stack([(inside & (image == i)).any(axis=1) for i in images]).sum(axis=0)
    best = int(np.argmax(score - 1e-3 * misses(met[sure], origins, directions).min(axis=1)))
    chosen = inside[best]
    rival = (score == score[best]) | (score >= max(_LEAST_UNNAMED, _ALIKE * score[best]))
    rival &= ~(inside & chosen).any(axis=1)
    if rival.any():
        return none, f"two places or more look like it, one in {score[best]} photographs: mark it by hand"
    miss = misses(met[sure][best][None], origins, directions)[0]
    kept = [
        int(np.flatnonzero(chosen & (image == i))[np.argmin(miss[chosen & (image == i)])])
        for i in images
        if (chosen & (image == i)).any()
    ]
    return np.array(kept, int), ""
