"""From matched photographs of a flight to calibrations: each part that hangs together, the largest first."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxphoto.adjustment import MINIMAL_SIZES, Adjustment
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import BlockError, DatumError, GroupsError, InputError, RankError
from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.procedures.control import ControlledBlock, retest
from jaxphoto.procedures.control.of_flight import FlightControl, adjust_with_control, parts_with_marks
from jaxphoto.procedures.georeference_photographs import (
    GeoreferencedPhotographs,
    as_they_scatter,
    georeference_photographs,
    held_in_place,
)
from jaxphoto.procedures.known_lens import KnownLens, with_known_lens
from jaxphoto.procedures.matched_part import MatchedPart
from jaxphoto.procedures.orientation import Oriented, orient
from jaxphoto.procedures.orientation.orient_photographs import CAMERA, Report
from jaxphoto.procedures.rolling_shutter import NEIGHBOUR_M, Moment, with_rolling_shutter
from jaxphoto.statistics import VarianceComponents, variance_components

# Random vectors: hundreds of thousands of image points make each expensive, and there are few parts to tell apart.
_PROBES = 16
# Photographs that the part around them would not take make one of their own from so many; nothing checks two.
_PART_OF_ITS_OWN = 3
_NO_PAIR = "no other photograph has a relative orientation to it"


class KnownOfFlight(NamedTuple):
    """What is known of a flight besides what its photographs show; by the names of the photographs."""

    positions: Mapping[str, Gps | None] = {}
    attitudes: Mapping[str, CameraAttitude | None] = {}
    code: int | None = None
    """EPSG code of the map system; None: the zone of UTM."""
    control: FlightControl | None = None
    lens: KnownLens | None = None
    taken: Mapping[str, Moment] | None = None
    """When photographs were taken; given where a rolling shutter is to be estimated."""
    vertical: int | None = None
    """EPSG code of the heights of the map system; None: above the ellipsoid."""
    order: Sequence[str] = ()
    """Names in the order of their exposures; where there are none, photographs are in that of their names."""


class FlightPart(NamedTuple):
    """Photographs that hang together, oriented, brought to their positions where they have any, and adjusted."""

    oriented: Oriented
    matched: MatchedPart
    placed: GeoreferencedPhotographs | None
    why_not: str
    """Why there are no stations; "" where there are. With `placed` they have brought the block to its place."""
    components: VarianceComponents | None
    """Of image points, and of stations and marks where there are any, if the adjustment converged."""
    adjusted: Adjustment
    controlled: ControlledBlock | None = None
    """With the control that was given."""
    no_control: str = ""
    """Why it has none of what was given."""
    lens: tuple[str, ...] = ()
    """What was known of the lens beforehand, where it was observed."""
    why_still: str = ""
    """Why no rolling shutter was estimated, though one was asked for."""


class CalibratedFlight(NamedTuple):
    """The parts of a flight, the largest first, and photographs that are in none, with the reason."""

    parts: tuple[FlightPart, ...]
    left_out: dict[str, str]


def calibrate_flight(
    matched: MatchedPart,
    sensor: Sensor,
    interior: InteriorOrientation,
    known: KnownOfFlight,
    report: Report = lambda text: None,
) -> CalibratedFlight:
    """Orient, georeference and adjust every part of the photographs of one camera, which starts at `interior`.

    A part is what hangs together; so do photographs that the others of their part see too little of, but they of each
    other enough.

    Photographs that cannot be oriented, and whole parts that cannot, are left out with the reason. What is `known` and
    does not fit a part, it goes without, and says why.

    Raises InputError where no part can be oriented.
    """
    parts: list[FlightPart] = []
    left: dict[str, str] = {}
    waiting = deque(matched.groups())
    while waiting:
        part, number = waiting.popleft(), len(parts) + 1
        report(f"part {number} of {number + len(waiting)}")
        try:
            parts.append(_calibrated(part, sensor, interior, known, report))
        except GroupsError as error:
            waiting += [part.among(group) for group in error.groups]
            left |= {name: _NO_PAIR for name in part.names if not any(name in group for group in error.groups)}
            continue
        except BlockError as error:
            why = f"its part of {len(part.names)} photographs cannot be oriented: {error}"
            left |= {name: left.get(name, why) for name in part.names}
            continue
        oriented = parts[-1].oriented
        unoriented = oriented.report.unoriented
        left = {name: why for name, why in (left | unoriented).items() if name not in oriented.block.images}
        waiting += part.among(unoriented).groups(_PART_OF_ITS_OWN)
    if not parts:
        raise InputError(f"no photographs can be oriented; {next(iter(left.values()), 'there are none')}")
    parts.sort(key=lambda p: -len(p.oriented.block.images))
    return CalibratedFlight(tuple(parts), left)


def _calibrated(
    matched: MatchedPart, sensor: Sensor, interior: InteriorOrientation, known: KnownOfFlight, report: Report
) -> FlightPart:
    title, lens = f"flight of {len(matched.names)} photographs", known.lens
    oriented = orient(
        matched.names, sensor, interior, matched.xy_mm, matched.pairs, matched.sigma_mm, title=title, report=report
    )
    if lens is not None:
        oriented = oriented._replace(block=with_known_lens(oriented.block, CAMERA, lens))
    report("adjusting")
    placed, why_not, controlled, no_control = None, "", None, ""
    if known.control is not None and known.control.local:
        why_not = "the control is in a local system, in which positions of photographs tell nothing: none is used"
    else:
        try:
            placed = georeference_photographs(
                oriented.block, known.positions, known.code, known.attitudes, known.vertical, known.order
            )
        except (InputError, BlockError) as error:
            why_not = str(error)
    block = placed.block if placed else oriented.block
    if known.control is not None:
        controlled, no_control = adjust_with_control(block, known.control, known.code, known.vertical, report)
    try:
        # Without positions it is the network that the orientation ended with, which needs no other program.
        sizes = MINIMAL_SIZES if placed else oriented.sizes
        adjusted = controlled.adjusted if controlled else adjust_for_tables(block, sizes=sizes)
    except (InputError, BlockError, DatumError, RankError) as error:
        if placed is None:
            raise
        placed, why_not, adjusted = _placed_otherwise(placed, known.positions, oriented.block, error)
    metric = bool(controlled or (placed and not why_not))
    adjusted, why_still = _rolling(adjusted, known.taken, metric)
    components = None
    # What is known of the lens has a weight that image points must be brought to, with stations or without.
    if (placed or controlled or lens) and bool(adjusted.converged):
        report("estimating variance components")
        marked = {controlled.ids[p] for p in controlled.marks.point} if controlled else ()
        components = variance_components(adjusted, parts_with_marks(adjusted, marked), probes=_PROBES)
        # Without an optimum they are no weights; the report says so.
        adjusted = components.adjusted if bool(components.adjusted.converged) else adjusted
    return FlightPart(
        oriented,
        matched,
        placed,
        why_not,
        components,
        adjusted,
        retest(controlled, adjusted) if controlled else None,
        no_control,
        lens.sentences(oriented.block, CAMERA) if lens else (),
        why_still,
    )


def _placed_otherwise(
    placed: GeoreferencedPhotographs, positions: Mapping[str, Gps | None], block: Block, error: Exception
) -> tuple[GeoreferencedPhotographs | None, str, Adjustment]:
    """The calibration where positions do not tell the frame, or too badly: by how they scatter, else without them."""
    if isinstance(error, DatumError) and (better := as_they_scatter(placed, positions)):
        try:
            return better, "", adjust_for_tables(better.block)
        except (InputError, BlockError, DatumError, RankError) as again:
            error = again
    held = held_in_place(placed, block.datum)
    return held, str(error), adjust_for_tables(held.block if held else block)


def _rolling(adjusted: Adjustment, taken: Mapping[str, Moment] | None, metric: bool) -> tuple[Adjustment, str]:
    """The adjustment with a rolling shutter; the one that was given, and why, where that cannot be estimated."""
    if taken is None:
        return adjusted, ""
    if not metric or not bool(adjusted.converged):
        return adjusted, "no rolling shutter is estimated: without positions and an optimum nothing tells speeds"
    try:
        found = adjust_for_tables(with_rolling_shutter(adjusted.block, taken, NEIGHBOUR_M, known=adjusted.unknowns))
    except (InputError, RankError) as error:
        return adjusted, f"no rolling shutter is estimated: {error}"
    if not bool(found.converged):
        return adjusted, f"no rolling shutter is estimated: {found.outcome.value}"
    return found, ""
