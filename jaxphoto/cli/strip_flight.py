"""What `strips` and `simultaneous` have in common: the strips of a flight are read, adjusted and written.

The cloud passes part by part, and what its planes need of it is kept in memory.
"""

from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import typer
from jaxtyping import Float

from jaxphoto.block import Block, Frame
from jaxphoto.cli.choices import one_of, positive, seconds
from jaxphoto.cli.cloud_progress import CloudProgress
from jaxphoto.cli.control_in_frame import control_in_frame
from jaxphoto.cli.corrected_cloud import write_corrected
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output
from jaxphoto.cli.progress import StepsLeft
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import PATTERN_OF, ScannerCalibration
from jaxphoto.io import clouds, read_block, write_block
from jaxphoto.io.block_folder import exposure_times
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem
from jaxphoto.io.clouds.placement import Placement
from jaxphoto.io.names import points_called
from jaxphoto.io.raster import write_dsm
from jaxphoto.io.trajectory import Records, read_records, write_moved
from jaxphoto.io.trajectory.in_frame import trajectory_in, with_poses
from jaxphoto.lidar.cell_returns import CellTally
from jaxphoto.lidar.correction import scanner_path
from jaxphoto.lidar.coverage import CoveredTimes
from jaxphoto.lidar.raster import Raster
from jaxphoto.lidar.strip_correction import correct_strips
from jaxphoto.lidar.strip_differences import strip_differences
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.orientation import approximate
from jaxphoto.parameters import dynamic_fields
from jaxphoto.procedures.lidar import (
    Photographs,
    ScannerPriors,
    StripAdjustment,
    StripRound,
    adjust_strips,
    kept_returns,
)
from jaxphoto.procedures.lidar.looks import looks_of
from jaxphoto.procedures.lidar.until_still import at_result, interior_held
from jaxphoto.procedures.lidar.vertical_control import tie_points
from jaxphoto.report.strips import print_strips, strips_verdict, write_strips
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_verdict
from jaxphoto.unknowns import FIXED, FREE
from jaxphoto.writing import check_folder

SCANNER = ("boresight", *(name.replace("_", "-") for name in dynamic_fields(ScannerCalibration)))
"""What of a scanner may be estimated."""
USUAL = StripSettings()
PatternOption = Annotated[
    str | None,
    one_of(
        PATTERN_OF,
        help="Of the scanner, or its kind: line (default), as of mirrors that are oscillating or rotating; or circle, "
        "all around, as of risley prisms or nutating mirrors.",
    ),
]
TrajectoryShift = Annotated[float, seconds("Cloud's time + this is the trajectory's.")]
ExposureShift = Annotated[
    float, seconds("Of photographs adjusted with the strips: time_s of images.csv + this is the cloud's time.")
]
CellM = Annotated[float, positive("Side of the cells in which planes are sought.")]
RoughnessM = Annotated[float, positive("Most that the returns of a plane scatter about it.")]
BreaklinesOption = Annotated[
    str | None,
    typer.Option(
        help="Tie points on breaklines, such as ridges of roofs, by commas; * stands for any letters "
        "(those of block.toml; docs/joint.md)."
    ),
]
ControlOption = Annotated[
    Path | None,
    typer.Option(help="Surveyed points on smooth surfaces (docs/control.md), which strips are to go through."),
]
KnotsS = Annotated[float, positive("From knot to knot of the trajectory's errors.")]


class StripFiles(NamedTuple):
    """The files of a flight, and what is said of them."""

    cloud: Path
    trajectory: Path | None
    trajectory_shift_s: float
    block: Path | None
    """Of its photographs."""
    exposure_shift_s: float
    classes: list[int] | None
    """Of the returns that planes are sought in; all are corrected."""
    returns: str
    epsg: int | None
    unit: str | None
    control: Path | None = None
    """Surveyed points, in the cloud's system."""
    breaklines: str | None = None
    """Tie points of the photographs on breaklines, as `BreaklinesOption` has them."""


class StripChoices(NamedTuple):
    """What of a flight is adjusted, and how."""

    settings: StripSettings
    given: set[str]
    """Standard deviations of the settings that are to be used whatever the trajectory states."""
    priors: ScannerPriors | None
    held: list[str] | Literal["all"]
    """Strips whose trajectory is right."""
    camera_held: bool
    """Whether the interior orientation of the photographs is right."""
    max_rounds: int


def scanner_priors(free: Collection[str], pattern: str | None) -> ScannerPriors:
    """FREE what is named of `SCANNER`, the rest FIXED; of a scanner that draws lines where no pattern is named."""
    boresight, *calibration = (FREE if name in free else FIXED for name in SCANNER)
    return ScannerPriors(boresight, ScannerCalibration(*calibration, PATTERN_OF[pattern or "line"]))  # type: ignore[arg-type, call-arg]


def adjust_flight(output: Output, context: typer.Context, flight: StripFiles, choices: StripChoices, out: Path) -> None:
    """Adjust the strips of a flight and its photographs; write the results, say them, and exit with 1 if red."""
    cloud, trajectory, block = flight.cloud, flight.trajectory, flight.block
    if flight.breaklines is not None and block is None:
        raise InputError("--breaklines names points of photographs: give their block (--block), or leave it out")
    settings, priors = choices.settings, choices.priors
    check_folder(out, cloud, *(path for path in (trajectory, block, flight.control) if path is not None))
    with output.progress.status("reading the cloud") as status:
        said: dict[str, Any] = {"epsg": flight.epsg, "unit": flight.unit}
        photographs, frame = None, Frame()
        if block is not None:
            read = read_block(block)
            posed = interior_held(read) if choices.camera_held else read
            times = exposure_times(block) + flight.exposure_shift_s
            photographs = Photographs(
                posed, times, points_called(read.points, _named(flight.breaklines), "--breaklines")
            )
            frame = photographs.block.frame
        records = path = None
        if trajectory is not None:
            # On the cloud's clock from here on.
            records = read_records(trajectory)
            records = records._replace(time=records.time - flight.trajectory_shift_s)
            if records.geographic and block is None:
                frame = _about(records, clouds.cloud_system(cloud, **said), cloud)
            path = trajectory_in(records, frame, *_stated(records, choices.given))
        own = frame if block is not None or frame.kind == "epsg" else None
        placement = Placement(cloud.name, clouds.cloud_system(cloud, **said), own)
        control = None if flight.control is None else control_in_frame(flight.control, placement)
        track = None if path is None else scanner_path(path)
        parts = partial(clouds.cloud_chunks, cloud, own, classes=flight.classes, returns=flight.returns, **said)  # type: ignore[arg-type]
        # Of a file that is filtered nobody knows how much will come.
        every = flight.classes is None and flight.returns == "all"
        progress = CloudProgress(
            StepsLeft(output.progress, status), status, clouds.most_points(cloud) if every else None
        )
        coverage = None if path is None else CoveredTimes(path)
        looked_at = kept_returns(
            _seen_by(coverage, progress.passes(parts)),
            settings,
            track,
            "line" if priors is None else priors.calibration.pattern,
            None if photographs is None else partial(_about_where, photographs.block),
            None if control is None else control.coordinates,
        )
        if coverage is not None:
            # Of all returns, on the clocks as they were given.
            coverage.check(flight.trajectory_shift_s)

        def report(made: StripRound) -> None:
            apart = f", strips {made.rms_m:.3f} m apart before" if made.planes else ""
            line = f"round {made.number}: {made.planes} planes{apart}"
            status.update(f"{line}; largest change {made.largest_change:.2g} standard deviations")

        options: dict[str, Any] = {
            "control": control,
            "held": choices.held,
            "max_rounds": choices.max_rounds,
            "report": report,
        }
        status.update("adjusting for the first round")
        result = adjust_strips(looked_at, path, settings, priors, photographs=photographs, **options)
        status.update(f"writing {out}")
        gaps = Gaps(placement, settings)
        tables = None if photographs is None else Tables(result.adjusted, known=result.covariance)
        made, verdict = made_by(context, cloud, trajectory, block, flight.control), strips_verdict(result, tables)

        def moved(part: Cloud) -> Float[np.ndarray, "n 3"]:
            progress("writing the corrected cloud", part)
            _check_known(part, result)
            corrected = correct_strips(part, result.errors, track).xyz
            seen = clouds.chosen_of(part, flight.classes, flight.returns, cloud.name)  # type: ignore[arg-type]
            gaps.add(part.take(seen), corrected[seen])
            return corrected

        def write_beside(folder: Path) -> tuple[Raster, Raster] | None:
            progress.begins()
            write_corrected(cloud, folder, moved, result.cloud.strips, path, own, said)
            if trajectory is not None and records is not None and result.trajectory is not None:
                back = with_poses(records, result.trajectory, frame)
                write_moved(back._replace(time=back.time + flight.trajectory_shift_s), trajectory, folder)
            if photographs is not None:
                write_block(at_result(result.adjusted.block, result.adjusted.unknowns), folder / "block")
            maps = gaps.maps
            for raster, name in zip(maps or (), ("before", "after"), strict=False):
                write_dsm(folder / f"differences_{name}.tif", raster, gaps.system)
            return maps

        write_strips(result, tables, verdict, out, write_beside, made)
    print_verdict(verdict, output.screen)
    print_strips(result, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
    if verdict.severity == "error":
        raise typer.Exit(1)


def _stated(records: Records, given: set[str]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Standard deviations (m, rad) of a trajectory; zero where it states none, or other ones are `given`."""
    sigma_m, sigma_deg = np.nan_to_num(records.sigma_m), np.nan_to_num(records.sigma_deg)
    if "sigma_position_m" in given:
        sigma_m = np.zeros_like(sigma_m)
    # Of roll, pitch and yaw.
    known = [name not in given for name in ("sigma_attitude_deg", "sigma_attitude_deg", "sigma_heading_deg")]
    return sigma_m, np.deg2rad(sigma_deg * known)


class Gaps:
    """The gaps of strips before and after, of a cloud that passes in parts.

    Their maps lie in the cloud's own system, or where that counts degrees in the frame of the block.
    """

    def __init__(self, placement: Placement, settings: StripSettings) -> None:
        self.settings = settings
        own = placement.system
        self._on_map = (lambda xyz: xyz) if own.geographic else placement.metres
        self.system = CoordinateSystem() if own.geographic else own
        """The system of the maps."""
        self._before, self._after = CellTally(settings), CellTally(settings)

    def add(self, part: Cloud, corrected: Float[np.ndarray, "n 3"]) -> None:
        """Returns as they were measured, and corrected (m)."""
        for look in looks_of(part, None, "line"):
            if len(look.returns):
                self._before.add(look.name, self._on_map(part.xyz[look.returns]))
                self._after.add(look.name, self._on_map(corrected[look.returns]))

    @property
    def maps(self) -> tuple[Raster, Raster] | None:
        """Before and after; None where strips have no planes in common."""
        of = [strip_differences(tally.strips.values(), self.settings) for tally in (self._before, self._after)]
        return None if of[0] is None or of[1] is None else (of[0], of[1])


def _about(records: Records, system: CoordinateSystem, cloud: Path) -> Frame:
    """The local frame about a trajectory in longitude and latitude. Raises InputError for a cloud without a system."""
    # Any system of the same datum will do for the frame: points come into it by their own.
    datum = None if system.plane is None else system.plane.geodetic_crs
    code = None if datum is None else datum.to_epsg()
    if code is None:
        raise InputError(
            f"{records.file}: the trajectory gives longitude and latitude, and {cloud.name} does not say in which EPSG "
            "system its coordinates are; name it (--cloud-epsg)"
        )
    longitude, latitude, height = records.coordinates[len(records.time) // 2].tolist()
    return Frame("epsg", code, origin=(longitude, latitude, height))


def _named(text: str | None) -> list[str]:
    """Names by commas."""
    return [part.strip() for part in (text or "").split(",") if part.strip()]


def _about_where(block: Block) -> Float[np.ndarray, "points 3"]:
    """Where tie points are, about."""
    return np.asarray(approximate(block).points)[tie_points(block)]


def _seen_by(coverage: CoveredTimes | None, parts: Callable[[], Iterator[Cloud]]) -> Callable[[], Iterator[Cloud]]:
    """`parts`, of each of which `coverage` sees the times."""

    def seen() -> Iterator[Cloud]:
        for part in parts():
            if coverage is not None:
                coverage.add(part)
            yield part

    return seen


def _check_known(part: Cloud, result: StripAdjustment) -> None:
    """Raise InputError for a strip that has no returns of those looked at."""
    assert part.strip is not None
    for k in part.strip[part.strip >= len(result.cloud.strips)][:1]:
        raise InputError(
            f"strip {part.strips[k]} has no points of these classes and returns: take others, or leave it out"
        )
