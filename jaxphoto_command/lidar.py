"""Commands for point clouds."""

import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option

from jaxphoto_command import options as opt
from jaxphoto_command.application import command
from jaxphoto_command.output import Output, Progress

PANEL = "Lidar"
_EXAMPLE = "jaxphoto example lidar && "
SCANNER = ("boresight", "lever-arm", "range-offset", "range-scale", "angle-scale", "eccentricity", "time-offset")
"""Scanner parameters that may be estimated."""

SigmaZ = Annotated[float, Option(callback=opt.positive, help="Standard deviation of a laser point in Z.")]
SigmaXY = Annotated[float, Option(help="Standard deviation of a laser point in X and in Y.")]
Systematic = Annotated[float, Option(help="Standard deviation of an error common to all heights.")]
MaxRounds = Annotated[int, Option(min=1, help="Maximum number of outer iterations (surface lookup, adjustment).")]
Trajectory = Annotated[
    Path | None, Option(help="Trajectory of the scanner (docs/georeferencing.md), on the clock of the cloud.")
]
TrajectoryShift = Annotated[float, Option(callback=opt.finite, help="Trajectory time minus point cloud time.")]
ExposureShift = Annotated[float, Option(callback=opt.finite, help="Point cloud time minus time_s of images.csv.")]
Control = Annotated[Path | None, Option(help="Surveyed points on smooth surfaces (docs/control.md).")]
Breaklines = Annotated[
    str | None, Option(help="Tie points on breaklines, comma-separated, * as wildcard (default: from block.toml).")
]
Pattern = Annotated[
    Literal["line", "circle", "oscillating", "rotating", "risley", "nutating"] | None,
    Option(help="Scan pattern (default: line)."),
]
CellSize = Annotated[float, Option(callback=opt.positive, help="Cell size of the plane search.")]
Roughness = Annotated[float, Option(callback=opt.positive, help="Maximum scatter of the returns of a plane.")]
KnotSpacing = Annotated[float, Option(callback=opt.positive, help="Knot spacing of the trajectory errors.")]
# Options of `simultaneous` that apply only without, and only with --adjust.
_SURFACE_OPTIONS = ("boresight", "shift", "method", "sigma_z_m", "sigma_xy_m", "sigma_systematic_m")
_PLANE_OPTIONS = ("exposure_shift_s", "control", "breaklines", "pattern", "cell_m", "roughness_m", "knots_s")


@command("lidar-control", PANEL, f"{_EXAMPLE}jaxphoto lidar-control lidar lidar/cloud.laz --out with_heights")
def lidar_control(
    output: Output,
    block: opt.Block,
    cloud: opt.Cloud,
    out: opt.BlockOut,
    method: Annotated[
        Literal["plane", "local", "tin", "idw", "image"], Option(help="Interpolation of heights between laser points.")
    ] = "plane",
    sigma_z_m: SigmaZ = 0.15,
    sigma_xy_m: SigmaXY = 0.5,
    sigma_systematic_m: Systematic = 0.0,
    classes: opt.Classes = None,
    returns: opt.Returns = "all",
    cloud_epsg: opt.CloudEpsg = None,
    cloud_unit: opt.CloudUnit = None,
    max_rounds: MaxRounds = 20,
) -> None:
    """Add the heights of laser points at tie points as control, and write the block."""
    import numpy as np

    from jaxphoto.io.block_folder import whole_block
    from jaxphoto.lidar import HeightSettings
    from jaxphoto.procedures.lidar import lidar_control
    from jaxphoto.procedures.lidar.vertical_control import flag_counts
    from jaxphoto.report.lidar import heights_figure, heights_page, heights_table, print_rounds, rounds_table
    from jaxphoto.writing import check_folder

    settings = HeightSettings(sigma_z_m=sigma_z_m, sigma_xy_m=sigma_xy_m, sigma_systematic_m=sigma_systematic_m)
    selection = {"classes": opt.class_numbers(classes), "returns": returns, "epsg": cloud_epsg, "unit": cloud_unit}
    check_folder(out, block, cloud)
    with output.progress("reading the block") as progress:
        read, points = _block_and_cloud(block, cloud, selection, progress)
        report = _report_rounds(progress)
        result = lidar_control(read, points, method, settings, max_rounds=max_rounds, report=report)  # type: ignore[arg-type]
        progress.update(f"writing {out}")
        heights, rounds = heights_table(result), rounds_table(result.rounds)
        picture = heights_figure(result)
        page = heights_page(result, picture, output.command_record(block, cloud))
        with whole_block(result.block, out) as folder:
            heights.to_csv(folder / "lidar_heights.csv", index=False)
            rounds.to_csv(folder / "lidar_rounds.csv", index=False)
            picture.savefig(folder / "lidar_heights.png")
            (folder / "report.html").write_text(page, encoding="utf-8")
    print_rounds(result.rounds, result.converged, output.screen)
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
    cloud_unit: opt.CloudUnit = None,
    max_rounds: MaxRounds = 20,
) -> None:
    """Constrain tie points to roof planes, and roof centroids in X, Y and Z; write the block."""
    from jaxphoto.io import write_block
    from jaxphoto.lidar import HeightSettings
    from jaxphoto.procedures.lidar import roof_control
    from jaxphoto.report.lidar import print_rounds
    from jaxphoto.writing import check_folder

    settings = HeightSettings(sigma_z_m=sigma_z_m, sigma_xy_m=sigma_xy_m, sigma_systematic_m=0.0)
    selection = {"classes": opt.class_numbers(classes), "returns": returns, "epsg": cloud_epsg, "unit": cloud_unit}
    check_folder(out, block, cloud)
    with output.progress("reading the block") as progress:
        read, points = _block_and_cloud(block, cloud, selection, progress)
        options: dict[str, Any] = {"max_rounds": max_rounds, "report": _report_rounds(progress)}
        result = roof_control(read, points, settings, centroids=opt.names(centroids), **options)
        progress.update(f"writing {out}")
        write_block(result.block, out)
    print_rounds(result.rounds, result.converged, output.screen)
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
    trajectory: Trajectory = None,
    trajectory_shift_s: TrajectoryShift = 0.0,
    boresight: Annotated[
        str | None,
        Option(help="Boresight of the scanner: free (default with a trajectory), fixed, or its sigma in degrees."),
    ] = None,
    shift: Annotated[str, Option(help="Shift of each lidar strip: free, fixed, or its sigma in m.")] = "0.3",
    method: Annotated[Literal["local", "plane", "tin", "idw"], Option(help="Surface model.")] = "local",
    sigma_z_m: SigmaZ = 0.15,
    sigma_xy_m: SigmaXY = 0.5,
    sigma_systematic_m: Systematic = 0.0,
    classes: opt.Classes = None,
    returns: opt.Returns = "all",
    cloud_epsg: opt.CloudEpsg = None,
    cloud_unit: opt.CloudUnit = None,
    max_rounds: MaxRounds = 20,
    adjust: Annotated[
        str | None,
        Option(help="Parts of the system to estimate, comma-separated: scanner,trajectory,camera (docs/boresight.md)."),
    ] = None,
    exposure_shift_s: ExposureShift = 0.0,
    control: Control = None,
    breaklines: Breaklines = None,
    pattern: Pattern = None,
    cell_m: CellSize = 3.0,
    roughness_m: Roughness = 0.06,
    knots_s: KnotSpacing = 10.0,
) -> None:
    """Adjust a block and a point cloud together; write results, corrected cloud and corrected trajectory.

    With --adjust, strips are also fitted to each other by planes in their overlaps. Individual scanner parameters may
    replace scanner, as in jaxphoto strips. Parts that are not given are fixed.

    --class and --returns select the points of the surface; the whole cloud is corrected. Exit code 1: results written,
    but not converged.
    """
    import numpy as np

    from jaxphoto.georeferencing import Scanner
    from jaxphoto.io import clouds, read_block
    from jaxphoto.io.trajectory import trajectory_in, with_positions, write_moved
    from jaxphoto.lidar import HeightSettings
    from jaxphoto.lidar.correction import correct_cloud, scanner_path
    from jaxphoto.lidar.coverage import check_covered
    from jaxphoto.lidar.strip_planes import StripSettings
    from jaxphoto.procedures.lidar import simultaneous
    from jaxphoto.report.lidar import print_moved, print_rounds, write_simultaneous
    from jaxphoto.writing import check_folder
    from jaxphoto_command.strip_flight import (
        StripChoices,
        StripFiles,
        adjust_flight,
        cloud_records,
        scanner_priors,
        write_corrected,
    )

    _check_options(output, _PLANE_OPTIONS if adjust is None else _SURFACE_OPTIONS)
    selected = opt.class_numbers(classes)
    if adjust is not None:
        free = _scanner_parameters(adjust, ("scanner", "trajectory", "camera"))
        times = (trajectory_shift_s, block, exposure_shift_s)
        files = StripFiles(cloud, trajectory, *times, selected, returns, cloud_epsg, cloud_unit, control, breaklines)
        choices = StripChoices(
            StripSettings(cell_m=cell_m, roughness_m=roughness_m, knots_s=knots_s),
            set(),
            scanner_priors({*free, "boresight"} if "scanner" in free else free, pattern),
            [] if "trajectory" in free else "all",
            "camera" not in free,
            max_rounds,
        )
        adjust_flight(output, files, choices, out)
        return
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
            records = cloud_records(trajectory, trajectory_shift_s)
            exact = np.zeros((len(records.time), 3))
            path = trajectory_in(records, read.frame, exact, exact)
        progress.update("reading the cloud")
        system: dict[str, Any] = {"epsg": cloud_epsg, "unit": cloud_unit}
        surface = clouds.read_cloud(cloud, read.frame, classes=selected, returns=returns, **system)
        if path is not None:
            check_covered(surface, path, trajectory_shift_s)
        seconds = {"read": time.perf_counter() - start}
        priors = Scanner(rotation, dict.fromkeys(surface.strips or ("cloud",), translation))
        report = _report_rounds(progress)
        options: dict[str, Any] = {"method": method, "settings": settings, "max_rounds": max_rounds, "report": report}
        result = simultaneous(read, surface, path, priors, **options)
        progress.update(f"writing {out}")
        track = None if path is None else scanner_path(path)
        with write_simultaneous(result, out, seconds, output.command_record(block, cloud, trajectory)) as folder:
            strips = tuple(result.scanner.shifts)
            corrected = lambda part: correct_cloud(part, result.scanner, track).xyz  # noqa: E731
            write_corrected(cloud, folder, corrected, strips, path, read.frame, system)
            if trajectory is not None and records is not None and result.trajectory is not None:
                moved = with_positions(records, np.asarray(result.trajectory.position), read.frame)
                write_moved(moved._replace(time=moved.time + trajectory_shift_s), trajectory, folder)
    print_rounds(result.rounds, result.converged, output.screen)
    print_moved(result, output.screen)
    output.wrote(out, f"results in {out}")
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
    trajectory: Trajectory = None,
    trajectory_shift_s: TrajectoryShift = 0.0,
    adjust: Annotated[
        str | None,
        Option(
            help=f"Scanner parameters to estimate, comma-separated: {', '.join(SCANNER)}; or none (default: boresight)."
        ),
    ] = None,
    pattern: Pattern = None,
    block: Annotated[
        Path | None, Option(help="Block folder of photographs on this trajectory, to adjust with the strips.")
    ] = None,
    exposure_shift_s: ExposureShift = 0.0,
    control: Control = None,
    breaklines: Breaklines = None,
    hold: Annotated[str, Option(help="Strips with a fixed trajectory, comma-separated.")] = "",
    cell_m: CellSize = 3.0,
    roughness_m: Roughness = 0.06,
    most_planes: Annotated[int, Option(min=1, help="Maximum number of observed planes.")] = 4000,
    knots_s: KnotSpacing = 10.0,
    correlation_s: Annotated[
        float, Option(callback=opt.positive, help="Correlation time of the trajectory errors.")
    ] = 100.0,
    sigma_position_m: Annotated[
        float | None,
        Option(callback=opt.positive, help="Standard deviation of positions (default: from the trajectory, or 0.08)."),
    ] = None,
    sigma_attitude_deg: Annotated[
        float | None,
        Option(
            callback=opt.positive, help="Standard deviation of roll, pitch (default: from the trajectory, or 0.005)."
        ),
    ] = None,
    sigma_heading_deg: Annotated[
        float | None,
        Option(callback=opt.positive, help="Standard deviation of heading (default: from the trajectory, or 0.01)."),
    ] = None,
    sigma_exposure_m: Annotated[
        float, Option(callback=opt.positive, help="Additional standard deviation of exposure positions.")
    ] = 0.01,
    sigma_exposure_deg: Annotated[
        float, Option(callback=opt.positive, help="Additional standard deviation of exposure attitudes.")
    ] = 0.002,
    classes: opt.Classes = None,
    returns: opt.Returns = "all",
    cloud_epsg: opt.CloudEpsg = None,
    cloud_unit: opt.CloudUnit = None,
    max_rounds: MaxRounds = 10,
) -> None:
    """Fit the strips of a point cloud to each other; write errors, corrected cloud and corrected trajectory.

    With --block, the photographs of the flight are also adjusted: trajectory, scanner and camera simultaneously. With
    --control, surveyed points define the datum.

    --class and --returns select the points of the planes; the whole cloud is corrected. Exit code 1: results written,
    but the verdict is red, or not converged.
    """
    from jaxphoto.lidar.strip_planes import StripSettings
    from jaxphoto_command.strip_flight import StripChoices, StripFiles, adjust_flight, scanner_priors

    sigmas = {
        "sigma_position_m": sigma_position_m,
        "sigma_attitude_deg": sigma_attitude_deg,
        "sigma_heading_deg": sigma_heading_deg,
    }
    stated: dict[str, Any] = {name: sigma for name, sigma in sigmas.items() if sigma is not None}
    settings = StripSettings(
        cell_m=cell_m,
        roughness_m=roughness_m,
        most=most_planes,
        knots_s=knots_s,
        correlation_s=correlation_s,
        sigma_exposure_m=sigma_exposure_m,
        sigma_exposure_deg=sigma_exposure_deg,
        **stated,
    )
    files = StripFiles(
        cloud,
        trajectory,
        trajectory_shift_s,
        block,
        exposure_shift_s,
        opt.class_numbers(classes),
        returns,
        cloud_epsg,
        cloud_unit,
        control,
        breaklines,
    )
    priors = None
    if adjust is not None or pattern is not None:
        free = set() if adjust == "none" else _scanner_parameters(adjust or "boresight")
        priors = scanner_priors(free, pattern)
    adjust_flight(output, files, StripChoices(settings, set(stated), priors, opt.names(hold), False, max_rounds), out)


@command("dsm", PANEL, f"{_EXAMPLE}jaxphoto dsm lidar/cloud.laz --out dsm.tif --cell-m 4 --hillshade hill.png")
def dsm(
    output: Output,
    cloud: opt.Cloud,
    out: Annotated[Path, Option(help="GeoTIFF to write.")],
    cell_m: Annotated[float, Option(callback=opt.positive, help="Cell size.")] = 1.0,
    classes: opt.Classes = None,
    returns: opt.Returns = "all",
    statistic: Annotated[
        Literal["highest", "mean", "lowest"], Option(help="Statistic of the heights in a cell.")
    ] = "highest",
    fill_m: Annotated[float, Option(min=0.0, help="Fill gaps up to this distance from a height.")] = 0.0,
    cloud_epsg: opt.CloudEpsg = None,
    cloud_unit: opt.CloudUnit = None,
    shading: Annotated[Path | None, Option("--hillshade", help="PNG of the shaded surface to write.")] = None,
) -> None:
    """Compute a surface model from a point cloud."""
    import numpy as np

    from jaxphoto.io import clouds, raster
    from jaxphoto.lidar.raster import filled, hillshade, surface_model
    from jaxphoto.writing import check_file

    check_file(out, cloud)
    if shading is not None:
        check_file(shading, cloud, out)
    selected, options = opt.class_numbers(classes), {"epsg": cloud_epsg, "unit": cloud_unit}
    with output.progress("reading the cloud") as progress:
        system = clouds.cloud_system(cloud, **options)  # type: ignore[arg-type]
        # Headers are rounded: add one cell on each side, and remove it if empty.
        extent = clouds.extent(cloud, **options)[:, :2] + np.array([[-cell_m], [cell_m]])  # type: ignore[arg-type]
        parts = partial(clouds.cloud_chunks, cloud, classes=selected, returns=returns, **options)  # type: ignore[arg-type]
        total = clouds.point_count(cloud) if selected is None and returns == "all" else None
        points = progress.points("reading the cloud", parts, total)
        surface = filled(surface_model((part.xyz for part in points()), extent, cell_m, statistic), fill_m)
        progress.update(f"writing {out}")
        raster.write_dsm(out, surface, system)
        if shading is not None:
            raster.write_hillshade(shading, hillshade(surface))
    rows, columns = surface.heights.shape
    fraction = 1 - np.isnan(surface.heights).mean()
    low, high = np.nanmin(surface.heights), np.nanmax(surface.heights)
    output.wrote(
        out,
        f"wrote {out}: {columns} x {rows} cells of {cell_m:g} m, {100 * fraction:.0f} % with heights, {low:.2f} to "
        f"{high:.2f} m, in {system.name}",
    )
    if shading is not None:
        output.wrote(shading, f"wrote {shading}")
    output.add(columns=columns, rows=rows, cell_m=cell_m, part_with_heights=fraction, low_m=low, high_m=high)
    output.add(system=system.name)


@command("orthophoto", PANEL, "jaxphoto orthophoto BLOCK photo.jpg dsm.tif --image A1 --out ortho.tif")
def orthophoto(
    output: Output,
    block: opt.Block,
    photo: Annotated[Path, Argument(help="Photograph of the image.")],
    dsm: Annotated[Path, Argument(help="Surface model.")],
    image: Annotated[str, Option(help="Id of the image in the block.")],
    out: Annotated[Path, Option(help="GeoTIFF to write.")],
    dsm_epsg: Annotated[int | None, Option(help="EPSG code of the surface model, if not in the file.")] = None,
    max_steps: opt.MaxSteps = 100,
) -> None:
    """Adjust a block and project the photograph of one image onto a surface model."""
    import jax
    import numpy as np

    from jaxphoto.errors import BlockError, InputError
    from jaxphoto.io import clouds, raster, read_block
    from jaxphoto.lidar.raster import orthophoto
    from jaxphoto.procedures.adjust import adjust
    from jaxphoto.writing import check_file

    check_file(out, block, photo, dsm)
    with output.progress("reading") as progress:
        read = read_block(block)
        if image not in read.images:
            some = ", ".join(read.images[:5]) + (" ..." if len(read.images) > 5 else "")
            raise InputError(f"--image {image}: unknown image; use one of {some}")
        index = read.images.index(image)
        camera = read.image_camera[index]
        surface, system = raster.read_dsm(dsm, dsm_epsg)
        placement = clouds.Placement(dsm.name, system, read.frame, "--dsm-epsg")
        pixels = raster.read_photograph(photo, read.sensors[camera])
        progress.update("adjusting")
        adjusted = adjust(read, max_steps=max_steps)
        if not bool(adjusted.converged):
            raise BlockError(f"{adjusted.outcome.value}: an orthophoto needs an adjusted orientation")
        progress.update("resampling")
        exterior = jax.tree.map(lambda v: np.asarray(v)[index], adjusted.unknowns.exterior)
        picture = orthophoto(
            surface,
            pixels,
            read.sensors[camera],
            adjusted.unknowns.interior[camera],
            exterior,
            object_from_map=placement.frame_from_metres,
            map_from_object=placement.metres,
            corrections=read.corrections,
        )
        if not picture.seen.any():
            (west, south), (east, north) = surface.extent
            x, y, z = placement.metres(np.asarray(exterior.position)[None])[0]
            raise InputError(
                f"image {image}, from ({x:.1f}, {y:.1f}, {z:.1f}) m, does not see {dsm.name} (X {west:.1f} to "
                f"{east:.1f}, Y {south:.1f} to {north:.1f} m, Z {np.nanmin(surface.heights):.1f} to "
                f"{np.nanmax(surface.heights):.1f} m); give a surface model of this area"
            )
        raster.write_orthophoto(out, picture, surface, system)
    fraction = picture.seen.mean()
    output.wrote(out, f"wrote {out}: image {image} on {100 * fraction:.0f} % of the cells of {dsm.name}")
    output.add(image=image, part_seen=fraction)


def _check_options(output: Output, options: tuple[str, ...]) -> None:
    """Raise BadParameter for options that have no effect with --adjust, or need it."""
    defaults = {parameter.name: parameter.default for parameter in output.context.command.params}
    for name in options:
        if output.context.params[name] != defaults[name]:
            cure = "needs --adjust" if options is _PLANE_OPTIONS else "has no effect with --adjust: omit one of them"
            raise typer.BadParameter(f"--{name.replace('_', '-')} {cure}.")


def _scanner_parameters(text: str, others: tuple[str, ...] = ()) -> set[str]:
    """Split comma-separated scanner parameters, or names of `others`. Raises BadParameter for an unknown name."""
    for name in opt.names(text) or [""]:
        if name not in (*others, *SCANNER):
            raise typer.BadParameter(f"--adjust {name or repr(text)}: choose from {', '.join((*others, *SCANNER))}.")
    return set(opt.names(text))


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
