"""Calibrate a flight from matched photographs: each connected part, the largest first."""

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
    georeference_photographs,
    with_fixed_datum,
    with_observed_scatter,
)
from jaxphoto.procedures.known_lens import KnownLens, with_known_lens
from jaxphoto.procedures.matched_part import MatchedPart
from jaxphoto.procedures.orientation import Oriented, orient
from jaxphoto.procedures.orientation.orient_photographs import CAMERA, Report
from jaxphoto.procedures.rolling_shutter import NEIGHBOUR_M, Moment, with_rolling_shutter
from jaxphoto.statistics import VarianceComponents, variance_components

# Random vectors of the trace estimate: each is expensive with 1e5 image points, and there are few variance components.
_PROBES = 16
# Minimum number of unoriented photographs that form a part of their own; two would have no redundancy.
_PART_OF_ITS_OWN = 3
_NO_PAIR = "no relative orientation to any other photograph"


class KnownOfFlight(NamedTuple):
    """Prior information about a flight; mappings are by photograph."""

    positions: Mapping[str, Gps | None] = {}
    attitudes: Mapping[str, CameraAttitude | None] = {}
    code: int | None = None
    """EPSG code of the map system; None: UTM."""
    control: FlightControl | None = None
    lens: KnownLens | None = None
    taken: Mapping[str, Moment] | None = None
    """Exposure times, if a rolling shutter is to be estimated."""
    vertical: int | None = None
    """EPSG code of the heights; None: ellipsoidal."""
    order: Sequence[str] = ()
    """Photographs in the order of exposures; default: by name."""


class FlightPart(NamedTuple):
    """Connected photographs, oriented, georeferenced if they have positions, and adjusted."""

    oriented: Oriented
    matched: MatchedPart
    placed: GeoreferencedPhotographs | None
    why_not: str
    """Reason for missing stations, or "". With `placed` the positions were used to georeference only."""
    components: VarianceComponents | None
    """Of image points, stations and marks, if the adjustment converged."""
    adjusted: Adjustment
    controlled: ControlledBlock | None = None
    """With the given control."""
    no_control: str = ""
    """Reason for unused control."""
    lens: tuple[str, ...] = ()
    """Messages about the prior information about the lens, if used."""
    why_no_shutter: str = ""
    """Reason why a requested rolling shutter was not estimated."""


class CalibratedFlight(NamedTuple):
    """Parts of a flight, the largest first, and photographs that belong to none, with the reason."""

    parts: tuple[FlightPart, ...]
    left_out: dict[str, str]


def calibrate_flight(
    matched: MatchedPart,
    sensor: Sensor,
    interior: InteriorOrientation,
    prior: KnownOfFlight,
    report: Report = lambda text: None,
) -> CalibratedFlight:
    """Orient, georeference and adjust every connected part of the photographs of one camera, starting at `interior`.

    Photographs that a part cannot orient, but that see enough of one another, form a part of their own. Photographs and
    parts that cannot be oriented are returned with the reason. A part is adjusted without `prior` information that
    contradicts it, also with the reason. Raises InputError if no part can be oriented.
    """
    parts: list[FlightPart] = []
    left: dict[str, str] = {}
    waiting = deque(matched.groups())
    while waiting:
        part, number = waiting.popleft(), len(parts) + 1
        report(f"part {number} of {number + len(waiting)}")
        try:
            parts.append(_calibrated(part, sensor, interior, prior, report))
        except GroupsError as error:
            waiting += [part.among(group) for group in error.groups]
            left |= {name: _NO_PAIR for name in part.names if not any(name in group for group in error.groups)}
            continue
        except BlockError as error:
            why = f"the part of {len(part.names)} photographs cannot be oriented: {error}"
            left |= {name: left.get(name, why) for name in part.names}
            continue
        oriented = parts[-1].oriented
        unoriented = oriented.report.unoriented
        left = {name: why for name, why in (left | unoriented).items() if name not in oriented.block.images}
        waiting += part.among(unoriented).groups(_PART_OF_ITS_OWN)
    if not parts:
        raise InputError(f"no photograph can be oriented: {next(iter(left.values()), 'there are none')}")
    parts.sort(key=lambda p: -len(p.oriented.block.images))
    return CalibratedFlight(tuple(parts), left)


def _calibrated(
    matched: MatchedPart, sensor: Sensor, interior: InteriorOrientation, prior: KnownOfFlight, report: Report
) -> FlightPart:
    title, lens = f"flight of {len(matched.names)} photographs", prior.lens
    oriented = orient(
        matched.names, sensor, interior, matched.xy_mm, matched.pairs, matched.sigma_mm, title=title, report=report
    )
    if lens is not None:
        oriented = oriented._replace(block=with_known_lens(oriented.block, CAMERA, lens))
    report("adjusting")
    placed, why_not, controlled, no_control = None, "", None, ""
    if prior.control is not None and prior.control.local:
        why_not = "control is in a local system, so positions of photographs are not used"
    else:
        try:
            placed = georeference_photographs(
                oriented.block, prior.positions, prior.code, prior.attitudes, prior.vertical, prior.order
            )
        except (InputError, BlockError) as error:
            why_not = str(error)
    block = placed.block if placed else oriented.block
    if prior.control is not None:
        controlled, no_control = adjust_with_control(block, prior.control, prior.code, prior.vertical, report)
    try:
        # Without positions it is the network of the orientation, which reuses its compiled code.
        sizes = MINIMAL_SIZES if placed else oriented.sizes
        adjusted = controlled.adjusted if controlled else adjust_for_tables(block, sizes=sizes)
    except (InputError, BlockError, DatumError, RankError) as error:
        if placed is None:
            raise
        placed, why_not, adjusted = _placed_otherwise(placed, prior.positions, oriented.block, error)
    metric = bool(controlled or (placed and not why_not))
    adjusted, why_no_shutter = _rolling(adjusted, prior.taken, metric)
    components = None
    # Prior information about the lens needs the relative weight of image points, with or without stations.
    if (placed or controlled or lens) and bool(adjusted.converged):
        report("estimating variance components")
        marked = {controlled.ids[p] for p in controlled.marks.point} if controlled else ()
        components = variance_components(adjusted, parts_with_marks(adjusted, marked), probes=_PROBES)
        # Without convergence they are no weights; the report says so.
        adjusted = components.adjusted if bool(components.adjusted.converged) else adjusted
    return FlightPart(
        oriented, matched, placed, why_not, components, adjusted,
        retest(controlled, adjusted) if controlled else None, no_control,
        lens.sentences(oriented.block, CAMERA) if lens else (), why_no_shutter,
    )  # fmt: skip


def _placed_otherwise(
    placed: GeoreferencedPhotographs, positions: Mapping[str, Gps | None], block: Block, error: Exception
) -> tuple[GeoreferencedPhotographs | None, str, Adjustment]:
    """Adjust a part whose stations determine the datum too weakly: with their scatter as sigma, or without them."""
    if isinstance(error, DatumError) and (better := with_observed_scatter(placed, positions)):
        try:
            return better, "", adjust_for_tables(better.block)
        except (InputError, BlockError, DatumError, RankError) as again:
            error = again
    held = with_fixed_datum(placed, block.datum)
    return held, str(error), adjust_for_tables(held.block if held else block)


def _rolling(adjusted: Adjustment, taken: Mapping[str, Moment] | None, metric: bool) -> tuple[Adjustment, str]:
    """Adjust with a rolling shutter; returns the original adjustment and the reason if that fails."""
    if taken is None:
        return adjusted, ""
    if not metric or not bool(adjusted.converged):
        return adjusted, "no rolling shutter is estimated: velocities need positions and a converged adjustment"
    try:
        rolling = adjust_for_tables(with_rolling_shutter(adjusted.block, taken, NEIGHBOUR_M, known=adjusted.unknowns))
    except (InputError, RankError) as error:
        return adjusted, f"no rolling shutter is estimated: {error}"
    if not bool(rolling.converged):
        return adjusted, f"no rolling shutter is estimated: {rolling.outcome.value}"
    return rolling, ""
