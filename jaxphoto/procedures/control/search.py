"""Targets of surveyed points looked for where photographs should show them, and believed where their rays meet.

What looks into pictures gives candidates; those of a point in different photographs are of one target where their rays
meet at one place, near enough to where the point should be. Of places that about as many photographs tell the one
with the sharper edges is it, which targets are made to have; where that does not decide none is believed, nor what is
far less sharp than the targets of the other points, as a round stone is.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxphoto.adjustment import Adjustment
from jaxphoto.errors import counted
from jaxphoto.initial.intersection import intersect_points
from jaxphoto.initial.rays import turn_to_object
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
# By which factor the fits of a target are better than those of another place that looks like it; and by which one they
# may be worse than those of the other targets.
_SHARPER, _DULL = 1.5, 3.0
_MOST_PAIRS = 2000


class Candidates(NamedTuple):
    """What might be a target, by row of what was predicted."""

    row: Int[np.ndarray, "n"]
    column_row: Float[np.ndarray, "n 2"]
    sigma_px: Float[np.ndarray, "n"]
    fit_px: Float[np.ndarray, "n"]
    """Of the fit to its grey values alone: small where its edge is sharp and strong, as a target's is."""


class Looker(NamedTuple):
    """What finds targets in the pictures."""

    look: Callable[[Predicted, Float[np.ndarray, "n"], tuple[str, ...], tuple[str, ...]], Candidates]
    """Candidates within the radius (px) of each place; with the names of all images and points."""
    named: bool
    """Whether a target tells which point it is."""


class FoundTargets(NamedTuple):
    """Marks of targets that were found, and what became of every point that was looked for, by its name."""

    marks: Marks
    looked: dict[str, tuple[str, ...]]
    """In which photographs it was looked for."""
    why_not: dict[str, str]
    """Of those that were not found."""


def found_marks(
    adjusted: Adjustment,
    ids: tuple[str, ...],
    xyz: Float[np.ndarray, "points 3"],
    sigma: Float[np.ndarray, "points 3"],
    known: Collection[tuple[int, int]],
    looker: Looker,
    placed: bool,
) -> FoundTargets:
    """Targets of the points `ids` at `xyz` (m, +- `sigma`) in the images of `adjusted`, but for (image, point) `known`.

    `placed`: control has placed the block; else its plan is that of receivers, and heights are those of its own ground.
    """
    of_points = np.einsum("ni,ij->nij", sigma**2, np.eye(3))
    if not placed:
        xyz, scatter = _on_own_ground(adjusted, xyz)
        of_points = of_points + np.diag([COMMON_M**2, COMMON_M**2, scatter**2])
    at = predicted(adjusted, xyz, of_points)
    pairs = zip(at.image.tolist(), at.point.tolist(), strict=True)
    at = at.take(np.array([pair not in known for pair in pairs], bool))
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
    taken: dict[int, list[int]] = {}
    looked: dict[str, tuple[str, ...]] = {}
    why_not: dict[str, str] = {}
    for p in np.unique(at.point).tolist():
        own = np.flatnonzero(point == p)
        looked[ids[p]] = tuple(block.images[i] for i in at.image[at.point == p])
        near = xyz[p], of_points[p]
        chosen, why = _meeting(positions[image[own]], directions[own], image[own], limit[own], seen.fit_px[own], *near)
        sure = named or radius[at.point == p].max() < 3 * _LEAST_PX
        least = _LEAST_IMAGES if sure else _LEAST_UNNAMED
        if not why and len(chosen) < least:
            why = f"it was seen in {len(chosen)}, and {least} are needed" if len(own) else "it was not seen"
        if why:
            where = counted(len(looked[ids[p]]), "photograph")
            why_not[ids[p]] = f"the target of {ids[p]} was looked for in {where}: {why}"
            continue
        taken[p] = own[chosen].tolist()
    usual = _fit_of_others(taken, seen.fit_px)
    for p, rows_of in list(taken.items()):
        if not named and np.median(seen.fit_px[rows_of]) > _DULL * usual[p]:
            del taken[p]
            why_not[ids[p]] = (
                f"the target of {ids[p]} was looked for: what was seen in {len(rows_of)} photographs is far less sharp "
                "than the other targets; mark it by hand"
            )
    kept = [k for rows_of in taken.values() for k in rows_of]
    marks = Marks(
        tuple(block.images[i] for i in image[kept]),
        tuple(ids[p] for p in point[kept]),
        seen.column_row[kept],
        seen.sigma_px[kept],
        tuple(f"found in {block.images[i]}" for i in image[kept]),
    )
    return FoundTargets(marks, looked, why_not)


def _fit_of_others(taken: dict[int, list[int]], fit_px: Float[np.ndarray, "n"]) -> dict[int, float]:
    """For each point what fits of the other points' targets usually are; without bound where there are too few."""
    own = {p: float(np.median(fit_px[rows])) for p, rows in taken.items()}
    others = {p: [fit for q, fit in own.items() if q != p] for p in own}
    return {p: float(np.median(fits)) if len(fits) >= _LEAST_IMAGES else np.inf for p, fits in others.items()}


def _meeting(origins, directions, image, limit, fit, near, of_point) -> tuple[np.ndarray, str]:
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
    likely = np.flatnonzero(score >= min(score.max(), max(_LEAST_UNNAMED, _ALIKE * score.max())))
    sharp = np.array([np.median(fit[inside[k]]) for k in likely])
    # Of the places that are as sharp as the sharpest, which are often one, that which most photographs show.
    miss = misses(met[sure], origins, directions).min(axis=1)
    alike = likely[sharp <= _SHARPER * sharp.min()]
    best = int(alike[np.argmax(score[alike] - 1e-3 * miss[alike])])
    chosen = inside[best]
    if not (inside[alike] & chosen).any(axis=1).all():
        return none, f"two places or more look like it, one in {score[best]} photographs: mark it by hand"
    miss = misses(met[sure][best][None], origins, directions)[0]
    kept = [
        int(np.flatnonzero(chosen & (image == i))[np.argmin(miss[chosen & (image == i)])])
        for i in images
        if (chosen & (image == i)).any()
    ]
    return np.array(kept, int), ""
