"""`jaxphoto strips`: from a cloud of several strips and its trajectory, both without what they are off by."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from jaxtyping import Float

from jaxphoto.block import Block, Frame
from jaxphoto.cli.app import app
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.cloud_options import Classes, CloudEpsg, CloudUnit, ReturnsOption, class_numbers, corrected_name
from jaxphoto.cli.cloud_progress import CloudProgress
from jaxphoto.cli.console import plain_console
from jaxphoto.cli.made import made_by
from jaxphoto.cli.progress import StepsLeft
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import PATTERNS, ScannerCalibration
from jaxphoto.io import clouds, read_block
from jaxphoto.io.block_folder import exposure_times
from jaxphoto.io.clouds.coordinate_system import CoordinateSystem
from jaxphoto.io.clouds.placement import Placement
from jaxphoto.io.raster import write_dsm
from jaxphoto.io.trajectory import Records, read_records, write_moved
from jaxphoto.io.trajectory.in_frame import trajectory_in, with_poses
from jaxphoto.lidar.cell_returns import CellTally
from jaxphoto.lidar.correction import scanner_path
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
from jaxphoto.procedures.lidar.strip_adjustment import MAX_STRIP_ROUNDS
from jaxphoto.procedures.lidar.vertical_control import tie_points
from jaxphoto.report.findings import Level
from jaxphoto.report.strips import print_strips, strips_verdict
from jaxphoto.report.strips_folder import write_strips
from jaxphoto.report.tables import Tables
from jaxphoto.report.terminal import print_verdict
from jaxphoto.unknowns import FIXED, FREE
from jaxphoto.writing import check_folder

_USUAL = StripSettings()
_SCANNER = ("boresight", *(name.replace("_", "-") for name in dynamic_fields(ScannerCalibration)))


@app.command("strips")
def strips_command(
    context: typer.Context,
    cloud: Annotated[Path, typer.Argument(help="Cloud of several strips: .las, .laz, .csv or .ply (docs/clouds.md).")],
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Trajectory of the scanner (docs/trajectory.md), on the cloud's clock, in its system."),
    ] = None,
    trajectory_shift_s: Annotated[float, typer.Option(help="Cloud's time + this is the trajectory's.")] = 0.0,
    adjust: Annotated[
        str | None,
        typer.Option(help=f"What of the scanner is estimated, by commas: {', '.join(_SCANNER)} (boresight); or none."),
    ] = None,
    pattern: Annotated[
        str | None,
        one_of(PATTERNS, help="Of the scanner: line by line across the track (default), or circle, all around."),
    ] = None,
    block: Annotated[
        Path | None,
        typer.Option(help="Block folder of photographs taken on this trajectory, which are adjusted with the strips."),
    ] = None,
    exposure_shift_s: Annotated[float, typer.Option(help="time_s of images.csv + this is the cloud's time.")] = 0.0,
    hold: Annotated[str, typer.Option(help="Strips whose trajectory is right, by commas.")] = "",
    cell_m: Annotated[float, typer.Option(help="Side of the cells in which planes are sought.")] = _USUAL.cell_m,
    roughness_m: Annotated[
        float, typer.Option(help="Most that the returns of a plane scatter about it.")
    ] = _USUAL.roughness_m,
    most_planes: Annotated[int, typer.Option(min=1, help="Most planes that are observed.")] = _USUAL.most,
    knots_s: Annotated[float, typer.Option(help="From knot to knot of the trajectory's errors.")] = _USUAL.knots_s,
    correlation_s: Annotated[float, typer.Option(help="Correlation time of these errors.")] = _USUAL.correlation_s,
    sigma_position_m: Annotated[float, typer.Option(help="Their standard deviation.")] = _USUAL.sigma_position_m,
    sigma_attitude_deg: Annotated[
        float, typer.Option(help="That about right and forward.")
    ] = _USUAL.sigma_attitude_deg,
    sigma_heading_deg: Annotated[float, typer.Option(help="That about up.")] = _USUAL.sigma_heading_deg,
    sigma_exposure_m: Annotated[
        float, typer.Option(help="What stations of photographs are off by besides.")
    ] = _USUAL.sigma_exposure_m,
    sigma_exposure_deg: Annotated[
        float, typer.Option(help="What their attitudes are off by besides.")
    ] = _USUAL.sigma_exposure_deg,
    classes: Classes = None,
    returns: ReturnsOption = "all",
    cloud_epsg: CloudEpsg = None,
    cloud_unit: CloudUnit = None,
    max_rounds: Annotated[int, typer.Option(min=1, help="Most rounds of search and adjustment.")] = MAX_STRIP_ROUNDS,
) -> None:
    """Fit the strips of a cloud to each other; write the corrected cloud and trajectory, and what was wrong.

    With --block the photographs of the flight, too: trajectory, scanner and camera at once.

    --class and --returns choose the points of the planes; the whole cloud is corrected. Exit code 1: written, but
    the verdict is red, as where it still changes.
    """
    settings = StripSettings(
        cell_m=cell_m,
        roughness_m=roughness_m,
        most=most_planes,
        knots_s=knots_s,
        correlation_s=correlation_s,
        sigma_position_m=sigma_position_m,
        sigma_attitude_deg=sigma_attitude_deg,
        sigma_heading_deg=sigma_heading_deg,
        sigma_exposure_m=sigma_exposure_m,
        sigma_exposure_deg=sigma_exposure_deg,
    )
    priors, chosen, errors = _priors(adjust, pattern), class_numbers(classes), plain_console(stderr=True)
    held = [name.strip() for name in hold.split(",") if name.strip()]
    check_folder(out, cloud, *(path for path in (trajectory, block) if path is not None))
    with errors.status("reading the cloud") as status:
        photographs, frame = None, Frame()
        if block is not None:
            photographs = Photographs(read_block(block), exposure_times(block) + exposure_shift_s)
            frame = photographs.block.frame
        records = path = None
        if trajectory is not None:
            # On the cloud's clock from here on.
            records = read_records(trajectory)
            records = records._replace(time=records.time - trajectory_shift_s)
            if records.geographic and block is None:
                frame = _about(records, clouds.cloud_system(cloud, epsg=cloud_epsg, unit=cloud_unit), cloud)
            exact = np.zeros((len(records.time), 3))
            path = trajectory_in(records, frame, exact, exact)
        said: dict[str, Any] = {"epsg": cloud_epsg, "unit": cloud_unit}
        own = frame if block is not None or frame.kind == "epsg" else None
        track = None if path is None else scanner_path(path)
        parts = partial(clouds.cloud_chunks, cloud, own, classes=chosen, returns=returns, **said)  # type: ignore[arg-type]
        # Of a file that is filtered nobody knows how much will come.
        every = chosen is None and returns == "all"
        progress = CloudProgress(StepsLeft(errors, status), status, clouds.most_points(cloud) if every else None)
        looked_at = kept_returns(
            progress.passes(parts),
            settings,
            track,
            "line" if priors is None else priors.calibration.pattern,
            None if photographs is None else partial(_about_where, photographs.block),
        )

        def report(made: StripRound) -> None:
            line = f"round {made.number}: {made.planes} planes, strips {made.rms_m:.3f} m apart before"
            status.update(f"{line}; largest change {made.largest_change:.2g} standard deviations")

        options: dict[str, Any] = {"held": held, "max_rounds": max_rounds, "report": report}
        result = adjust_strips(looked_at, path, settings, priors, photographs=photographs, **options)
        status.update(f"writing {out}")
        gaps = Gaps(Placement(cloud.name, clouds.cloud_system(cloud, **said), own), settings)
        tables = None if photographs is None else Tables(result.adjusted, known=result.covariance)
        made, verdict = made_by(context, cloud, trajectory, block), strips_verdict(result, tables)

        def moved(part: Cloud) -> Float[np.ndarray, "n 3"]:
            progress("writing the corrected cloud", part)
            _check_known(part, result)
            corrected = correct_strips(part, result.errors, track).xyz
            seen = clouds.chosen_of(part, chosen, returns, cloud.name)  # type: ignore[arg-type]
            gaps.add(part.take(seen), corrected[seen])
            return corrected

        def write_corrected(folder: Path) -> tuple[Raster, Raster] | None:
            progress.begins()
            clouds.rewrite_cloud(cloud, folder / corrected_name(cloud), moved, frame=own, **said)
            if trajectory is not None and records is not None and result.trajectory is not None:
                back = with_poses(records, result.trajectory, frame)
                write_moved(back._replace(time=back.time + trajectory_shift_s), trajectory, folder)
            maps = gaps.maps
            for raster, name in zip(maps or (), ("before", "after"), strict=False):
                write_dsm(folder / f"differences_{name}.tif", raster, gaps.system)
            return maps

        write_strips(result, tables, verdict, out, write_corrected, made)
    console = plain_console()
    print_verdict(verdict, console)
    print_strips(result, console)
    console.print(f"results in {out} (open report.html)")
    if verdict.level == Level.ALARM:
        raise typer.Exit(1)


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


def _about_where(block: Block) -> Float[np.ndarray, "points 3"]:
    """Where tie points are, about."""
    return np.asarray(approximate(block).points)[tie_points(block)]


def _check_known(part: Cloud, result: StripAdjustment) -> None:
    """Raise InputError for a strip that has no returns of those looked at."""
    for name in part.strips[len(result.cloud.strips) :]:
        raise InputError(f"strip {name} has no points of these classes and returns: take others, or leave it out")


def _priors(adjust: str | None, pattern: str | None) -> ScannerPriors | None:
    """FREE what `adjust` names of the scanner; None where nothing is said of it.

    Raises InputError for what a scanner does not have.
    """
    if adjust is None and pattern is None:
        return None
    text = "boresight" if adjust is None else adjust
    names = [] if text.strip() == "none" else [name.strip() for name in text.split(",")]
    for name in names:
        if name not in _SCANNER:
            raise InputError(f"--adjust {name}: a scanner has {', '.join(_SCANNER)}; name some of these, or none")
    boresight, *calibration = (FREE if name in names else FIXED for name in _SCANNER)
    return ScannerPriors(boresight, ScannerCalibration(*calibration, pattern or "line"))  # type: ignore[arg-type, call-arg]
