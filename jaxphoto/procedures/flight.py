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
from jaxphoto.procedures.georeference_photographs import GeoreferencedPhotographs, georeference_photographs
from jaxphoto.procedures.known_lens import KnownLens, with_known_lens
from jaxphoto.procedures.orientation import Oriented, orient
from jaxphoto.procedures.orientation.orient_photographs import CAMERA
from jaxphoto.procedures.orientation.related_pairs import Report
from jaxphoto.procedures.rolling_shutter import Moment, with_rolling_shutter
from jaxphoto.statistics import Selection, VarianceComponents, variance_components

# Stations by what differs between receivers; the features' own scale comes with them.
PARTS = {
    "image points": Selection("image_points"),
    "stations X-Y": Selection("stations", axes=("X", "Y")),
    "stations Z": Selection("stations", axes="Z"),
}
IMAGE_POINTS = {"image points": PARTS["image points"]}
# What adjusted positions are off by against their neighbours.
_NEIGHBOUR_M = 0.05
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
    """Of image points, and of stations where there are any, if the adjustment converged."""
    adjusted: Adjustment
    lens: tuple[str, ...] = ()
    """What was known of the lens beforehand, where it was observed."""
    why_still: str = ""
    """Why no rolling shutter was estimated, though one was asked for."""


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
    lens: KnownLens | None = None,
    taken: Mapping[str, Moment] | None = None,
) -> CalibratedFlight:
    """Orient, georeference and adjust every part of the photographs of one camera, which starts at `interior`.

    `positions` are by name; `code` is the EPSG code of the map system (UTM where there is none). Photographs that
    cannot be oriented, and whole parts that cannot, are left out with the reason. `lens` is what is known of it before.
    With the times at which photographs were `taken` a rolling shutter is estimated, where these have positions.

    Raises InputError where no part can be oriented.
    """
    parts: list[FlightPart] = []
    left: dict[str, str] = {}
    for number, part in enumerate(matched, 1):
        report(f"part {number} of {len(matched)}")
        try:
            parts.append(_calibrated(part, sensor, interior, positions, code, report, lens, taken))
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
    lens: KnownLens | None,
    taken: Mapping[str, Moment] | None,
) -> FlightPart:
    title = f"flight of {len(matched.names)} photographs"
    oriented = orient(
        matched.names, sensor, interior, matched.xy_mm, matched.pairs, matched.sigma_mm, title=title, report=report
    )
    if lens is not None:
        oriented = oriented._replace(block=with_known_lens(oriented.block, CAMERA, lens))
    report("adjusting")
    placed, why_not = None, ""
    try:
        placed = georeference_photographs(oriented.block, positions, code)
        adjusted = adjust_for_tables(placed.block)
    except (InputError, BlockError, DatumError, RankError) as error:
        # Positions that do not tell the frame, or too badly: the calibration does without.
        placed, why_not = None, str(error)
        adjusted = adjust_for_tables(oriented.block)
    why_still = ""
    if taken is not None:
        adjusted, why_still = _rolling(adjusted, taken, placed is not None)
    components = None
    # What is known of the lens has a weight that image points must be brought to, with stations or without.
    if (placed or lens) and bool(adjusted.converged):
        report("estimating variance components")
        components = variance_components(adjusted, PARTS if placed else IMAGE_POINTS, probes=_PROBES)
        # Without an optimum they are no weights; the report says so.
        adjusted = components.adjusted if bool(components.adjusted.converged) else adjusted
    known = lens.sentences(oriented.block, CAMERA) if lens else ()
    return FlightPart(oriented, matched, placed, why_not, components, adjusted, known, why_still)


def _rolling(adjusted: Adjustment, taken: Mapping[str, Moment], metric: bool) -> tuple[Adjustment, str]:
    """The adjustment with a rolling shutter; the one that was given, and why, where that cannot be estimated."""
    if not metric or not bool(adjusted.converged):
        return adjusted, "no rolling shutter is estimated: without positions and an optimum nothing tells speeds"
    try:
        found = adjust_for_tables(with_rolling_shutter(adjusted.block, taken, _NEIGHBOUR_M, known=adjusted.unknowns))
    except (InputError, RankError) as error:
        return adjusted, f"no rolling shutter is estimated: {error}"
    if not bool(found.converged):
        return adjusted, f"no rolling shutter is estimated: {found.outcome.value}"
    return found, ""
