"""Coordinate systems of control, and the robust similarity that transforms a block to control points.

Every three points (or 300 samples of three) determine a similarity. The one with the most consistent points is refined
by least squares of these. The tolerance allows for deformations that the adjustment removes: distortion, or weakly
determined positions. The first adjustment, which tests all points, starts without inconsistent ones.
"""

import dataclasses
from collections.abc import Iterator
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
    places,
    system_of,
)
from jaxphoto.procedures.georeference_photographs import utm_of
from jaxphoto.procedures.orientation.blocks import Similarity, similarity_between

_SAMPLES = 300
# Tolerance of a point: number of standard deviations plus fraction of the extent of the control.
_BEYOND, _BENT = 5.0, 0.01
MIN_POINTS = 3


class OntoControl(NamedTuple):
    """Similarity, and the points that agree with it."""

    similarity: Similarity
    agree: Bool[np.ndarray, "points"]


def onto_control(
    there: Float[np.ndarray, "points 3"],
    here: Float[np.ndarray, "points 3"],
    sigma_m: Float[np.ndarray, "points"],
    file: str,
) -> OntoControl:
    """Estimate the similarity from `there`, in the frame of a block, to surveyed points `here`.

    `sigma_m`: standard deviations of the differences.

    Raises InputError for fewer than three points, for collinear points, and if no four points are consistent, with the
    cure if exchanging coordinates would help.
    """
    if len(here) < MIN_POINTS:
        raise InputError(
            f"{file}: {counted(len(here), 'control point')} in two photographs or more, but position, scale and "
            "attitude of a block need three; mark more"
        )
    best = _best(there, here, sigma_m)
    if best is None:
        raise InputError(
            f"{file}: the control points lie on a line, so the rotation about it is undetermined; mark one off the "
            "line, or orient photographs with positions"
        )
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
        "median); check names, system and order of coordinates, and give standard deviations of a less accurate survey"
    )


def on_a_line(there: Float[np.ndarray, "points 3"], here: Float[np.ndarray, "points 3"]) -> bool:
    """Return True if all points are collinear, which leaves the rotation about their line undetermined."""
    return next(_of_threes(there, here), None) is None


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
        refined = similarity_between(there[agree], here[agree])
        if refined is None:
            break
        similarity = refined
    return OntoControl(similarity, _off(similarity, there, here) < tolerance)


class InFrame(NamedTuple):
    """Surveyed points in a Cartesian frame."""

    frame: Frame
    xyz: Float[np.ndarray, "points 3"]
    """Coordinates in m; unknown heights are replaced by the median of the others."""
    at_place: bool
    """True if the block is already in this frame."""


def in_frame(
    block: Block, points: SurveyedPoints, words: str | None, code: int | None, vertical: int | None = None
) -> InFrame:
    """Transform the points to the frame of `block`, or to a new frame.

    `words` is the coordinate system if the file does not specify one. `code` is the EPSG code of a new frame, by
    default the system of the points or UTM; `vertical` is the EPSG code of its heights, by default as in the points.
    Raises InputError for a missing, contradictory or unusable system, and for points far from the block.
    """
    system = stated_system(points, words)
    if block.frame.kind == "epsg":
        assert block.frame.code is not None and block.frame.origin is not None
        if code is not None and code != block.frame.code:
            raise InputError(f"the block is in EPSG:{block.frame.code} already, and EPSG:{code} is given; omit it")
        if system.crs is None:
            raise InputError(
                f"{points.file} is in a local system and the block in EPSG:{block.frame.code}: give the control there, "
                "or orient the photographs without their positions"
            )
        check_near(points, system, *block.frame.origin[:2])
        there = places(points, system, block.frame.code)
        heights = block.frame.vertical if vertical is None else vertical
        if heights is None and block.frame.code == system.code:
            # The transformed block uses the vertical system of the points.
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


def stated_system(points: SurveyedPoints, words: str | None) -> ControlSystem:
    """Return the system in the file of `points`, else `words`. Raises InputError for none, and if they differ."""
    stated = system_of(points.system, points.file) if points.system else None
    given = system_of(words, "the EPSG code of the control") if words else None
    if stated and given and stated.crs != given.crs:
        raise InputError(f"{points.file} states {stated.name}, but {given.name} is given; omit the wrong one")
    system = stated or given
    if system is None:
        raise InputError(
            f"{points.file} does not state the coordinate system of its points; give its EPSG code (or local, for "
            "Cartesian metres without a map)"
        )
    return system


def new_code(points: SurveyedPoints, system: ControlSystem) -> int:
    """Return the EPSG code for a block without one: the map system of the points, or the UTM zone."""
    if system.code is not None and system.crs is not None and system.crs.is_projected:
        return system.code
    longitude, latitude, _ = np.median(places(points, system, 4326), axis=0)
    return utm_of(longitude, latitude)
