"""Commands for point clouds."""

import time
import warnings
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Option

from jaxphoto_command import options as opt
from jaxphoto_command.application import command
from jaxphoto_command.output import Output, Progress

if TYPE_CHECKING:
    import numpy as np

    from jaxphoto.block import Frame
    from jaxphoto.cloud import Cloud
    from jaxphoto.georeferencing import Trajectory
    from jaxphoto.io.clouds import Placement
    from jaxphoto.io.trajectory import Records
    from jaxphoto.procedures.control import SurveyedPoints
    from jaxphoto.procedures.lidar import ScannerPriors

PANEL = "Lidar"
_EXAMPLE = "jaxphoto example lidar && "
SCANNER = ("boresight", "lever-arm", "range-offset", "range-scale", "angle-scale", "eccentricity", "time-offset")
"""Scanner parameters that may be estimated."""

SigmaZ = Annotated[float, Option(callback=opt.positive, help="Standard deviation of a laser point in Z.")]
SigmaXY = Annotated[float, Option(help="Standard deviation of a laser point in X and in Y.")]
Systematic = Annotated[float, Option(help="Standard deviation of an error common to all heights.")]
MaxRounds = Annotated[int, Option(min=1, help="Maximum number of outer iterations (surface lookup, adjustment).")]
TrajectoryFile = Annotated[
    Path | None, Option(help="Trajectory of the scanner (docs/georeferencing.md), on the clock of the cloud.")
]
TrajectoryShift = Annotated[float, Option(callback=opt.finite, help="Trajectory time minus point cloud time.")]


def _sigma(help: str) -> Any:
    return Annotated[float | None, Option(callback=opt.positive, help=f"Standard deviation of {help}.")]


@command("lidar-control", PANEL, f"{_EXAMPLE}jaxphoto lidar-control lidar lidar/cloud.laz --out with_heights")
def lidar_control(
    output: Output,
    block: opt.Block,
    cloud: opt.Cloud,
    out: opt.BlockOut,
    method: Annotated[
        Literal["plane", "local", "image"], Option(help="Interpolation of heights between laser points.")
    ] = "plane",
    sigma_z_m: SigmaZ = 0.15,
    sigma_xy_m: SigmaXY = 0.5,
    sigma_systematic_m: Systematic = 0.0,
    classes: opt.Classes = None,
    returns: opt.Returns = "all",
    cloud_epsg: opt.CloudEpsg = None,
    max_rounds: MaxRounds = 20,
) -> None:
    """Add the heights of laser points at tie points as control, and write the block."""
    import numpy as np

    from jaxphoto.io.block_folder import whole_block
    from jaxphoto.lidar import HeightSettings
    from jaxphoto.procedures.lidar import lidar_control
    from jaxphoto.procedures.lidar.vertical_control import flag_counts
    from jaxphoto.report.lidar import heights_page, heights_table, print_control, rounds_table
    from jaxphoto.writing import check_folder

    settings = HeightSettings(sigma_z_m=sigma_z_m, sigma_xy_m=sigma_xy_m, sigma_systematic_m=sigma_systematic_m)
    check_folder(out, block, cloud)
    with output.progress("reading the block") as progress:
        read, points = _block_and_cloud(block, cloud, opt.selection(classes, returns, cloud_epsg), progress)
        report = _report_rounds(progress)
        result = lidar_control(read, points, method, settings, max_rounds=max_rounds, report=report)
        progress.update(f"writing {out}")
        heights, rounds = heights_table(result), rounds_table(result.rounds)
        page = heights_page(result, read.start.unknowns, output.command_record(block, cloud))
        with whole_block(result.block, out) as folder:
            heights.to_csv(folder / "lidar_heights.csv", index=False)
            rounds.to_csv(folder / "lidar_rounds.csv", index=False)
            (folder / "report.html").write_text(page, encoding="utf-8")
    print_control(result, read.start.unknowns, output.screen)
    rejected = flag_counts(result.flag[~np.isfinite(result.height)]).items()
    note = f" (rejected: {', '.join(f'{name.lower()} {n}' for name, n in rejected)})" if rejected else ""
    used = int(result.used.sum())
    output.wrote(out, f"wrote {out}: {used} of {len(result.points)} tie points have a control height{note}")
    output.add(n_control_heights=used, n_tie_points=len(result.points))
    _end_of_rounds(output, result)


@command("roof-control", PANEL, f"{_EXAMPLE}jaxphoto roof-control lidar lidar/cloud.laz --out with_roofs")
def roof_control(
    output: Output,
    block: opt.Block,
    cloud: opt.Cloud,
    out: opt.BlockOut,
    centroids: Annotated[str | None, Option(help="Points at centroids of roof faces, comma-separated.")] = None,
    sigma_z_m: SigmaZ = 0.15,
    sigma_xy_m: SigmaXY = 0.5,
    classes: opt.Classes = None,
    returns: opt.Returns = "all",
    cloud_epsg: opt.CloudEpsg = None,
    max_rounds: MaxRounds = 20,
) -> None:
    """Constrain tie points to roof planes, and roof centroids in X, Y and Z; write the block."""
    from jaxphoto.io import write_block
    from jaxphoto.lidar import HeightSettings
    from jaxphoto.procedures.lidar import roof_control
    from jaxphoto.report.lidar import print_control
    from jaxphoto.writing import check_folder

    settings = HeightSettings(sigma_z_m=sigma_z_m, sigma_xy_m=sigma_xy_m, sigma_systematic_m=0.0)
    check_folder(out, block, cloud)
    with output.progress("reading the block") as progress:
        read, points = _block_and_cloud(block, cloud, opt.selection(classes, returns, cloud_epsg), progress)
        options: dict[str, Any] = {"max_rounds": max_rounds, "report": _report_rounds(progress)}
        result = roof_control(read, points, settings, centroids=opt.names(centroids), **options)
        progress.update(f"writing {out}")
        write_block(result.block, out)
    print_control(result, read.start.unknowns, output.screen)
    output.wrote(out, f"wrote {out}: {len(result.points)} tie points lie on {result.faces} roof faces")
    output.add(n_tie_points=len(result.points), n_roof_faces=result.faces)
    _end_of_rounds(output, result)


@command(
    "simultaneous",
    PANEL,
    f"{_EXAMPLE}jaxphoto simultaneous lidar lidar/cloud.laz --trajectory lidar/trajectory.csv --out both",
)
def simultaneous(
    output: Output,
    block: opt.Block,
    cloud: opt.Cloud,
    out: opt.Out,
    trajectory: TrajectoryFile = None,
    trajectory_shift_s: TrajectoryShift = 0.0,
    boresight: Annotated[
        str | None,
        Option(help="Boresight of the scanner: free (default with a trajectory), fixed, or its sigma in degrees."),
    ] = None,
    shift: Annotated[str, Option(help="Shift of each lidar strip: free, fixed, or its sigma in m.")] = "0.3",
    method: Annotated[Literal["local", "plane"], Option(help="Surface model.")] = "local",
    sigma_z_m: SigmaZ = 0.15,
    sigma_xy_m: SigmaXY = 0.5,
    sigma_systematic_m: Systematic = 0.0,
    classes: opt.Classes = None,
    returns: opt.Returns = "all",
    cloud_epsg: opt.CloudEpsg = None,
    max_rounds: MaxRounds = 20,
) -> None:
    """Adjust a block and a point cloud together; write results, corrected cloud and corrected trajectory.

    --class and --returns select the points of the surface; the whole cloud is corrected. Exit code 1: results written,
    but not converged.
    """
    import numpy as np

    from jaxphoto.georeferencing import Scanner
    from jaxphoto.io import clouds, read_block
    from jaxphoto.io.trajectory import trajectory_in, with_positions, write_moved
    from jaxphoto.lidar import HeightSettings
    from jaxphoto.lidar.correction import correct_cloud, scanner_path
    from jaxphoto.procedures.lidar import simultaneous
    from jaxphoto.report.lidar import print_simultaneous, write_simultaneous
    from jaxphoto.report.tables import Tables
    from jaxphoto.report.verdict import verdict_of
    from jaxphoto.writing import check_folder

    settings = HeightSettings(sigma_z_m=sigma_z_m, sigma_xy_m=sigma_xy_m, sigma_systematic_m=sigma_systematic_m)
    if trajectory is None and boresight not in (None, "fixed"):
        raise typer.BadParameter(f"--boresight {boresight} needs --trajectory.")
    rotation = _prior("--boresight", boresight or ("fixed" if trajectory is None else "free"), np.pi / 180)
    translation = _prior("--shift", shift, 1.0)
    check_folder(out, *(path for path in (block, cloud, trajectory) if path is not None))
    start = time.perf_counter()
    with output.progress("reading the block") as progress:
        read = read_block(block)
        records = path = None
        if trajectory is not None:
            records = _cloud_records(trajectory, trajectory_shift_s)
            exact = np.zeros((len(records.time), 3))
            path = trajectory_in(records, read.frame, exact, exact)
        progress.update("reading the cloud")
        surface = clouds.read_cloud(cloud, read.frame, **opt.selection(classes, returns, cloud_epsg))
        seconds = {"read": time.perf_counter() - start}
        priors = Scanner(rotation, dict.fromkeys(surface.strips or ("cloud",), translation))
        report = _report_rounds(progress)
        options: dict[str, Any] = {"method": method, "settings": settings, "max_rounds": max_rounds, "report": report}
        result = simultaneous(read, surface, path, priors, **options)
        progress.update(f"writing {out}")
        track = None if path is None else scanner_path(path)
        tables, record = Tables(result.adjusted), output.command_record(block, cloud, trajectory)
        verdict = verdict_of(tables)
        with write_simultaneous(result, tables, verdict, out, seconds, record) as folder:
            strips = tuple(result.scanner.shifts)
            corrected = lambda part: correct_cloud(part, result.scanner, track).xyz  # noqa: E731
            write_corrected(cloud, folder, corrected, strips, path, read.frame, cloud_epsg)
            if trajectory is not None and records is not None and result.trajectory is not None:
                moved = with_positions(records, np.asarray(result.trajectory.position), read.frame)
                write_moved(moved._replace(time=moved.time + trajectory_shift_s), trajectory, folder)
    print_simultaneous(result, tables, verdict, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
    if not result.converged:
        raise typer.Exit(1)


@command(
    "strips",
    PANEL,
    "jaxphoto example strips && "
    "jaxphoto strips strips/cloud.laz --trajectory strips/trajectory.csv --cell-m 8 --out fitted",
)
def strips(
    output: Output,
    cloud: opt.Cloud,
    out: opt.Out,
    trajectory: TrajectoryFile = None,
    trajectory_shift_s: TrajectoryShift = 0.0,
    adjust: Annotated[
        str | None,
        Option(
            help=f"Scanner parameters to estimate, comma-separated: {', '.join(SCANNER)}; or none (default: boresight)."
        ),
    ] = None,
    pattern: Annotated[
        Literal["line", "circle"] | None, Option(help="Scan pattern on the ground (default: line).")
    ] = None,
    block: Annotated[
        Path | None, Option(help="Block folder of photographs on this trajectory, to adjust with the strips.")
    ] = None,
    exposure_shift_s: Annotated[
        float, Option(callback=opt.finite, help="Point cloud time minus time_s of images.csv.")
    ] = 0.0,
    control: Annotated[Path | None, Option(help="Surveyed points on smooth surfaces (docs/control.md).")] = None,
    hold: Annotated[str, Option(help="Strips with a fixed trajectory, comma-separated.")] = "",
    cell_m: Annotated[float, Option(callback=opt.positive, help="Cell size of the plane search.")] = 3.0,
    roughness_m: Annotated[
        float, Option(callback=opt.positive, help="Maximum scatter of the returns of a plane.")
    ] = 0.06,
    most_planes: Annotated[int, Option(min=1, help="Maximum number of observed planes.")] = 4000,
    knots_s: Annotated[float, Option(callback=opt.positive, help="Knot spacing of the trajectory errors.")] = 10.0,
    correlation_s: Annotated[
        float, Option(callback=opt.positive, help="Correlation time of the trajectory errors.")
    ] = 100.0,
    sigma_position_m: _sigma("positions (default: from the trajectory, or 0.08)") = None,  # type: ignore[valid-type]
    sigma_attitude_deg: _sigma("roll, pitch (default: from the trajectory, or 0.005)") = None,  # type: ignore[valid-type]
    sigma_heading_deg: _sigma("heading (default: from the trajectory, or 0.01)") = None,  # type: ignore[valid-type]
    sigma_exposure_m: _sigma("exposure positions, in addition") = 0.01,  # type: ignore[valid-type]
    sigma_exposure_deg: _sigma("exposure attitudes, in addition") = 0.002,  # type: ignore[valid-type]
    classes: opt.Classes = None,
    returns: opt.Returns = "all",
    cloud_epsg: opt.CloudEpsg = None,
    max_rounds: MaxRounds = 10,
) -> None:
    """Fit the strips of a point cloud to each other; write errors, corrected cloud and corrected trajectory.

    With --block, the photographs of the flight are also adjusted: trajectory, scanner and camera simultaneously. With
    --control, surveyed points define the datum.

    --class and --returns select the points of the planes; the whole cloud is corrected. Exit code 1: results written,
    but the verdict is red, or not converged.
    """
    import numpy as np

    from jaxphoto.block import Frame
    from jaxphoto.io import clouds, read_block, write_block
    from jaxphoto.io.block_folder import exposure_times
    from jaxphoto.io.trajectory import trajectory_in, with_poses, write_moved
    from jaxphoto.lidar.correction import correct_strips, scanner_path
    from jaxphoto.lidar.strip_planes import StripSettings, strip_differences
    from jaxphoto.procedures.lidar import Photographs, StripRound, adjust_strips
    from jaxphoto.procedures.lidar.iterate_to_convergence import at_result
    from jaxphoto.report.strips import print_strips, strips_verdict, write_strips
    from jaxphoto.report.tables import Tables
    from jaxphoto.writing import check_folder

    sigmas = {
        "sigma_position_m": sigma_position_m,
        "sigma_attitude_deg": sigma_attitude_deg,
        "sigma_heading_deg": sigma_heading_deg,
    }
    stated: dict[str, Any] = {name: sigma for name, sigma in sigmas.items() if sigma is not None}
    settings = StripSettings(
        cell_m=cell_m, roughness_m=roughness_m, most=most_planes, knots_s=knots_s, correlation_s=correlation_s,
        sigma_exposure_m=sigma_exposure_m, sigma_exposure_deg=sigma_exposure_deg, **stated,
    )  # fmt: skip
    priors = None
    if adjust is not None or pattern is not None:
        free = set() if adjust == "none" else set(opt.names(adjust or "boresight")) or {","}
        for name in free - set(SCANNER):
            raise typer.BadParameter(f"--adjust {name!r}: choose from {', '.join(SCANNER)}.")
        priors = scanner_priors(free, pattern)
    check_folder(out, cloud, *(path for path in (trajectory, block, control) if path is not None))
    with output.progress("reading the cloud") as progress:
        photographs, frame, records, path = None, None, None, None
        if block is not None:
            read = read_block(block)
            photographs, frame = Photographs(read, exposure_times(block) + exposure_shift_s), read.frame
        if trajectory is not None:
            records = _cloud_records(trajectory, trajectory_shift_s)
            if records.geographic and frame is None:
                frame = _frame_at(records, cloud, cloud_epsg)
            # Standard deviations that are unknown or overridden are zero; roll, pitch, yaw.
            kept = [name not in stated for name in ("sigma_attitude_deg", "sigma_attitude_deg", "sigma_heading_deg")]
            sigma_m = np.nan_to_num(records.sigma_m) * ("sigma_position_m" not in stated)
            sigma_rad = np.deg2rad(np.nan_to_num(records.sigma_deg) * kept)
            path = trajectory_in(records, frame or Frame(), sigma_m, sigma_rad)
        surveyed = None
        if control is not None:
            surveyed = _control_in_frame(control, clouds.cloud_placement(cloud, frame, cloud_epsg))
        measured = clouds.read_cloud(cloud, frame, **opt.selection(classes, returns, cloud_epsg))

        def report(iteration: StripRound) -> None:
            before = f", rms difference of strips {iteration.rms_m:.3f} m before" if iteration.planes else ""
            line = f"iteration {iteration.number}: {iteration.planes} planes{before}"
            progress.update(f"{line}; largest change {iteration.largest_change:.2g} standard deviations")

        progress.update("adjusting for the first iteration")
        result = adjust_strips(
            measured, path, settings, priors, photographs=photographs, control=surveyed, fixed=opt.names(hold),
            max_rounds=max_rounds, report=report,
        )  # fmt: skip
        progress.update(f"writing {out}")
        tables = None if photographs is None else Tables(result.adjusted, known=result.covariance)
        verdict = strips_verdict(result, tables)
        track = None if path is None else scanner_path(path)

        def write_files(folder: Path) -> None:
            corrected = lambda part: correct_strips(part, result.errors, track).xyz  # noqa: E731
            write_corrected(cloud, folder, corrected, result.cloud.strips, path, frame, cloud_epsg)
            if trajectory is not None and records is not None and result.trajectory is not None:
                moved = with_poses(records, result.trajectory, frame or Frame())
                write_moved(moved._replace(time=moved.time + trajectory_shift_s), trajectory, folder)
            if photographs is not None:
                write_block(at_result(result.adjusted.block, result.adjusted.unknowns), folder / "block")

        gaps = strip_differences(measured, settings), strip_differences(result.cloud, settings)
        record = output.command_record(cloud, trajectory, block, control)
        write_strips(result, tables, verdict, gaps, out, write_files, record)
    print_strips(result, verdict, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
    if verdict.severity == "error":
        raise typer.Exit(1)


def scanner_priors(free: Collection[str], pattern: str | None) -> "ScannerPriors":
    """Return priors with the scanner parameters `free` FREE and all others FIXED."""
    from jaxphoto.georeferencing import ScannerCalibration
    from jaxphoto.procedures.lidar import ScannerPriors
    from jaxphoto.unknowns import FIXED, FREE

    boresight, *calibration = (FREE if name in free else FIXED for name in SCANNER)
    return ScannerPriors(boresight, ScannerCalibration(*calibration, pattern or "line"))  # type: ignore[arg-type, call-arg]


def write_corrected(
    cloud: Path,
    folder: Path,
    corrected: "Callable[[Cloud], np.ndarray]",
    strips: Sequence[str],
    trajectory: "Trajectory | None",
    frame: "Frame | None",
    epsg: int | None = None,
) -> None:
    """Write `cloud` with the coordinates `corrected` of each part; strips are numbered as in `strips`.

    Withheld points of other strips, or at times without trajectory, are not corrected; a UserWarning contains their
    number. Raises InputError for other points of other strips.
    """
    import numpy as np

    from jaxphoto.errors import InputError, counted
    from jaxphoto.io import clouds
    from jaxphoto.lidar.correction import covers

    def moved(part: "Cloud") -> np.ndarray:
        part = part.numbered(strips)
        usable = np.isfinite(part.xyz).all(axis=1)
        if part.strip is not None and part.strips:
            usable &= part.strip < len(strips)
        if trajectory is not None and part.time is not None and part.withheld is not None:
            usable &= ~part.withheld | covers(trajectory, part.time)
        used = usable if part.withheld is None else usable | ~part.withheld
        for k in part.strip[used & ~usable][:1] if part.strip is not None else ():
            raise InputError(
                f"strip {part.strips[k]} has no points of these classes and returns: choose others, or remove the strip"
            )
        xyz = np.full(part.xyz.shape, np.nan)
        xyz[used] = corrected(part.take(used))
        return xyz

    name = cloud.name if cloud.suffix.lower() in (".las", ".laz") else f"corrected_{cloud.name}"
    uncorrected = clouds.rewrite_cloud(cloud, folder / name, moved, frame=frame, epsg=epsg)
    if uncorrected:
        warnings.warn(
            f"{cloud.name}: {counted(uncorrected, 'point')} marked as withheld cannot be corrected (strip without "
            "others, no trajectory records, or outside the coordinate system) and are unchanged",
            stacklevel=2,
        )


def _cloud_records(trajectory: Path, shift_s: float) -> "Records":
    """Read a trajectory and convert its times to the clock of the cloud."""
    from jaxphoto.io.trajectory import read_records

    records = read_records(trajectory)
    return records._replace(time=records.time - shift_s)


def _frame_at(records: "Records", cloud: Path, epsg: int | None) -> "Frame":
    """Return a local frame at the middle of a geographic trajectory."""
    from jaxphoto.block import Frame
    from jaxphoto.errors import InputError
    from jaxphoto.io import clouds

    # Any system of the same datum suffices: points are transformed from their own system.
    crs = clouds.cloud_system(cloud, epsg)
    datum = None if crs is None else crs.geodetic_crs
    code = None if datum is None else datum.to_2d().to_epsg()
    if code is None:
        raise InputError(
            f"{records.file}: the trajectory is in longitude and latitude, and {cloud.name} has no EPSG code; give it "
            "(--cloud-epsg)"
        )
    longitude, latitude, height = records.coordinates[len(records.time) // 2].tolist()
    return Frame("epsg", code, origin=(longitude, latitude, height))


def _control_in_frame(path: Path, placement: "Placement") -> "SurveyedPoints":
    """Read surveyed points in the coordinate system of the cloud, in metres, and transform them to its frame.

    Raises InputError for points in a different system, without heights or sigmas, or outside the system. Warns that
    image measurements are not used.
    """
    import numpy as np

    from jaxphoto.errors import InputError
    from jaxphoto.extras.formats import read_control
    from jaxphoto.procedures.control.surveyed import system_of
    from jaxphoto.procedures.lidar.strip_control import check_complete

    points, marks = read_control(path)
    if len(marks.image):
        warnings.warn(
            f"{points.file}: its {len(marks.image)} image measurements are not used: add them to the block",
            UserWarning,
            stacklevel=2,
        )
    plane, heights = placement.plane, placement.vertical
    if points.system:
        stated = system_of(points.system, points.file)
        other = stated.crs is not None and plane is not None and not plane.equals(stated.crs, ignore_axis_order=True)
        above = stated.vertical is not None and isinstance(heights, int) and heights != stated.vertical
        if other or above or (stated.crs is None) != (plane is None):
            raise InputError(
                f"{points.file} is in {stated.name}, and {placement.name} in {placement.system}: give the control in "
                "the system of the cloud"
            )
    check_complete(points)
    xyz = points.coordinates
    if points.own_axes and plane is not None and plane.axis_info[0].direction == "north":
        xyz = xyz[:, [1, 0, 2]]
    placed = placement.frame(xyz / placement.factors)
    for k in np.flatnonzero(~np.isfinite(placed).all(axis=1)):
        raise InputError(
            f"{points.places[k]}: point {points.ids[k]} lies outside {placement.system}; correct its coordinates, "
            "easting first, or give the control in the system of the cloud"
        )
    return points._replace(coordinates=placed)


def _prior(option: str, text: str, unit: float) -> Any:
    """Return FREE, FIXED, or a prior of zero with the given standard deviation."""
    import numpy as np

    from jaxphoto.unknowns import FIXED, FREE, Weighted

    if text in ("free", "fixed"):
        return FREE if text == "free" else FIXED
    try:
        sigma = float(text)
    except ValueError:
        sigma = 0.0
    if not 0 < sigma < np.inf:
        raise typer.BadParameter(f"{option} {text}: give free, fixed, or a standard deviation.")
    return Weighted(np.zeros(3), np.full(3, sigma * unit))


def _block_and_cloud(block: Path, cloud: Path, selection: dict[str, Any], progress: Progress) -> tuple[Any, Any]:
    """Read a block, and the part of the cloud near its points."""
    import numpy as np

    from jaxphoto.initial.approximate import approximate
    from jaxphoto.io import clouds, read_block

    read = read_block(block)
    progress.update("reading the cloud")
    xy = np.asarray(approximate(read).points)[:, :2]
    low, high = xy.min(axis=0), xy.max(axis=0)
    # Allow for errors of the approximate points: 100 m plus a tenth of the block.
    margin = 100.0 + 0.1 * (high - low)
    return read, clouds.read_cloud(cloud, read.frame, within=np.stack([low - margin, high + margin]), **selection)


def _report_rounds(progress: Progress) -> Any:
    """Return a function that displays each outer iteration."""
    progress.update("adjusting for the first iteration")

    def report(iteration: Any) -> None:
        line = f"iteration {iteration.number}: {iteration.observed} observations, RMSE {iteration.rmse_m:.3f} m"
        progress.update(f"{line}, largest change {iteration.largest_change:.2g} standard deviations")

    return report


def _end_of_rounds(output: Output, result: Any) -> None:
    """Report the outer iterations; exit code 1 without convergence."""
    output.add(rounds=len(result.rounds), iteration_converged=result.converged, rmse_m=result.rounds[-1].rmse_m)
    if not result.converged:
        raise typer.Exit(1)
