"""Control of a flight: checked before matching, then used for every part; a part can be adjusted without it."""

from collections.abc import Callable, Collection, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import Block
from jaxphoto.errors import InputError, JaxphotoError, few
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.procedures.control.control_block import ControlledBlock, control_block
from jaxphoto.procedures.control.frame import new_code, stated_system
from jaxphoto.procedures.control.marks import images_of
from jaxphoto.procedures.control.surveyed import GivenControl, check_near, fitting
from jaxphoto.procedures.control.targets import TargetSearch, control_block_with_targets
from jaxphoto.procedures.orientation.orient_photographs import Report
from jaxphoto.statistics import Selection


class FlightControl(NamedTuple):
    """Control, and the coordinate system of its points if the file does not specify one."""

    control: GivenControl
    system: str | None
    images: tuple[str, ...]
    """All valid photographs of the flight."""
    target_search: TargetSearch | None
    """Search function for targets in the photographs."""
    local: bool
    """True for points in local Cartesian metres, which are unrelated to the positions of photographs."""


def flight_control(
    control: GivenControl,
    system: str | None,
    images: Iterable[str],
    positions: Iterable[Gps | None],
    target_search: TargetSearch | None = None,
    code: int | None = None,
) -> tuple[FlightControl, int | None]:
    """Check control against photographs, and return the EPSG code of the flight: `code`, or the code of the points.

    Raises InputError if no mark is in one of the `images`, for a missing or invalid system, for a local one together
    with `code`, and for points far from the `positions`, with a system that would fit.
    """
    recorded = [gps for gps in positions if gps is not None]
    place = np.median([(g.longitude_deg, g.latitude_deg) for g in recorded], axis=0) if recorded else None
    guess = (lambda: fitting(control.points, None, *place)) if place is not None else (lambda: "")
    stated = stated_system(control.points, system, guess)
    if place is not None and stated.crs is not None:
        check_near(control.points, stated, *place)
    names = tuple(images)
    if len(control.marks.image) and (images_of(control.marks.image, names) < 0).all():
        raise InputError(
            f"{control.marks.places[0]}: no mark is in one of the {len(names)} photographs ({few(names)}), but in "
            f"{few(list(dict.fromkeys(control.marks.image)))}; use the names of their files"
        )
    if stated.crs is None:
        if code is not None:
            raise InputError(
                f"{control.points.file} is in a local system, and EPSG:{code} is given for the block; omit the code, "
                "or give the control in a map system"
            )
        return FlightControl(control, system, names, target_search, local=True), None
    flight_code = new_code(control.points, stated) if code is None else code
    return FlightControl(control, system, names, target_search, local=False), flight_code


def adjust_with_control(
    block: Block, control: FlightControl, code: int | None, vertical: int | None, report: Report
) -> tuple[ControlledBlock | None, str]:
    """Adjust `block` with the control of the flight, or return the reason why that is impossible."""
    how: dict[str, Any] = {"system": control.system, "code": code, "vertical": vertical, "report": report}
    of: Callable[..., ControlledBlock] = control_block
    if control.target_search is not None:
        of = partial(control_block_with_targets, target_search=control.target_search)
    try:
        return of(block, control.control, elsewhere=control.images, **how), ""
    except JaxphotoError as error:
        return None, str(error)


def parts_with_marks(adjusted: Adjustment, marked: Collection[str]) -> dict[str, Selection]:
    """Return observation groups with a variance component each: features, marks, stations in plan and height."""
    parts = {"image points": Selection("image_points")}
    if marked:
        ties = [name for name in adjusted.block.points if name not in marked]
        parts["image points"] = Selection("image_points", points=ties)
        parts["marks"] = Selection("image_points", points=set(marked))
    if len(adjusted.block.stations):
        parts |= {"stations X-Y": Selection("stations", axes=("X", "Y")), "stations Z": Selection("stations", axes="Z")}
    return parts
