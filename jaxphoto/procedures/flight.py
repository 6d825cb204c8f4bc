"""From matched photographs of a flight to calibrations: each part that hangs together, the largest first."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxphoto.adjustment import Adjustment
from jaxphoto.camera import AbstractDistortion, InteriorOrientation
from jaxphoto.errors import BlockError, DatumError, InputError, RankError
from jaxphoto.image_measurement.matching import MatchedPhotographs
from jaxphoto.io.photographs import CameraStart, Photograph
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.procedures.georeference_photographs import GeoreferencedPhotographs, georeference_photographs
from jaxphoto.procedures.orientation import Oriented, orient
from jaxphoto.procedures.orientation.related_pairs import Report
from jaxphoto.statistics import Selection, VarianceComponents, variance_components

# Stations by what differs between receivers; the features' own scale comes with them.
PARTS = {
    "image points": Selection("image_points"),
    "stations X-Y": Selection("stations", axes=("X", "Y")),
    "stations Z": Selection("stations", axes="Z"),
}
# Random vectors: hundreds of thousands of image points make each expensive, and there are three parts to tell apart.
_PROBES = 16


class FlightPart(NamedTuple):
    """Photographs that hang together, oriented, brought to their positions where they have any, and adjusted."""

    oriented: Oriented
    matched: MatchedPhotographs
    placed: GeoreferencedPhotographs | None
    why_not: str
    """Why there are no stations; "" where there are."""
    components: VarianceComponents | None
    """Of image points and stations, where these are stations and the adjustment converged."""
    adjusted: Adjustment


class Flight(NamedTuple):
    """The parts of a flight, and photographs that are in none, with the reason."""

    parts: tuple[FlightPart, ...]
    left_out: dict[str, str]


def calibrate_flight(
    photographs: Sequence[Photograph],
    camera: CameraStart,
    distortion: AbstractDistortion,
    matched: MatchedPhotographs,
    code: int | None = None,
    report: Report = lambda text: None,
) -> Flight:
    """Orient, georeference and adjust every part of the `matched` photographs of one `camera`.

    `code` is the EPSG code of the map system (UTM where there is none). Photographs that nothing joins to others, that
    cannot be oriented, and whole parts that cannot, are left out with the reason.

    Raises InputError where no part can be oriented.
    """
    parts, left = [], dict(matched.left_out)
    for number, group in enumerate(matched.parts, 1):
        chosen = [photographs[k] for k in group]
        report(f"part {number} of {len(matched.parts)}")
        try:
            part = _calibrated(chosen, camera, distortion, matched.of(group), code, report)
        except BlockError as error:
            left |= {p.name: f"its part of {len(chosen)} photographs cannot be oriented: {error}" for p in chosen}
            continue
        parts.append(part)
        left |= part.oriented.report.unoriented
    if not parts:
        raise InputError(f"no photographs can be oriented; {next(iter(left.values()))}")
    parts.sort(key=lambda p: -len(p.oriented.block.images))
    return Flight(tuple(parts), left)


def _calibrated(
    photographs: Sequence[Photograph],
    camera: CameraStart,
    distortion: AbstractDistortion,
    matched: MatchedPhotographs,
    code: int | None,
    report: Report,
) -> FlightPart:
    start = camera.interior
    oriented = orient(
        [p.name for p in photographs],
        camera.sensor,
        InteriorOrientation(start.c, start.x_p, start.y_p, distortion),
        matched.xy_mm,
        matched.pairs,
        matched.sigma_mm,
        title=f"flight of {len(photographs)} photographs",
        report=report,
    )
    report("adjusting")
    placed, why_not = None, ""
    try:
        placed = georeference_photographs(oriented.block, {p.name: p.gps for p in photographs}, code)
        adjusted = adjust_for_tables(placed.block)
    except (InputError, BlockError, DatumError, RankError) as error:
        # Positions that do not tell the frame, or too badly: the calibration does without.
        placed, why_not = None, str(error)
        adjusted = adjust_for_tables(oriented.block)
    components = None
    if placed and bool(adjusted.converged):
        report("estimating variance components")
        components = variance_components(adjusted, PARTS, probes=_PROBES)
        # Without an optimum they are no weights; the report says so.
        adjusted = components.adjusted if bool(components.adjusted.converged) else adjusted
    return FlightPart(oriented, matched, placed, why_not, components, adjusted)
