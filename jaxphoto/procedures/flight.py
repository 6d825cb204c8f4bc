"""From matched photographs of a flight to calibrations: each part that hangs together, the largest first."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import BlockError, DatumError, InputError, RankError
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.orientation.matches import PairMatches
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.procedures.control import ControlledBlock, rejudged
from jaxphoto.procedures.control.of_flight import FlightControl, controlled_or_why, parts_with_marks
from jaxphoto.procedures.georeference_photographs import GeoreferencedPhotographs, georeference_photographs
from jaxphoto.procedures.orientation import Oriented, orient
from jaxphoto.procedures.orientation.related_pairs import Report
from jaxphoto.statistics import VarianceComponents, variance_components

# Random vectors: hundreds of thousands of image points make each expensive, and there are three parts to tell apart.
_PROBES = 16


class MatchedPart(NamedTuple):
    """Photographs that hang together: their features and which of them are the same places, as `orient` takes them."""

    names: list[str]
    xy_mm: list[Float[np.ndarray, "n 2"]]
    sigma_mm: list[Float[np.ndarray, "n"]]
    pairs: list[PairMatches]
    n_gross: int
    """Matches by looks that were left out."""
    sigma_factor: float
    """How far the others scatter, over what is expected of features of a plane."""


class FlightPart(NamedTuple):
    """Photographs that hang together, oriented, brought to their positions where they have any, and adjusted."""

    oriented: Oriented
    matched: MatchedPart
    placed: GeoreferencedPhotographs | None
    why_not: str
    """Why there are no stations; "" where there are."""
    components: VarianceComponents | None
    """Of image points and stations, where these are stations and the adjustment converged."""
    adjusted: Adjustment
    controlled: ControlledBlock | None = None
    """With the control that was given."""
    no_control: str = ""
    """Why it has none of what was given."""


class CalibratedFlight(NamedTuple):
    """The parts of a flight, the largest first, and photographs that are in none, with the reason."""

    parts: tuple[FlightPart, ...]
    left_out: dict[str, str]


def calibrate_flight(
    matched: Sequence[MatchedPart],
    sensor: Sensor,
    interior: InteriorOrientation,
    positions: Mapping[str, Gps | None],
    code: int | None = None,
    report: Report = lambda text: None,
    control: FlightControl | None = None,
) -> CalibratedFlight:
    """Orient, georeference and adjust every part of the photographs of one camera, which starts at `interior`.

    `positions` are by name; `code` is the EPSG code of the map system (UTM where there is none). Photographs that
    cannot be oriented, and whole parts that cannot, are left out with the reason. A part that `control` does not fit
    goes without.

    Raises InputError where no part can be oriented.
    """
    parts: list[FlightPart] = []
    left: dict[str, str] = {}
    for number, part in enumerate(matched, 1):
        report(f"part {number} of {len(matched)}")
        try:
            parts.append(_calibrated(part, sensor, interior, positions, code, report, control))
        except BlockError as error:
            left |= {
                name: f"its part of {len(part.names)} photographs cannot be oriented: {error}" for name in part.names
            }
            continue
        left |= parts[-1].oriented.report.unoriented
    if not parts:
        raise InputError(f"no photographs can be oriented; {next(iter(left.values()), 'there are none')}")
    parts.sort(key=lambda p: -len(p.oriented.block.images))
    return CalibratedFlight(tuple(parts), left)


def _calibrated(
    matched: MatchedPart,
    sensor: Sensor,
    interior: InteriorOrientation,
    positions: Mapping[str, Gps | None],
    code: int | None,
    report: Report,
    control: FlightControl | None,
) -> FlightPart:
    title = f"flight of {len(matched.names)} photographs"
    oriented = orient(
        matched.names, sensor, interior, matched.xy_mm, matched.pairs, matched.sigma_mm, title=title, report=report
    )
    report("adjusting")
    placed, why_not, controlled, no_control = None, "", None, ""
    try:
        placed = georeference_photographs(oriented.block, positions, code)
    except (InputError, BlockError) as error:
        why_not = str(error)
    if control is not None:
        controlled, no_control = controlled_or_why(placed.block if placed else oriented.block, control, code, report)
    try:
        adjusted = controlled.adjusted if controlled else adjust_for_tables(placed.block if placed else oriented.block)
    except (InputError, BlockError, DatumError, RankError) as error:
        if placed is None:
            raise
        # Positions that do not tell the frame, or too badly: the calibration does without.
        placed, why_not = None, str(error)
        adjusted = adjust_for_tables(oriented.block)
    components = None
    if (placed or controlled) and bool(adjusted.converged):
        report("estimating variance components")
        marked = {controlled.ids[p] for p in controlled.marks.point} if controlled else ()
        components = variance_components(adjusted, parts_with_marks(adjusted, marked), probes=_PROBES)
        # Without an optimum they are no weights; the report says so.
        adjusted = components.adjusted if bool(components.adjusted.converged) else adjusted
        controlled = rejudged(controlled, adjusted) if controlled else None
    return FlightPart(oriented, matched, placed, why_not, components, adjusted, controlled, no_control)
