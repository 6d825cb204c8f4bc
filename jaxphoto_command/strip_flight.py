"""Adjustment of the strips of a flight, with or without photographs, from files to results."""

import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import typer
from jaxtyping import Float

from jaxphoto.block import Block, Frame
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError, counted
from jaxphoto.extras.formats import read_control
from jaxphoto.georeferencing import PATTERN_OF, ScannerCalibration, Trajectory
from jaxphoto.initial.approximate import approximate
from jaxphoto.io import clouds, read_block, write_block
from jaxphoto.io.block_folder import exposure_times
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem, Placement
from jaxphoto.io.raster import write_dsm
from jaxphoto.io.text_tables import points_matching
from jaxphoto.io.trajectory import Records, read_records, trajectory_in, with_poses, write_moved
from jaxphoto.lidar.correction import correct_strips, scanner_path
from jaxphoto.lidar.coverage import CoveredTimes
from jaxphoto.lidar.raster import Raster, strip_differences
from jaxphoto.lidar.strip_planes import CellTally, StripSettings
from jaxphoto.procedures.control import SurveyedPoints
from jaxphoto.procedures.control.surveyed import system_of
from jaxphoto.procedures.lidar import (
    Photographs,
    ScannerPriors,
    StripAdjustment,
    StripRound,
    adjust_strips,
    kept_returns,
)
from jaxphoto.procedures.lidar.iterate_to_convergence import at_result, fix_interior
from jaxphoto.procedures.lidar.strip_control import check_complete
from jaxphoto.procedures.lidar.strip_model import looks_of
from jaxphoto.procedures.lidar.vertical_control import tie_points
from jaxphoto.report.strips import print_strips, strips_verdict, write_strips
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_verdict
from jaxphoto.unknowns import FIXED, FREE
from jaxphoto.writing import check_folder
from jaxphoto_command.lidar import SCANNER
from jaxphoto_command.options import names
from jaxphoto_command.output import Output


class StripFiles(NamedTuple):
    """Files of a flight, and options for reading them."""

    cloud: Path
    trajectory: Path | None
    trajectory_shift_s: float
    block: Path | None
    """Block of the photographs."""
    exposure_shift_s: float
    classes: list[int] | None
    """Classes of the returns used for the plane search; all returns are corrected."""
    returns: str
    epsg: int | None
    unit: str | None
    control: Path | None = None
    """Surveyed points, in the coordinate system of the cloud."""
    breaklines: str | None = None
    """Comma-separated tie points on breaklines."""


class StripChoices(NamedTuple):
    """Parameters to adjust, and their settings."""

    settings: StripSettings
    stated: set[str]
    """Names of the standard deviations in `settings` that override those of the trajectory."""
    priors: ScannerPriors | None
    fixed_strips: list[str] | Literal["all"]
    """Strips with a fixed trajectory."""
    fixed_camera: bool
    """True if the interior orientation of the photographs is fixed."""
    max_rounds: int


def scanner_priors(free: Collection[str], pattern: str | None) -> ScannerPriors:
    """Return priors with the scanner parameters `free` FREE and all others FIXED."""
    boresight, *calibration = (FREE if name in free else FIXED for name in SCANNER)
    return ScannerPriors(boresight, ScannerCalibration(*calibration, PATTERN_OF[pattern or "line"]))  # type: ignore[arg-type, call-arg]


def adjust_flight(output: Output, flight: StripFiles, choices: StripChoices, out: Path) -> None:
    """Adjust the strips of a flight and its photographs, and write the results; exit code 1 if the verdict is red.

    The cloud is read in parts; only the returns on its planes are stored in memory.
    """
    cloud, trajectory, block = flight.cloud, flight.trajectory, flight.block
    if flight.breaklines is not None and block is None:
        raise InputError("--breaklines needs points of photographs: add their block (--block), or omit it")
    settings, priors = choices.settings, choices.priors
    check_folder(out, cloud, *(path for path in (trajectory, block, flight.control) if path is not None))
    with output.progress("reading the cloud") as progress:
        options: dict[str, Any] = {"epsg": flight.epsg, "unit": flight.unit}
        system = clouds.cloud_system(cloud, **options)
        photographs, frame, records, path = None, Frame(), None, None
        if block is not None:
            photographs = _photographs(block, flight, choices.fixed_camera)
            frame = photographs.block.frame
        if trajectory is not None:
            records = cloud_records(trajectory, flight.trajectory_shift_s)
            if records.geographic and block is None:
                frame = _frame_at(records, system, cloud)
            path = trajectory_in(records, frame, *_stated_sigmas(records, choices.stated))
        map_frame = frame if block is not None or frame.kind == "epsg" else None
        placement = Placement(cloud.name, system, map_frame)
        control = None if flight.control is None else control_in_frame(flight.control, placement)
        track = None if path is None else scanner_path(path)
        selection: dict[str, Any] = {"classes": flight.classes, "returns": flight.returns}
        parts = partial(clouds.cloud_chunks, cloud, map_frame, **selection, **options)
        # The number of points is unknown if a filter is applied.
        total = clouds.point_count(cloud) if flight.classes is None and flight.returns == "all" else None
        coverage = None if path is None else CoveredTimes(path)
        planes = kept_returns(
            _covered(coverage, progress.points("reading the cloud", parts, total)),
            settings,
            track,
            "line" if priors is None else priors.calibration.pattern,
            None if photographs is None else partial(_tie_points, photographs.block),
            None if control is None else control.coordinates,
        )
        if coverage is not None:
            coverage.check(flight.trajectory_shift_s)

        def report(iteration: StripRound) -> None:
            before = f", rms difference of strips {iteration.rms_m:.3f} m before" if iteration.planes else ""
            line = f"iteration {iteration.number}: {iteration.planes} planes{before}"
            progress.update(f"{line}; largest change {iteration.largest_change:.2g} standard deviations")

        progress.update("adjusting for the first iteration")
        result = adjust_strips(
            planes,
            path,
            settings,
            priors,
            photographs=photographs,
            control=control,
            fixed=choices.fixed_strips,
            max_rounds=choices.max_rounds,
            report=report,
        )
        progress.update(f"writing {out}")
        differences = Differences(placement, settings)
        tables = None if photographs is None else Tables(result.adjusted, known=result.covariance)
        verdict = strips_verdict(result, tables)

        def corrected(part: Cloud) -> Float[np.ndarray, "n 3"]:
            _check_strips(part, result)
            xyz = correct_strips(part, result.errors, track).xyz
            used = clouds.selection(part, flight.classes, flight.returns, cloud.name)  # type: ignore[arg-type]
            differences.add(part.take(used), xyz[used])
            return xyz

        def write_files(folder: Path) -> tuple[Raster, Raster] | None:
            write_corrected(cloud, folder, corrected, result.cloud.strips, path, map_frame, options)
            if trajectory is not None and records is not None and result.trajectory is not None:
                moved = with_poses(records, result.trajectory, frame)
                write_moved(moved._replace(time=moved.time + flight.trajectory_shift_s), trajectory, folder)
            if photographs is not None:
                write_block(at_result(result.adjusted.block, result.adjusted.unknowns), folder / "block")
            maps = differences.maps
            for raster, name in zip(maps or (), ("before", "after"), strict=False):
                write_dsm(folder / f"differences_{name}.tif", raster, differences.system)
            return maps

        record = output.command_record(cloud, trajectory, block, flight.control)
        write_strips(result, tables, verdict, out, write_files, record)
    print_verdict(verdict, output.screen)
    print_strips(result, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
    if verdict.severity == "error":
        raise typer.Exit(1)


def cloud_records(trajectory: Path, shift_s: float) -> Records:
    """Read a trajectory and convert its times to the clock of the cloud."""
    records = read_records(trajectory)
    return records._replace(time=records.time - shift_s)


def _photographs(block: Path, flight: StripFiles, fixed_camera: bool) -> Photographs:
    read, times = read_block(block), exposure_times(block) + flight.exposure_shift_s
    breaklines = points_matching(read.points, names(flight.breaklines), "--breaklines")
    return Photographs(fix_interior(read) if fixed_camera else read, times, breaklines)


def _stated_sigmas(records: Records, stated: set[str]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Return standard deviations (m, rad) of a trajectory; zero if unknown or overridden (`stated`)."""
    sigma_m, sigma_deg = np.nan_to_num(records.sigma_m), np.nan_to_num(records.sigma_deg)
    if "sigma_position_m" in stated:
        sigma_m = np.zeros_like(sigma_m)
    # Roll, pitch, yaw.
    kept = [name not in stated for name in ("sigma_attitude_deg", "sigma_attitude_deg", "sigma_heading_deg")]
    return sigma_m, np.deg2rad(sigma_deg * kept)


class Differences:
    """Maps of height differences between strips before and after correction; the cloud is read in parts.

    The maps are in the coordinate system of the cloud, or in the frame of the block if the former is geographic.
    """

    def __init__(self, placement: Placement, settings: StripSettings) -> None:
        self.settings = settings
        system = placement.system
        self._on_map = (lambda xyz: xyz) if system.geographic else placement.metres
        self.system = CoordinateSystem() if system.geographic else system
        """Coordinate system of the maps."""
        self._before, self._after = CellTally(settings), CellTally(settings)

    def add(self, part: Cloud, corrected: Float[np.ndarray, "n 3"]) -> None:
        """Add returns as measured and as corrected (m)."""
        for look in looks_of(part, None, "line"):
            if len(look.returns):
                self._before.add(look.name, self._on_map(part.xyz[look.returns]))
                self._after.add(look.name, self._on_map(corrected[look.returns]))

    @property
    def maps(self) -> tuple[Raster, Raster] | None:
        """Maps before and after correction; None if strips have no planes in common."""
        before, after = (strip_differences(t.strips.values(), self.settings) for t in (self._before, self._after))
        return None if before is None or after is None else (before, after)


def _frame_at(records: Records, system: CoordinateSystem, cloud: Path) -> Frame:
    """Return a local frame at the middle of a geographic trajectory."""
    # Any system of the same datum suffices: points are transformed from their own system.
    datum = None if system.plane is None else system.plane.geodetic_crs
    code = None if datum is None else datum.to_epsg()
    if code is None:
        raise InputError(
            f"{records.file}: the trajectory is in longitude and latitude, and {cloud.name} has no EPSG code; give it "
            "(--cloud-epsg)"
        )
    longitude, latitude, height = records.coordinates[len(records.time) // 2].tolist()
    return Frame("epsg", code, origin=(longitude, latitude, height))


def _tie_points(block: Block) -> Float[np.ndarray, "points 3"]:
    return np.asarray(approximate(block).points)[tie_points(block)]


def _covered(coverage: CoveredTimes | None, parts: Callable[[], Iterator[Cloud]]) -> Callable[[], Iterator[Cloud]]:
    """Return an iterator over `parts` that adds their times to `coverage`."""

    def covered() -> Iterator[Cloud]:
        for part in parts():
            if coverage is not None:
                coverage.add(part)
            yield part

    return covered


def _check_strips(part: Cloud, result: StripAdjustment) -> None:
    """Raise InputError for a strip without selected returns."""
    assert part.strip is not None
    for k in part.strip[part.strip >= len(result.cloud.strips)][:1]:
        raise InputError(
            f"strip {part.strips[k]} has no points of these classes and returns: choose others, or remove the strip"
        )


def write_corrected(
    cloud: Path,
    folder: Path,
    corrected: Callable[[Cloud], Float[np.ndarray, "n 3"]],
    strips: Sequence[str],
    trajectory: Trajectory | None,
    frame: Frame | None,
    system: dict[str, Any],
) -> None:
    """Write `cloud` with the coordinates `corrected` of each part; strips are numbered as in `strips`.

    Withheld points of other strips, or at times without trajectory, are not corrected; a UserWarning contains their
    number.
    """
    coverage = None if trajectory is None else CoveredTimes(trajectory)

    def moved(part: Cloud) -> Float[np.ndarray, "n 3"]:
        part = part.numbered(strips)
        if part.withheld is None or not part.withheld.any():
            return corrected(part)
        usable = np.ones(len(part), bool) if part.strip is None else part.strip < len(strips)
        if coverage is not None and part.time is not None:
            usable &= coverage.covers(part.time)
        rows = np.flatnonzero(usable | ~part.withheld)
        xyz = np.full(part.xyz.shape, np.nan)
        xyz[rows] = corrected(part.take(rows))
        return xyz

    name = cloud.name if cloud.suffix.lower() in (".las", ".laz") else f"corrected_{cloud.name}"
    uncorrected = clouds.rewrite_cloud(cloud, folder / name, moved, frame=frame, **system)
    if uncorrected:
        warnings.warn(
            f"{cloud.name}: {counted(uncorrected, 'point')} marked as withheld cannot be corrected (strip without "
            "others, no trajectory records, or outside the coordinate system) and are unchanged",
            stacklevel=2,
        )


def control_in_frame(path: Path, placement: Placement) -> SurveyedPoints:
    """Read surveyed points in the coordinate system of the cloud, and transform them to the frame of `placement`.

    Raises InputError for points in a different system, without heights or sigmas, or outside the system. Warns that
    image measurements are not used.
    """
    points, marks = read_control(path)
    if len(marks.image):
        warnings.warn(
            f"{points.file}: its {len(marks.image)} image measurements are not used: add them to the block",
            UserWarning,
            stacklevel=2,
        )
    plane, heights = placement.system.plane, placement.system.heights
    if points.system:
        stated = system_of(points.system, points.file)
        other = stated.crs is not None and plane is not None and not plane.equals(stated.crs, ignore_axis_order=True)
        above = stated.vertical is not None and isinstance(heights, int) and heights != stated.vertical
        if other or above or (stated.crs is None) != (plane is None):
            raise InputError(
                f"{points.file} is in {stated.name}, and {placement.name} in {placement.system.name}: give the control "
                "in the system of the cloud"
            )
    check_complete(points)
    xyz = points.coordinates
    if points.own_axes and plane is not None and plane.axis_info[0].direction == "north":
        xyz = xyz[:, [1, 0, 2]]
    placed = placement.frame_from_metres(xyz)
    for k in np.flatnonzero(~np.isfinite(placed).all(axis=1)):
        raise InputError(
            f"{points.places[k]}: point {points.ids[k]} lies outside {placement.system.name}; correct its coordinates, "
            "easting first, or give the control in the system of the cloud"
        )
    return points._replace(coordinates=placed)
