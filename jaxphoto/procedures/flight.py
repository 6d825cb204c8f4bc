"""Calibrate a flight from matched photographs: each connected part, the largest first."""

from collections import deque
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxphoto.adjustment import MINIMAL_SIZES, Adjustment
from jaxphoto.camera import InteriorOrientation, Sensor
from jaxphoto.errors import BlockError, DatumError, GroupsError, InputError, JaxphotoError, RankError, few
from jaxphoto.georeferencing.camera_attitude import CameraAttitude
from jaxphoto.georeferencing.recorded_positions import Gps
from jaxphoto.initial.matches import MatchedPart
from jaxphoto.procedures.adjust import adjust_for_tables
from jaxphoto.procedures.control import ControlledBlock, control_block, retest
from jaxphoto.procedures.control.control_block import new_code, stated_system
from jaxphoto.procedures.control.marks import images_of
from jaxphoto.procedures.control.surveyed import GivenControl, check_near
from jaxphoto.procedures.georeference_photographs import (
    GeoreferencedPhotographs,
    georeference_photographs,
    with_fixed_datum,
)
from jaxphoto.procedures.known_lens import KnownLens, RejectedPrior, contradicted_prior, with_known_lens
from jaxphoto.procedures.orientation import Oriented, orient
from jaxphoto.procedures.orientation.orient_photographs import CAMERA, Report
from jaxphoto.procedures.rolling_shutter import NEIGHBOUR_M, Moment, with_rolling_shutter
from jaxphoto.statistics import CorrelatedNoise, Selection, VarianceComponents, correlated_noise, variance_components

# Number of random vectors of the trace estimate. Each is expensive with 1e5 image points, and a few suffice for few
# variance components.
_PROBES = 16
# Minimum number of unoriented photographs that form a separate part; two would have no redundancy.
_PART_OF_ITS_OWN = 3
_NO_PAIR = "no relative orientation to any other photograph"


class FlightControl(NamedTuple):
    """Control, and the coordinate system of its points if the file does not specify one."""

    control: GivenControl
    system: str | None
    images: tuple[str, ...]
    """All valid photographs of the flight."""
    local: bool
    """True for points in local Cartesian metres, which are unrelated to the positions of photographs."""


def flight_control(
    control: GivenControl,
    system: str | None,
    images: Iterable[str],
    positions: Iterable[Gps | None],
    code: int | None = None,
) -> tuple[FlightControl, int | None]:
    """Check control against photographs, and return the EPSG code of the flight: `code`, or the code of the points.

    Raises InputError if no mark is in one of the `images`, for a missing or invalid system, for a local one together
    with `code`, and for points far from the `positions`.
    """
    recorded = [gps for gps in positions if gps is not None]
    place = np.median([(g.longitude_deg, g.latitude_deg) for g in recorded], axis=0) if recorded else None
    stated = stated_system(control.points, system)
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
        return FlightControl(control, system, names, local=True), None
    flight_code = new_code(control.points, stated) if code is None else code
    return FlightControl(control, system, names, local=False), flight_code


class KnownOfFlight(NamedTuple):
    """Prior information about a flight; mappings are by photograph."""

    positions: Mapping[str, Gps | None] = {}
    attitudes: Mapping[str, CameraAttitude | None] = {}
    code: int | None = None
    """EPSG code of the map system; None for UTM."""
    control: FlightControl | None = None
    lens: KnownLens | None = None
    taken: Mapping[str, Moment] | None = None
    """Exposure times, if a rolling shutter is to be estimated."""
    vertical: int | None = None
    """EPSG code of the heights; None for ellipsoidal heights."""


class FlightPart(NamedTuple):
    """Connected photographs, oriented, adjusted, and georeferenced if they have positions."""

    oriented: Oriented
    matched: MatchedPart
    placed: GeoreferencedPhotographs | None
    why_not: str
    """Reason for missing stations, or "". If also `placed`, the positions were used for georeferencing only."""
    components: VarianceComponents | None
    """Variance components of image points, stations and marks, if the adjustment converged."""
    adjusted: Adjustment
    noise: CorrelatedNoise | None
    """Spatially correlated errors of the image points, if the adjustment converged."""
    controlled: ControlledBlock | None = None
    """Block adjusted with the given control."""
    no_control: str = ""
    """Reason for unused control."""
    lens: tuple[str, ...] = ()
    """Messages about the prior information about the lens, if used."""
    lens_rejected: tuple[RejectedPrior, ...] = ()
    """Priors of the lens that contradict the images, and are not used."""
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

    Photographs that a part cannot orient, but that are sufficiently connected, form a separate part. Photographs and
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
    title = f"flight of {len(matched.names)} photographs"
    oriented = orient(
        matched.names, sensor, interior, matched.xy_mm, matched.pairs, matched.sigma_mm, title=title, report=report
    )
    part = _adjusted(oriented, matched, prior, (), report)
    # Focal lengths in EXIF may be those of another format (cropped pictures, video).
    while part.noise is not None and (found := contradicted_prior(part.adjusted, part.noise, CAMERA)):
        part = _adjusted(oriented, matched, prior, (*part.lens_rejected, found), report)
    return part


def _adjusted(
    oriented: Oriented,
    matched: MatchedPart,
    prior: KnownOfFlight,
    rejected: tuple[RejectedPrior, ...],
    report: Report,
) -> FlightPart:
    """Georeference and adjust an oriented part, without the `rejected` priors of the lens."""
    lens = prior.lens
    if lens is not None:
        without = [one.parameter for one in rejected]
        oriented = oriented._replace(block=with_known_lens(oriented.block, CAMERA, lens, without))
    report("adjusting")
    placed, why_not, controlled, no_control = None, "", None, ""
    if prior.control is not None and prior.control.local:
        why_not = "control is in a local system, so positions of photographs are not used"
    else:
        try:
            placed = georeference_photographs(
                oriented.block, prior.positions, prior.code, prior.attitudes, prior.vertical
            )
        except (InputError, BlockError) as error:
            why_not = str(error)
    block = placed.block if placed else oriented.block
    if prior.control is not None:
        how: dict[str, Any] = {"system": prior.control.system, "code": prior.code, "vertical": prior.vertical}
        try:
            elsewhere = prior.control.images
            controlled = control_block(block, prior.control.control, elsewhere=elsewhere, report=report, **how)
        except JaxphotoError as error:
            no_control = str(error)
    try:
        # Without positions, adjust the network of the orientation, to reuse its compiled code.
        sizes = MINIMAL_SIZES if placed else oriented.sizes
        adjusted = controlled.adjusted if controlled else adjust_for_tables(block, sizes=sizes)
    except (InputError, BlockError, DatumError, RankError) as error:
        if placed is None:
            raise
        # The stations determine the datum too weakly: use them for georeferencing only.
        placed, why_not = with_fixed_datum(placed, oriented.block.datum), str(error)
        adjusted = adjust_for_tables(placed.block)
    metric = bool(controlled or (placed and not why_not))
    adjusted, why_no_shutter = _rolling(adjusted, prior.taken, metric)
    components = None
    # Estimate components also with prior information about the lens, which requires realistic weights of the image
    # points.
    if (placed or controlled or lens) and bool(adjusted.converged):
        report("estimating variance components")
        marked = {controlled.ids[p] for p in controlled.marks.point} if controlled else ()
        components = variance_components(adjusted, _component_parts(adjusted, marked), probes=_PROBES)
        # Variance components are not used unless their estimation converged; the report states this.
        adjusted = components.adjusted if bool(components.adjusted.converged) else adjusted
    noise = correlated_noise(adjusted) if bool(adjusted.converged) else None
    return FlightPart(
        oriented, matched, placed, why_not, components, adjusted, noise,
        retest(controlled, adjusted) if controlled else None, no_control,
        lens.sentences(oriented.block, CAMERA) if lens else (), rejected, why_no_shutter,
    )  # fmt: skip


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


def _component_parts(adjusted: Adjustment, marked: Collection[str]) -> dict[str, Selection]:
    """Return observation groups with a variance component each: features, marks, stations in plan and height."""
    parts = {"image points": Selection("image_points")}
    if marked:
        ties = [name for name in adjusted.block.points if name not in marked]
        parts["image points"] = Selection("image_points", points=ties)
        parts["marks"] = Selection("image_points", points=set(marked))
    if len(adjusted.block.stations):
        parts |= {"stations X-Y": Selection("stations", axes=("X", "Y")), "stations Z": Selection("stations", axes="Z")}
    return parts
