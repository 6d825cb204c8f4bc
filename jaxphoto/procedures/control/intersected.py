"""Surveyed points where the rays of their marks meet; a mark that contradicts the others of its point is found so.

Each two rays of a point give a place; that which most rays pass within the limit counts, then least squares of these.
A mark at the wrong target is off by far more than the limit, whose second part leaves room for an orientation that is
not adjusted yet.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.block import Block
from jaxphoto.errors import few
from jaxphoto.initial.intersection import intersect_points, intersect_with_covariance
from jaxphoto.initial.rays import camera_rays, turn_to_object
from jaxphoto.procedures.control.marked import Marked
from jaxphoto.unknowns import Unknowns

_BEYOND, _ROOM_PX = 4.0, 3.0
# Pairs of rays of one point: more marks tell no more.
_PAIRS = 300
# Rays within this angle (rad) of one another meet nowhere.
_PARALLEL = np.deg2rad(0.5)


class Intersected(NamedTuple):
    """Where rays of marks meet, in the frame of the block."""

    points: Float[np.ndarray, "points 3"]
    """NaN where fewer than two rays meet."""
    covariance: Float[np.ndarray, "points 3 3"]
    good: Bool[np.ndarray, "rows"]
    """Marks whose rays pass their point; marks that are alone are good, as far as anybody can tell."""
    sentences: tuple[str, ...]


def rays_of(block: Block, unknowns: Unknowns, rows: Marked) -> Float[np.ndarray, "rows 3"]:
    """Unit directions in the camera frames of the marks."""
    rays = np.zeros((len(rows.image), 3))
    camera = np.array(block.image_camera, object)[rows.image]
    for name in set(camera.tolist()):
        own = camera == name
        rays[own] = camera_rays(unknowns.interior[name], rows.xy_mm[own])
    return rays


def intersected(block: Block, unknowns: Unknowns, rows: Marked, ids: tuple[str, ...]) -> Intersected:
    """The points of `rows` by the orientation `unknowns`; `ids` name them."""
    n, good = len(ids), np.ones(len(rows.image), bool)
    positions = np.asarray(unknowns.exterior.position, float)
    matrices = np.asarray(unknowns.exterior.camera_from_object, float)
    rays = rays_of(block, unknowns, rows)
    directions, origins = turn_to_object(matrices, rows.image, rays), positions[rows.image]
    c = np.array([float(unknowns.interior[name].c) for name in block.image_camera])[rows.image]
    pixel = np.array([block.sensors[name].pixel_mm for name in block.image_camera])[rows.image]
    limit = np.hypot(_BEYOND * rows.sigma_mm, _ROOM_PX * pixel) / c
    said: list[str] = []
    for p in np.unique(rows.point).tolist():
        own = np.flatnonzero(rows.point == p)
        if len(own) < 2:
            continue
        passing = _passing(origins[own], directions[own], limit[own])
        images = [block.images[i] for i in rows.image[own[~passing]]]
        if passing.sum() < 2:
            good[own] = False
            said.append(f"the marks of {ids[p]} in {few(images)} contradict one another, and none is used")
        elif len(images):
            good[own[~passing]] = False
            said.append(f"the mark of {ids[p]} in {few(images)} contradicts those in {passing.sum()} others: left out")
    used = np.flatnonzero(good)
    found = intersect_with_covariance(
        positions,
        matrices,
        rows.image[used],
        rays[used],
        rows.point[used],
        n,
        float(np.median((rows.sigma_mm / c)[used])) if len(used) else 1.0,
        _PARALLEL,
    )
    return Intersected(found.points, found.covariance, good, tuple(said))


def _passing(origins, directions, limit) -> Bool[np.ndarray, "rays"]:
    """Which of the rays of one point pass the place that most of them pass; none where no two rays meet."""
    n = len(origins)
    pairs = list(combinations(range(n), 2))
    pairs = [pairs[k] for k in np.linspace(0, len(pairs) - 1, min(len(pairs), _PAIRS)).astype(int)]
    ray = np.array(pairs).ravel()
    number = np.arange(len(pairs)).repeat(2)
    met, determined = intersect_points(origins[ray], directions[ray], number, len(pairs), min_angle=_PARALLEL)
    if not determined.any():
        return np.ones(n, bool)
    off = misses(met[determined], origins, directions)
    inside = off < limit
    score = inside.sum(axis=1) - np.minimum(off / limit, 1.0).mean(axis=1)
    passing = inside[np.argmax(score)]
    place, sure = intersect_points(origins[passing], directions[passing], np.zeros(passing.sum(), int), 1)
    return misses(place, origins, directions)[0] < limit if sure[0] else passing


def misses(places, origins, directions) -> Float[np.ndarray, "places rays"]:
    """Angles (rad) by which rays miss places; infinite behind."""
    towards = places[:, None] - origins
    along = np.sum(towards * directions, axis=2)
    across = np.linalg.norm(np.cross(directions[None], towards), axis=2)
    return np.where(along > 0, across / np.maximum(along, 1e-300), np.inf)
