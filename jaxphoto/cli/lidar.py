"""`jaxphoto lidar-control` and `jaxphoto simultaneous`: from a block and a cloud, control heights, or both mended."""

import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from jaxtyping import Float
from rich.console import Console

from jaxphoto.block import Block
from jaxphoto.cli.choices import one_of, positive
from jaxphoto.cli.cloud_options import Classes, CloudEpsg, CloudUnit, ReturnsOption, class_numbers
from jaxphoto.cli.corrected_cloud import write_corrected
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.strip_flight import (
    SCANNER,
    USUAL,
    BreaklinesOption,
    CellM,
    ControlOption,
    ExposureShift,
    KnotsS,
    PatternOption,
    RoughnessM,
    StripChoices,
    StripFiles,
    TrajectoryShift,
    adjust_flight,
    scanner_priors,
)
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.georeferencing import Scanner
from jaxphoto.io import clouds, read_block, write_block
from jaxphoto.io.block_folder import check_block_target, whole_block
from jaxphoto.io.text_tables import is_number
from jaxphoto.io.trajectory import read_records, write_moved
from jaxphoto.io.trajectory.in_frame import trajectory_in, with_positions
from jaxphoto.lidar import HeightSettings
from jaxphoto.lidar.correction import correct_cloud, scanner_path
from jaxphoto.lidar.coverage import check_covered
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.orientation import approximate
from jaxphoto.procedures.lidar import Round, lidar_control, roof_control, simultaneous
from jaxphoto.procedures.lidar.images_and_cloud import SHIFT_SIGMA, SURFACES
from jaxphoto.procedures.lidar.roof_control import RoofControl
from jaxphoto.procedures.lidar.until_still import MAX_ROUNDS
from jaxphoto.procedures.lidar.vertical_control import METHODS, LidarControl, flag_counts
from jaxphoto.report.lidar import (
    heights_figure,
    heights_page,
    heights_table,
    print_moved,
    print_rounds,
    rounds_table,
    write_simultaneous,
)
from jaxphoto.unknowns import FIXED, FREE, Weighted
from jaxphoto.writing import check_folder

# Beyond the outermost points, in m and as a part of the block: as far as approximate points may be off.
_MARGIN_M, _MARGIN = 100.0, 0.1

# Options of `simultaneous` that say nothing with --adjust, and those that say nothing without it.
_OF_SURFACES = "boresight", "shift", "method", "sigma_z_m", "sigma_xy_m", "sigma_systematic_m"
_OF_PLANES = "exposure_shift_s", "control", "breaklines", "pattern", "cell_m", "roughness_m", "knots_s"

BlockFolder = Annotated[Path, typer.Argument(help="Block folder (see docs/block_folder.md).")]
CloudFile = Annotated[Path, typer.Argument(help="Cloud: .las, .laz, .csv or .ply (see docs/clouds.md).")]
SigmaZ = Annotated[float, positive("Standard deviation of a laser point's height.")]
SigmaXY = Annotated[float, typer.Option(help="Standard deviation of a laser point's X, and of its Y.")]
Systematic = Annotated[float, typer.Option(help="Standard deviation of what all its heights are off by.")]
Rounds = Annotated[int, typer.Option(min=1, help="Most rounds of looking at the cloud and adjusting.")]
Method = Annotated[str, one_of(METHODS, help="How heights follow from laser points.")]


@command("lidar-control")
def lidar_control_command(
    output: Output,
    context: typer.Context,
    block: BlockFolder,
    cloud: CloudFile,
    out: Annotated[Path, typer.Option(help="Block folder to write; a block in it is replaced.")],
    method: Method = "plane",
    sigma_z_m: SigmaZ = 0.15,
    sigma_xy_m: SigmaXY = 0.5,
    sigma_systematic_m: Systematic = 0.0,
    classes: Classes = None,
    returns: ReturnsOption = "all",
    cloud_epsg: CloudEpsg = None,
    cloud_unit: CloudUnit = None,
    max_rounds: Rounds = MAX_ROUNDS,
) -> None:
    """Give tie points the height of the laser points there as control, and write the block with it."""
    settings = _settings(sigma_z_m, sigma_xy_m, sigma_systematic_m)
    chosen = class_numbers(classes)
    check_block_target(out, block, cloud)
    with output.progress.status("reading the block") as status:
        read = read_block(block)
        status.update("reading the cloud")
        points = _over_block(read, cloud, chosen, returns, cloud_epsg, cloud_unit)
        report = _reporter(output.progress, status.update)
        found = lidar_control(read, points, method, settings, max_rounds=max_rounds, report=report)  # type: ignore[arg-type]
        status.update(f"writing {out}")
        heights, rounds = heights_table(found), rounds_table(found.rounds)
        picture = heights_figure(found)
        page = heights_page(found, picture, made_by(context, block, cloud))
        with whole_block(found.block, out) as folder:
            heights.to_csv(folder / "lidar_heights.csv", index=False)
            rounds.to_csv(folder / "lidar_rounds.csv", index=False)
            picture.savefig(folder / "lidar_heights.png")
            (folder / "report.html").write_text(page, encoding="utf-8")
    print_rounds(found.rounds, found.still, output.screen)
    refused = ", ".join(
        f"{name.lower()} {n}" for name, n in flag_counts(found.flag[~np.isfinite(found.height)]).items()
    )
    said = f"wrote {out}: {int(found.used.sum())} of {len(found.points)} tie points have a control height"
    output.wrote(out, said + (f" (refused: {refused})" if refused else ""))
    output.tell(n_control_heights=found.used.sum(), n_tie_points=len(found.points), **_of_rounds(found))
    if not found.still:
        raise typer.Exit(1)


@command("roof-control")
def roof_control_command(
    output: Output,
    block: BlockFolder,
    cloud: CloudFile,
    out: Annotated[Path, typer.Option(help="Block folder to write; a block in it is replaced.")],
    centroids: Annotated[str | None, typer.Option(help="Points at the middle of roof faces, by commas.")] = None,
    sigma_z_m: SigmaZ = 0.15,
    sigma_xy_m: SigmaXY = 0.5,
    classes: Classes = None,
    returns: ReturnsOption = "all",
    cloud_epsg: CloudEpsg = None,
    cloud_unit: CloudUnit = None,
    max_rounds: Rounds = MAX_ROUNDS,
) -> None:
    """Hold tie points on the planes of roof faces, and centroids of roofs in X, Y and Z; write the block with it."""
    settings, chosen = _settings(sigma_z_m, sigma_xy_m, 0.0), class_numbers(classes)
    check_block_target(out, block, cloud)
    with output.progress.status("reading the block") as status:
        read = read_block(block)
        status.update("reading the cloud")
        points = _over_block(read, cloud, chosen, returns, cloud_epsg, cloud_unit)
        named = [name.strip() for name in centroids.split(",")] if centroids else []
        report = _reporter(output.progress, status.update)
        found = roof_control(read, points, settings, centroids=named, max_rounds=max_rounds, report=report)
        status.update(f"writing {out}")
        write_block(found.block, out)
    print_rounds(found.rounds, found.still, output.screen)
    output.wrote(out, f"wrote {out}: {len(found.points)} tie points lie on {found.faces} roof faces")
    output.tell(n_tie_points=len(found.points), n_roof_faces=found.faces, **_of_rounds(found))
    if not found.still:
        raise typer.Exit(1)


@command("simultaneous")
def simultaneous_command(
    output: Output,
    context: typer.Context,
    block: BlockFolder,
    cloud: CloudFile,
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    trajectory: Annotated[
        Path | None, typer.Option(help="Trajectory of the scanner (docs/trajectory.md), on the cloud's clock.")
    ] = None,
    trajectory_shift_s: TrajectoryShift = 0.0,
    boresight: Annotated[
        str | None, typer.Option(help="Of the scanner: free (with a trajectory), fixed, or its sigma in degrees.")
    ] = None,
    shift: Annotated[
        str, typer.Option(help="Of each lidar strip: free, fixed, or its sigma in m.")
    ] = f"{SHIFT_SIGMA:g}",
    method: Annotated[str, one_of(SURFACES, help="How the surface is found.")] = "local",
    sigma_z_m: SigmaZ = 0.15,
    sigma_xy_m: SigmaXY = 0.5,
    sigma_systematic_m: Systematic = 0.0,
    classes: Classes = None,
    returns: ReturnsOption = "all",
    cloud_epsg: CloudEpsg = None,
    cloud_unit: CloudUnit = None,
    max_rounds: Rounds = MAX_ROUNDS,
    adjust: Annotated[
        str | None,
        typer.Option(help="What is estimated of the whole flying system: scanner,trajectory,camera (docs/joint.md)."),
    ] = None,
    exposure_shift_s: ExposureShift = 0.0,
    control: ControlOption = None,
    breaklines: BreaklinesOption = None,
    pattern: PatternOption = None,
    cell_m: CellM = USUAL.cell_m,
    roughness_m: RoughnessM = USUAL.roughness_m,
    knots_s: KnotsS = USUAL.knots_s,
) -> None:
    """Adjust a block and a cloud together; write the results, the corrected cloud and trajectory.

    With --adjust strips fit to each other, too, by planes in their overlaps, and trajectories drift. In place of
    scanner what of it is estimated may be named, as in strips. What is not named is right.

    --class and --returns choose the points of the surface; the whole cloud is corrected. Exit code 1: written, but it
    still changed.
    """
    _check_alone(context, _OF_PLANES if adjust is None else _OF_SURFACES)
    if adjust is not None:
        settings = StripSettings(cell_m=cell_m, roughness_m=roughness_m, knots_s=knots_s)
        times, seen = (trajectory_shift_s, block, exposure_shift_s), (class_numbers(classes), returns)
        files = StripFiles(cloud, trajectory, *times, *seen, cloud_epsg, cloud_unit, control, breaklines)
        adjust_flight(output, context, files, _of_flight(adjust, pattern, settings, max_rounds), out)
        return
    surfaces = _settings(sigma_z_m, sigma_xy_m, sigma_systematic_m)
    if trajectory is None and boresight not in (None, "fixed"):
        raise InputError(f"--boresight {boresight} needs --trajectory, which says from where each point was measured")
    turn = _prior("--boresight", boresight or ("fixed" if trajectory is None else "free"), np.pi / 180)
    slide, chosen = _prior("--shift", shift, 1.0), class_numbers(classes)
    check_folder(out, block, cloud, *([] if trajectory is None else [trajectory]))
    began = time.perf_counter()
    with output.progress.status("reading the block") as status:
        read = read_block(block)
        records = path = None
        if trajectory is not None:
            records = read_records(trajectory)
            # On the cloud's clock from here on.
            records = records._replace(time=records.time - trajectory_shift_s)
            exact = np.zeros((len(records.time), 3))
            path = trajectory_in(records, read.frame, exact, exact)
        status.update("reading the cloud")
        said = {"epsg": cloud_epsg, "unit": cloud_unit}
        surface = clouds.read_cloud(cloud, read.frame, classes=chosen, returns=returns, **said)  # type: ignore[arg-type]
        if path is not None:
            # Here on the clocks as they were given.
            check_covered(surface, path, trajectory_shift_s)
        seconds = {"read": time.perf_counter() - began}
        priors = Scanner(turn, dict.fromkeys(surface.strips or ("cloud",), slide))  # type: ignore[arg-type]
        result = simultaneous(
            read,
            surface,
            path,
            priors,
            method=method,  # type: ignore[arg-type]
            settings=surfaces,
            max_rounds=max_rounds,
            report=_reporter(output.progress, status.update),
        )
        status.update(f"writing {out}")
        made = made_by(context, block, cloud, trajectory)
        track = None if path is None else scanner_path(path)

        def corrected(part: Cloud) -> Float[np.ndarray, "n 3"]:
            return correct_cloud(part, result.scanner, track).xyz

        with write_simultaneous(result, out, seconds, made) as folder:
            write_corrected(cloud, folder, corrected, tuple(result.scanner.shifts), path, read.frame, said)
            if trajectory is not None and records is not None and result.trajectory is not None:
                moved = with_positions(records, np.asarray(result.trajectory.position), read.frame)
                moved = moved._replace(time=moved.time + trajectory_shift_s)
                write_moved(moved, trajectory, folder)
    print_rounds(result.rounds, result.still, output.screen)
    print_moved(result, output.screen)
    output.wrote(out, f"results in {out}")
    if not result.still:
        raise typer.Exit(1)


def _check_alone(context: typer.Context, names: Collection[str]) -> None:
    """Raise InputError for options that say nothing with --adjust, or nothing without it."""
    usual = {parameter.name: parameter.default for parameter in context.command.params}
    for name in names:
        # By its value: a command is told with its defaults where it says how results were made.
        if context.params[name] != usual[name]:
            of = (
                "planes in the overlaps of strips, which --adjust seeks: give both, or neither"
                if names is _OF_PLANES
                else "surfaces under tie points, and --adjust seeks planes in overlaps of strips: leave one of them out"
            )
            raise InputError(f"--{name.replace('_', '-')} is of {of}")


def _of_flight(adjust: str, pattern: str | None, settings: StripSettings, max_rounds: int) -> StripChoices:
    """What `adjust` names of the flying system. Raises InputError for what that does not have."""
    named = {name.strip() for name in adjust.split(",")}
    for name in sorted(named - {"scanner", "trajectory", "camera", *SCANNER}):
        raise InputError(
            f"--adjust {name or repr(adjust)}: a flying system has scanner, trajectory and camera, and a "
            f"scanner {', '.join(SCANNER)}; name some of these"
        )
    free = named | ({"boresight"} if "scanner" in named else set())
    held: list[str] | Literal["all"] = [] if "trajectory" in named else "all"
    return StripChoices(settings, set(), scanner_priors(free, pattern), held, "camera" not in named, max_rounds)


def _settings(sigma_z_m: float, sigma_xy_m: float, sigma_systematic_m: float) -> HeightSettings:
    return HeightSettings(sigma_z_m=sigma_z_m, sigma_xy_m=sigma_xy_m, sigma_systematic_m=sigma_systematic_m)


def _prior(option: str, text: str, unit: float):
    """FREE, FIXED, or weighted at zero. Raises InputError for what is none of these."""
    if text in ("free", "fixed"):
        return FREE if text == "free" else FIXED
    if not is_number(text) or not 0 < float(text) < np.inf:
        raise InputError(f"{option} {text}: write free, fixed, or a standard deviation")
    return Weighted(np.zeros(3), np.full(3, float(text) * unit))


def _over_block(
    block: Block, path: Path, classes: list[int] | None, returns: str, epsg: int | None, unit: str | None
) -> Cloud:
    """The cloud where points of the block may lie."""
    said = {"classes": classes, "returns": returns, "epsg": epsg, "unit": unit}
    return clouds.read_cloud(path, block.frame, within=_ground(block), **said)  # type: ignore[arg-type]


def _ground(block: Block) -> Float[np.ndarray, "2 2"]:
    """Least and greatest X, Y (m) that points of the block may have."""
    xy = np.asarray(approximate(block).points)[:, :2]
    low, high = xy.min(axis=0), xy.max(axis=0)
    margin = _MARGIN_M + _MARGIN * (high - low)
    return np.stack([low - margin, high + margin])


def _of_rounds(found: LidarControl | RoofControl) -> dict[str, Any]:
    """How the rounds ended."""
    return {"rounds": len(found.rounds), "came_to_rest": found.still, "rmse_m": found.rounds[-1].rmse_m}


def _reporter(console: Console, show: Callable[[str], None]) -> Callable[[Round], None]:
    """Each round on a line of its own, where a person looks."""
    show("adjusting for the first round")

    def report(made: Round) -> None:
        line = f"round {made.number}: {made.observed} observations, RMSE {made.rmse_m:.3f} m"
        if np.isfinite(made.largest_change):
            line += f", largest change {made.largest_change:.2g} standard deviations"
        if console.is_terminal:
            console.print(line)
        show(f"{line}; looking at the cloud")

    return report
