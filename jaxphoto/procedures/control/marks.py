"""Marks of surveyed points in the images of a block: selection, intersection, and conversion to image points.

Every two rays of a point determine a position. The position with the most rays within the limit is refined by least
squares. A mark at the wrong target exceeds the limit by far. The limit allows for errors of an orientation before
adjustment.
"""

import dataclasses
import ntpath
import re
from collections.abc import Callable, Collection, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.arrays import as_jax_array
from jaxphoto.block import Block
from jaxphoto.block_parts import Datum, Start
from jaxphoto.camera import InteriorOrientation
from jaxphoto.errors import counted, few
from jaxphoto.georeferencing import FlightBias
from jaxphoto.initial.intersection import intersect_points, intersect_with_covariance
from jaxphoto.initial.rays import camera_rays, turn_to_object
from jaxphoto.observations import ControlCoordinates, ImagePoints
from jaxphoto.parameters import AbstractParameters
from jaxphoto.procedures.control.surveyed import MARK_SIGMA_PX, Marks, SurveyedPoints
from jaxphoto.unknowns import FIXED, FREE, Unknowns

_ENDING = re.compile(r"\.[A-Za-z]{2,4}$")


class Marked(NamedTuple):
    """Usable marks, sorted by point and image."""

    image: Int[np.ndarray, "rows"]
    """Index of the images of the block."""
    point: Int[np.ndarray, "rows"]
    """Index of the surveyed points."""
    xy_mm: Float[np.ndarray, "rows 2"]
    sigma_mm: Float[np.ndarray, "rows"]

    def take(self, chosen: np.ndarray) -> "Marked":
        """Select rows by mask or index."""
        return Marked(*(v[chosen] for v in self))


def marked(
    block: Block, points: SurveyedPoints, marks: Marks, elsewhere: Collection[str] = ()
) -> tuple[Marked, list[str]]:
    """Return the marks of `points` in the images of `block`, and messages about unusable marks.

    Images are matched by file name, ignoring folder, extension and case. Marks in `elsewhere`, images of other blocks,
    are ignored.
    """
    image = images_of(marks.image, block.images)
    other = images_of(marks.image, tuple(elsewhere)) >= 0
    place = {name: k for k, name in enumerate(points.ids)}
    point = np.array([place.get(name, -1) for name in marks.point], int)
    messages: list[str] = []
    _say(messages, marks, (image < 0) & ~other, marks.image, "of photographs that are not used")
    _say(messages, marks, (point < 0), marks.point, f"of points without coordinates in {points.file}")
    size = np.array([(s.width_px, s.height_px) for s in (block.sensors[c] for c in block.image_camera)], float)
    outside = ((marks.column_row < 0) | (marks.column_row > size[image])).any(axis=1) & (image >= 0) & (point >= 0)
    _say(messages, marks, outside, marks.image, "outside of the picture")
    kept = np.flatnonzero((image >= 0) & (point >= 0) & ~outside)
    kept = kept[np.lexsort((image[kept], point[kept]))]
    # The same photograph may have marks under two names.
    twice = np.r_[False, (np.diff(image[kept]) == 0) & (np.diff(point[kept]) == 0)] if len(kept) else np.zeros(0, bool)
    _say(messages, marks, np.isin(np.arange(len(image)), kept[twice]), marks.point, "listed twice for one photograph")
    kept = kept[~twice]
    sigma = np.where(np.isnan(marks.sigma_px), MARK_SIGMA_PX, marks.sigma_px)[kept]
    xy = np.zeros((len(kept), 2))
    pixel = np.zeros(len(kept))
    for k, row in enumerate(kept.tolist()):
        sensor = block.sensors[block.image_camera[image[row]]]
        xy[k], pixel[k] = sensor.mm_from_px(marks.column_row[row][None])[0], sensor.pixel_mm
    return Marked(image[kept], point[kept], xy, sigma * pixel), messages


def images_of(names: Sequence[str], images: Sequence[str]) -> Int[np.ndarray, "names"]:
    """Return the index of the image that each name refers to; -1 for none, or for more than one."""
    exact = {name: k for k, name in enumerate(images)}
    loose: dict[str, int] = {}
    for k, name in enumerate(images):
        loose[name.lower()] = k if name.lower() not in loose else -1
    indices = []
    for name in names:
        file = ntpath.basename(name)
        stem = _ENDING.sub("", file)
        hits = [exact[word] for word in (name, file, stem) if word in exact]
        indices.append(hits[0] if hits else loose.get(stem.lower(), loose.get(file.lower(), -1)))
    return np.array(indices, int)


def _say(messages: list[str], marks: Marks, wrong: np.ndarray, names: Sequence[str], what: str) -> None:
    """Append a message about the marks that are `wrong`, with the first of them."""
    which = np.flatnonzero(wrong)
    if len(which):
        listed = few(list(dict.fromkeys(names[int(k)] for k in which)))
        messages.append(f"rejected: {counted(len(which), 'mark')} {what}: {listed} ({marks.places[which[0]]})")


_BEYOND, _ROOM_PX = 4.0, 3.0
# Maximum number of ray pairs tested per point.
_PAIRS = 300
# Minimum angle (rad) between two rays.
_PARALLEL = np.deg2rad(0.5)


class Intersected(NamedTuple):
    """Intersections of the rays of marks, in the frame of the block."""

    points: Float[np.ndarray, "points 3"]
    """Positions; NaN for fewer than two rays."""
    covariance: Float[np.ndarray, "points 3 3"]
    good: Bool[np.ndarray, "rows"]
    """True for marks whose rays pass their point within the limit, and for single marks."""
    sentences: tuple[str, ...]


def rays_of(block: Block, unknowns: Unknowns, rows: Marked) -> Float[np.ndarray, "rows 3"]:
    """Return unit directions of the marks in the camera frames."""
    rays = np.zeros((len(rows.image), 3))
    camera = np.array(block.image_camera, object)[rows.image]
    for name in set(camera.tolist()):
        of_camera = camera == name
        rays[of_camera] = camera_rays(unknowns.interior[name], rows.xy_mm[of_camera])
    return rays


def intersected(block: Block, unknowns: Unknowns, rows: Marked, ids: tuple[str, ...]) -> Intersected:
    """Intersect the points of `rows` with the orientation `unknowns`; `ids` are their names."""
    n, good = len(ids), np.ones(len(rows.image), bool)
    positions = np.asarray(unknowns.exterior.position, float)
    matrices = np.asarray(unknowns.exterior.camera_from_object, float)
    rays = rays_of(block, unknowns, rows)
    directions, origins = turn_to_object(matrices, rows.image, rays), positions[rows.image]
    c = np.array([float(unknowns.interior[name].c) for name in block.image_camera])[rows.image]
    pixel = np.array([block.sensors[name].pixel_mm for name in block.image_camera])[rows.image]
    limit = np.hypot(_BEYOND * rows.sigma_mm, _ROOM_PX * pixel) / c
    messages: list[str] = []
    for p in np.unique(rows.point).tolist():
        of_point = np.flatnonzero(rows.point == p)
        if len(of_point) < 2:
            continue
        passing = _passing(origins[of_point], directions[of_point], limit[of_point])
        images = [block.images[i] for i in rows.image[of_point[~passing]]]
        if passing.sum() < 2:
            good[of_point] = False
            messages.append(f"the marks of {ids[p]} in {few(images)} contradict one another: all rejected")
        elif len(images):
            good[of_point[~passing]] = False
            messages.append(
                f"the mark of {ids[p]} in {few(images)} contradicts those in {passing.sum()} others: rejected"
            )
    used = np.flatnonzero(good)
    intersection = intersect_with_covariance(
        positions,
        matrices,
        rows.image[used],
        rays[used],
        rows.point[used],
        n,
        float(np.median((rows.sigma_mm / c)[used])) if len(used) else 1.0,
        _PARALLEL,
    )
    return Intersected(intersection.points, intersection.covariance, good, tuple(messages))


# Factors of the pixel coordinates of marks that are tried; minimum fraction of marks that agree with the right one, and
# maximum fraction that agree without it.
_FACTORS, _AGREE, _DISAGREE = np.geomspace(0.1, 10.0, 461), 0.9, 0.5


# Minimum number of marks, and minimum ratio of their misclosures with and without distortion, of undistorted pictures.
_UNDISTORTED_MARKS, _UNDISTORTED = 8, 3.0


TURNED: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "columns and rows are exchanged": lambda p, size: p[:, ::-1],
    "rows count from the bottom": lambda p, size: np.stack([p[:, 0], size[:, 1] - p[:, 1]], axis=1),
    "columns count from the right": lambda p, size: np.stack([size[:, 0] - p[:, 0], p[:, 1]], axis=1),
    "the pictures are turned by 180 degrees": lambda p, size: size - p,
    "the pictures are turned clockwise by 90 degrees": lambda p, size: np.stack(
        [p[:, 1], size[:, 1] - p[:, 0]], axis=1
    ),
    "the pictures are turned counter-clockwise by 90 degrees": lambda p, size: np.stack(
        [size[:, 0] - p[:, 1], p[:, 0]], axis=1
    ),
}
"""Conventions of columns and rows, with the conversion to those in the stored picture of a size (px)."""


def turned_marks(block: Block, unknowns: Unknowns, rows: Marked, good: Bool[np.ndarray, "rows"]) -> str | None:
    """Return the convention of columns and rows with which the marks agree, if most contradict one another.

    `good`: marks that agree as given.
    """
    contradicting = _Contradicting.of(block, unknowns, rows, good)
    if contradicting is None:
        return None
    agree = {words: contradicting.agreement(turned) for words, turned in TURNED.items()}
    best = max(agree, key=lambda words: agree[words])
    return best if agree[best] >= _AGREE else None


def factor_of_marks(block: Block, unknowns: Unknowns, rows: Marked, good: Bool[np.ndarray, "rows"]) -> float | None:
    """Return the factor of the pixel coordinates with which the marks agree, if most contradict one another.

    Marks of resized pictures need one factor, the ratio of the sizes. `good`: marks that agree as given.
    """
    contradicting = _Contradicting.of(block, unknowns, rows, good)
    if contradicting is None:
        return None

    def scaled(factor: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        return lambda column_row, size: factor * column_row

    def misclosure(factor: float) -> float:
        return _median_misclosure(block, unknowns, contradicting.converted(scaled(factor)))

    factor = float(min(_FACTORS, key=misclosure))
    step = _FACTORS[1] / _FACTORS[0]
    factor = float(min(np.geomspace(factor / step, factor * step, 41), key=misclosure))
    return factor if contradicting.agreement(scaled(factor)) >= _AGREE else None


def are_undistorted(block: Block, unknowns: Unknowns, rows: Marked) -> bool:
    """Return True if rays of the marks intersect far better without distortion, as in undistorted pictures."""
    rows = rows.take(np.bincount(rows.point)[rows.point] > 1)
    if len(rows.image) < _UNDISTORTED_MARKS:
        return False
    ideal = {name: InteriorOrientation(i.c, i.xp, i.yp) for name, i in unknowns.interior.items()}
    without = dataclasses.replace(unknowns, interior=ideal)
    return _UNDISTORTED * _median_misclosure(block, without, rows) < _median_misclosure(block, unknowns, rows)


def _median_misclosure(block: Block, unknowns: Unknowns, rows: Marked) -> float:
    """Return the median angle (rad) between rays of marks and the directions to their intersections."""
    origins = np.asarray(unknowns.exterior.position, float)[rows.image]
    matrices = np.asarray(unknowns.exterior.camera_from_object, float)
    directions = turn_to_object(matrices, rows.image, rays_of(block, unknowns, rows))
    places, _ = intersect_points(origins, directions, rows.point, int(rows.point.max()) + 1, min_angle=_PARALLEL)
    towards = places[rows.point] - origins
    across = np.linalg.norm(np.cross(directions, towards), axis=1) / np.linalg.norm(towards, axis=1)
    return float(np.nanmedian(across))


class _Contradicting(NamedTuple):
    """Marks of points in several images, most of which contradict one another."""

    block: Block
    unknowns: Unknowns
    rows: Marked
    size: Float[np.ndarray, "rows 2"]
    """Width and height of the pictures (px)."""
    pixel_mm: Float[np.ndarray, "rows 1"]

    @staticmethod
    def of(block: Block, unknowns: Unknowns, rows: Marked, good: Bool[np.ndarray, "rows"]) -> "_Contradicting | None":
        """Select the marks; None if half of them agree as given, or for fewer than four."""
        several = np.bincount(rows.point)[rows.point] > 1
        if several.sum() < 4 or good[several].mean() > _DISAGREE:
            return None
        rows = rows.take(several)
        sensors = [block.sensors[block.image_camera[k]] for k in rows.image]
        size = np.array([(s.width_px, s.height_px) for s in sensors], float)
        return _Contradicting(block, unknowns, rows, size, np.array([[s.pixel_mm] for s in sensors]))

    def converted(self, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Marked:
        """Return the marks with other columns and rows."""
        down = self.pixel_mm * (1, -1)
        column_row = self.rows.xy_mm / down + self.size / 2
        return self.rows._replace(xy_mm=(change(column_row, self.size) - self.size / 2) * down)

    def agreement(self, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> float:
        """Return the fraction of marks that agree with other columns and rows."""
        ids = tuple(map(str, range(int(self.rows.point.max()) + 1)))
        return float(intersected(self.block, self.unknowns, self.converted(change), ids).good.mean())


def _passing(origins, directions, limit) -> Bool[np.ndarray, "rays"]:
    """Mark the rays of one point that pass the position of most of them; all False if no two rays intersect."""
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
    """Return angles (rad) between rays and the directions to positions; infinite behind the camera."""
    towards = places[:, None] - origins
    along = np.sum(towards * directions, axis=2)
    across = np.linalg.norm(np.cross(directions[None], towards), axis=2)
    return np.where(along > 0, across / np.maximum(along, 1e-300), np.inf)


def into_block(
    block: Block,
    ids: tuple[str, ...],
    xyz: Float[np.ndarray, "points 3"],
    sigma: Float[np.ndarray, "points 3"],
    start: Float[np.ndarray, "points 3"],
    rows: Marked,
    control: Bool[np.ndarray, "points"],
    check: Bool[np.ndarray, "points"],
) -> Block:
    """Append the points `ids`, whose names are new, to `block`; `rows` are their marks.

    `xyz` (m, NaN if unknown) are observed with `sigma` for `control` points, and are check coordinates for `check`
    points, with a sigma of 0 if not stated. `start` contains initial values in the frame of the block.
    """
    n = len(block.points)
    new = ImagePoints(
        rows.image, rows.point + n, as_jax_array(rows.xy_mm), as_jax_array(np.repeat(rows.sigma_mm[:, None], 2, 1))
    )
    unknowns = block.start.unknowns
    unknowns = dataclasses.replace(unknowns, points=np.concatenate([np.asarray(unknowns.points, float), start]))
    known = np.concatenate([np.asarray(block.start.point_known), np.ones(len(ids), bool)])
    return dataclasses.replace(
        block,
        points=(*block.points, *ids),
        image_points=ImagePoints.joined(block.image_points, new),
        control=ControlCoordinates.joined(block.control, _coordinates(xyz, sigma, control, n)),
        check=ControlCoordinates.joined(block.check, _coordinates(xyz, sigma, check, n)),
        datum=Datum(),
        start=Start(unknowns, block.start.image_known, known),
    )


def _coordinates(xyz, sigma, chosen, first: int) -> ControlCoordinates:
    point, axis = np.nonzero(np.isfinite(xyz) & chosen[:, None])
    return ControlCoordinates(first + point, axis, as_jax_array(xyz[point, axis]), as_jax_array(sigma[point, axis]))


def without_names(block: Block, ids: tuple[str, ...]) -> Block:
    """Remove the names `ids` from the points of `block`.

    Surveyed points with these names are removed together with their image points; tie points are renamed.
    """
    surveyed = {int(p) for rows in (block.control, block.fixed, block.check) for p in np.asarray(rows.who)}
    taken = set(ids)
    replaced = np.array([name in taken and k in surveyed for k, name in enumerate(block.points)], bool)
    new = np.where(replaced, -1, np.cumsum(~replaced) - 1)
    kept = [name for name, out in zip(block.points, replaced, strict=True) if not out]
    names = set(kept) | taken
    for k, name in enumerate(kept):
        if name in taken:
            while (name := f"tie_{name}") in names:
                pass
            names.add(name)
            kept[k] = name
    renumbered = lambda rows: rows.renumbered(point=new)  # noqa: E731
    start = block.start
    unknowns = dataclasses.replace(start.unknowns, points=np.asarray(start.unknowns.points, float)[~replaced])
    changed = {
        name: renumbered(getattr(block, name))
        for name in ("image_points", "control", "fixed", "check", "surfaces", "distances")
    }
    return dataclasses.replace(
        block,
        points=tuple(kept),
        **changed,
        more=tuple(renumbered(m) if hasattr(m, "renumbered") else m for m in block.more),
        start=Start(unknowns, start.image_known, np.asarray(start.point_known)[~replaced]),
    )


def with_gnss_bias(block: Block) -> Block:
    """Add a common shift of the stations of `block`, determined by control: an offset of height reference or datum."""
    unknowns, zero = block.start.unknowns, np.zeros(3)
    # Parts of a flight without a shift are the reference of the others.
    if "flight_bias" in unknowns.more or (unknowns.strips and unknowns.strips.keys() >= set(block.image_strip)):
        return block
    bias: dict[str, AbstractParameters] = {"": FlightBias(zero, zero)}  # type: ignore[arg-type]
    freed: dict[str, AbstractParameters] = {"": FlightBias(FREE, FIXED)}  # type: ignore[arg-type]
    more, priors = unknowns.more | {"flight_bias": bias}, block.priors.more | {"flight_bias": freed}
    return dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=dataclasses.replace(unknowns, more=more)),
        priors=dataclasses.replace(block.priors, more=priors),
    )
