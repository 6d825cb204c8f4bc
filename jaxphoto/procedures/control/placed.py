"""A block and control in one frame: the block in that of the control, or the control in that of the block."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Block, Frame
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.map_frame import MapFrame, check_heights
from jaxphoto.procedures.control.surveyed import SurveyedPoints
from jaxphoto.procedures.control.system import ControlSystem, check_near, filled, fitting, places, system_of
from jaxphoto.procedures.georeference_photographs import utm_of


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
