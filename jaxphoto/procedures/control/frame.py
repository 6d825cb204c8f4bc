"""The similarity that brings a block onto control points: of those that agree with one another.

Every three points (or 300 samples of three) give a similarity; that counts which most others fit, then least squares of
these. How well points have to fit leaves room for what an adjustment will take out: a block that is bent by a lens or
stands on weak positions misses by a part of its size. What does not fit is not judged here: it is left out of the first
adjustment, which judges it.

Where no file says how well points were surveyed and most do not fit, they may be worse than is usual: a hand-held
receiver is off by metres. The similarity of the least median difference tells by how much (P. J. Rousseeuw, Least
median of squares regression, JASA 79, 1984), as long as more than half of the points are not gross errors.

A block and control in one frame: the block in that of the control, or the control in that of the block.
"""

import dataclasses
from collections.abc import Callable, Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxphoto.block import Block, Frame
from jaxphoto.errors import InputError, counted
from jaxphoto.georeferencing.map_frame import MapFrame, check_heights
from jaxphoto.procedures.control.surveyed import (
    ControlSystem,
    SurveyedPoints,
    check_near,
    filled,
    fitting,
    places,
    system_of,
)
from jaxphoto.procedures.georeference_photographs import utm_of
from jaxphoto.procedures.orientation.known_frame import Similarity, similarity_between

_SAMPLES = 300
# Standard deviations, and part of the size of the control, within which a point fits.
_BEYOND, _BENT = 5.0, 0.01
MIN_POINTS = 3
# Fewer than this part of the points that fit, of so many at least, may be poor ones.
_MOST, _ENOUGH = 2 / 3, 6
# Of a median of lengths of normal errors in space to one coordinate, and what a similarity takes up.
_MEDIAN, _PARAMETERS = 1.54, 7
# Standard deviations beyond which a difference does not count for those of the others; part of the size of the control
# that standard deviations are at most: beyond, coordinates are of other points, or of another order.
_WITHIN, _POOREST = 3.5, 0.05


class OntoControl(NamedTuple):
    """A similarity and which points made it."""

    similarity: Similarity
    agree: Bool[np.ndarray, "points"]
    scatter_m: float | None = None
    """Standard deviation of a coordinate of the points that no file says one of, where they are worse than usual."""


def onto_control(
    there: Float[np.ndarray, "points 3"],
    here: Float[np.ndarray, "points 3"],
    sigma_m: Float[np.ndarray, "points"],
    file: str,
    assumed: Bool[np.ndarray, "points"],
) -> OntoControl:
    """From places `there` in a frame of a block to the same as surveyed, `here`; `sigma_m` of the differences.

    Those of the `assumed` are a guess, which most of the points may correct.

    Raises InputError for fewer than three, for such as lie on a line, and where no three and a fourth agree; it says
    where exchanged coordinates would.
    """
    if len(here) < MIN_POINTS:
        raise InputError(
            f"{file}: {counted(len(here), 'control point')} in two photographs or more, where three tell place, scale "
            "and attitude of a block; mark more"
        )
    best = _best(there, here, sigma_m)
    if best is None:
        raise InputError(
            f"{file}: the control points lie on a line, which leaves a turn about it open; mark one beside it, or "
            "orient photographs that have positions"
        )
    if best.agree.mean() < _MOST and assumed.any() and (poor := _poor(there, here, sigma_m, assumed)) is not None:
        return poor
    if len(here) > MIN_POINTS and best.agree.sum() > MIN_POINTS:
        return best
    if best.agree.all() and len(here) == MIN_POINTS:
        return best
    exchanged = _best(there, here[:, [1, 0, 2]], sigma_m)
    if exchanged is not None and exchanged.agree.sum() > max(MIN_POINTS, best.agree.sum()):
        raise InputError(
            f"{file}: the control points fit the photographs with X and Y exchanged; exchange the two columns"
        )
    off = _off(best.similarity, there, here)
    raise InputError(
        f"{file}: the marks of the control points do not fit their coordinates ({np.median(off):.3g} m off in the "
        "median); look at names, system and order of coordinates"
    )


def on_a_line(there: Float[np.ndarray, "points 3"], here: Float[np.ndarray, "points 3"]) -> bool:
    """Whether no three of the points lie beside one another, so that they leave a turn about their line open."""
    return next(_of_threes(there, here), None) is None


def _poor(there, here, sigma_m, assumed) -> OntoControl | None:
    """Where most points agree if those `assumed` were surveyed poorly; None where they do not then either."""
    n = len(here)
    if n < _ENOUGH:
        return None
    similarity = min(_of_threes(there, here), key=lambda s: np.median(_off(s, there, here)))
    # Rousseeuw's factor for few points.
    scatter = (1 + 5 / (n - MIN_POINTS)) * float(np.median(_off(similarity, there, here))) / _MEDIAN
    for _ in range(5):
        near = _off(similarity, there, here) < _WITHIN * scatter
        found = similarity_between(there[near], here[near])
        if found is None or near.sum() <= MIN_POINTS:
            return None
        similarity = found
        squares = np.sum(_off(similarity, there, here)[near] ** 2)
        scatter = float(np.sqrt(squares / (3 * near.sum() - _PARAMETERS)))
    agree = _off(similarity, there, here) < np.where(assumed, _BEYOND * scatter, _tolerance(here, sigma_m))
    is_poor = agree.mean() >= _MOST and scatter < _POOREST * _size(here)
    return OntoControl(similarity, agree, scatter) if is_poor else None


def _off(similarity: Similarity, there, here) -> Float[np.ndarray, "points"]:
    return np.linalg.norm(here - similarity.of(there), axis=1)


def _size(here) -> float:
    return float(np.linalg.norm(np.ptp(here, axis=0)))


def _tolerance(here, sigma_m) -> Float[np.ndarray, "points"]:
    return _BEYOND * sigma_m + _BENT * _size(here)


def _of_threes(there, here) -> Iterator[Similarity]:
    samples = list(combinations(range(len(here)), MIN_POINTS))
    if len(samples) > _SAMPLES:
        rng = np.random.default_rng(0)
        samples = [tuple(rng.choice(len(here), MIN_POINTS, replace=False)) for _ in range(_SAMPLES)]
    for pick in samples:
        similarity = similarity_between(there[list(pick)], here[list(pick)], 0.02)
        if similarity is not None:
            yield similarity


def _best(there, here, sigma_m) -> OntoControl | None:
    tolerance = _tolerance(here, sigma_m)
    best: tuple[float, Similarity] | None = None
    for similarity in _of_threes(there, here):
        off = _off(similarity, there, here) / tolerance
        score = float(np.sum(off < 1) - np.minimum(off, 1).mean())
        if best is None or score > best[0]:
            best = score, similarity
    if best is None:
        return None
    similarity = best[1]
    for _ in range(5):
        agree = _off(similarity, there, here) < tolerance
        found = similarity_between(there[agree], here[agree])
        if found is None:
            break
        similarity = found
    return OntoControl(similarity, _off(similarity, there, here) < tolerance)


class InFrame(NamedTuple):
    """Surveyed points in a Cartesian frame."""

    frame: Frame
    xyz: Float[np.ndarray, "points 3"]
    """m; heights that are not known are those of the others."""
    at_place: bool
    """Whether the block was there before, so that it tells where the points should be."""


def in_frame(
    block: Block, points: SurveyedPoints, words: str | None, code: int | None, vertical: int | None = None
) -> InFrame:
    """The points in the frame of `block`, or where it has none in one of theirs.

    `words` name their system where the file does not. `code` is the EPSG code that a new frame has; without one it is
    that of the points, or UTM. `vertical` is that of its heights; without one it is theirs. Raises InputError for a
    system that is not told, told twice, or cannot be, and for points that lie far from the block, with what would fit.
    """
    at = block.frame.origin
    system = told_system(points, words, lambda: fitting(points, None, *at[:2]) if at is not None else "")
    if block.frame.kind == "epsg":
        assert block.frame.code is not None and block.frame.origin is not None
        if code is not None and code != block.frame.code:
            raise InputError(f"the block is in EPSG:{block.frame.code} already, and EPSG:{code} is given; leave it out")
        if system.crs is None:
            raise InputError(
                f"{points.file} is in a local system and the block in EPSG:{block.frame.code}: give the control there, "
                "or orient the photographs without their positions"
            )
        check_near(points, system, *block.frame.origin[:2])
        there = places(points, system, block.frame.code)
        heights = block.frame.vertical if vertical is None else vertical
        if heights is None and block.frame.code == system.code:
            # Brought onto the points, the block has heights of theirs.
            heights = system.vertical
        return InFrame(
            dataclasses.replace(block.frame, vertical=heights), block.frame.map.local_from_place(there), True
        )
    if system.crs is None:
        return InFrame(dataclasses.replace(block.frame, kind="local"), filled(points), False)
    code = new_code(points, system) if code is None else code
    there = places(points, system, code)
    middle = np.median(there, axis=0)
    origin = (round(float(middle[0]), 4), round(float(middle[1]), 4), 0.0)
    if vertical is None and code == system.code:
        vertical = system.vertical
    if vertical is not None:
        check_heights(code, vertical)
    return InFrame(
        Frame("epsg", code, vertical, origin=origin), MapFrame(code, vertical, origin).local_from_place(there), False
    )


def told_system(points: SurveyedPoints, words: str | None, guess: Callable[[], str]) -> ControlSystem:
    """The system that the file of `points` says, or `words`. Raises InputError for none, with a `guess`, or two."""
    own = system_of(points.system, points.file) if points.system else None
    given = system_of(words, "the EPSG code of the control") if words else None
    if own and given and own.crs != given.crs:
        raise InputError(f"{points.file} says {own.name}, but {given.name} is given; leave out the one that is wrong")
    found = own or given
    if found is None:
        would = guess()
        raise InputError(
            f"{points.file} does not say the coordinate system of its points; give its EPSG code (or local, for "
            "Cartesian metres of no map)" + (f": they would fit {would}" if would else "")
        )
    return found


def new_code(points: SurveyedPoints, system: ControlSystem) -> int:
    """The EPSG code for a block that has none: that of a map in which the points are, or the zone of UTM."""
    if system.code is not None and system.crs is not None and system.crs.is_projected:
        return system.code
    longitude, latitude, _ = np.median(places(points, system, 4326), axis=0)
    return utm_of(longitude, latitude)
