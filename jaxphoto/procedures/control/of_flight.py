"""Control of a flight: looked at before hours of matching, then tried on every part; a part can do without it."""

from collections.abc import Callable, Collection, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.errors import InputError, JaxphotoError, few
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.procedures.control.control_block import ControlledBlock, control_block
from jaxphoto.procedures.control.frame import new_code, told_system
from jaxphoto.procedures.control.marks import images_of
from jaxphoto.procedures.control.surveyed import GivenControl, check_near, fitting
from jaxphoto.procedures.control.targets import Looker, control_block_with_targets
from jaxphoto.procedures.orientation.orient_photographs import Report
from jaxphoto.statistics import Selection


class FlightControl(NamedTuple):
    """Control as files have it, and the system of its points where they do not say it."""

    control: GivenControl
    system: str | None
    images: tuple[str, ...]
    """All photographs of the flight that can be read."""
    looker: Looker | None
    """What finds targets in them."""
    local: bool
    """Whether the points are in Cartesian metres of no map, where positions of photographs tell nothing."""


def flight_control(
    control: GivenControl,
    system: str | None,
    images: Iterable[str],
    positions: Iterable[Gps | None],
    looker: Looker | None = None,
    code: int | None = None,
) -> tuple[FlightControl, int | None]:
    """Control that may fit photographs, and the EPSG code of the flight: `code`, else that of the points' map system.

    Raises InputError where no mark names one of the `images`, where the system is not told or cannot be, where it is a
    local one though a `code` is given, and where the points lie far from the `positions`, with what would fit.
    """
    known = [gps for gps in positions if gps is not None]
    place = np.median([(g.longitude_deg, g.latitude_deg) for g in known], axis=0) if known else None
    guess = (lambda: fitting(control.points, None, *place)) if place is not None else (lambda: "")
    told = told_system(control.points, system, guess)
    if place is not None and told.crs is not None:
        check_near(control.points, told, *place)
    names = tuple(images)
    if len(control.marks.image) and (images_of(control.marks.image, names) < 0).all():
        raise InputError(
            f"{control.marks.places[0]}: no mark is in one of the {len(names)} photographs ({few(names)}), but in "
            f"{few(list(dict.fromkeys(control.marks.image)))}; use the names of their files"
        )
    if told.crs is None:
        if code is not None:
            raise InputError(
                f"{control.points.file} is in a local system, and EPSG:{code} is given for the block; leave out the "
                "code, or give the control in a map system"
            )
        return FlightControl(control, system, names, looker, local=True), None
    own = new_code(control.points, told) if code is None else code
    return FlightControl(control, system, names, looker, local=False), own


def controlled_or_why(
    block: Block, given: FlightControl, code: int | None, vertical: int | None, report: Report
) -> tuple[ControlledBlock | None, str]:
    """`block` with the control of the flight, or why it has to do without."""
    of: Callable[..., ControlledBlock] = control_block
    if given.looker is not None:
        of = partial(control_block_with_targets, looker=given.looker)
    try:
        how: dict[str, Any] = {"system": given.system, "code": code, "vertical": vertical, "elsewhere": given.images}
        found = of(block, given.control, **how, report=report)
    except JaxphotoError as error:
        return None, str(error)
    return found, ""


def parts_with_marks(adjusted: Adjustment, marked: Collection[str]) -> dict[str, Selection]:
    """What has a variance component of its own: features, marks set by hand or found, stations in plan and height."""
    own = set(marked)
    parts = {"image points": Selection("image_points")}
    if own:
        ties = [name for name in adjusted.block.points if name not in own]
        parts = {"image points": Selection("image_points", points=ties), "marks": Selection("image_points", points=own)}
    if len(adjusted.block.stations):
        parts |= {"stations X-Y": Selection("stations", axes=("X", "Y")), "stations Z": Selection("stations", axes="Z")}
    return parts
