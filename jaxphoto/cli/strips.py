"""`jaxphoto strips`: from a cloud of several strips and its trajectory, both without what they are off by."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxphoto.cli.choices import positive
from jaxphoto.cli.cloud_options import Classes, CloudEpsg, CloudUnit, ReturnsOption, class_numbers
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
from jaxphoto.errors import InputError
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.procedures.lidar import ScannerPriors
from jaxphoto.procedures.lidar.strip_adjustment import MAX_STRIP_ROUNDS


@command("strips")
def strips_command(
    output: Output,
    context: typer.Context,
    cloud: Annotated[Path, typer.Argument(help="Cloud of several strips: .las, .laz, .csv or .ply (docs/clouds.md).")],
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    trajectory: Annotated[
        Path | None,
        typer.Option(help="Trajectory of the scanner (docs/trajectory.md), on the cloud's clock, in its system."),
    ] = None,
    trajectory_shift_s: TrajectoryShift = 0.0,
    adjust: Annotated[
        str | None,
        typer.Option(help=f"What of the scanner is estimated, by commas: {', '.join(SCANNER)} (boresight); or none."),
    ] = None,
    pattern: PatternOption = None,
    block: Annotated[
        Path | None,
        typer.Option(help="Block folder of photographs taken on this trajectory, which are adjusted with the strips."),
    ] = None,
    exposure_shift_s: ExposureShift = 0.0,
    control: ControlOption = None,
    breaklines: BreaklinesOption = None,
    hold: Annotated[str, typer.Option(help="Strips whose trajectory is right, by commas.")] = "",
    cell_m: CellM = USUAL.cell_m,
    roughness_m: RoughnessM = USUAL.roughness_m,
    most_planes: Annotated[int, typer.Option(help="Most planes that are observed.")] = USUAL.most,
    knots_s: KnotsS = USUAL.knots_s,
    correlation_s: Annotated[float, positive("Correlation time of these errors.")] = USUAL.correlation_s,
    sigma_position_m: Annotated[
        float | None,
        positive(f"Their standard deviation (the trajectory's own, or {USUAL.sigma_position_m:g})."),
    ] = None,
    sigma_attitude_deg: Annotated[
        float | None,
        positive(f"That about right and forward (the trajectory's own, or {USUAL.sigma_attitude_deg:g})."),
    ] = None,
    sigma_heading_deg: Annotated[
        float | None, positive(f"That about up (the trajectory's own, or {USUAL.sigma_heading_deg:g}).")
    ] = None,
    sigma_exposure_m: Annotated[
        float, positive("What stations of photographs are off by besides.")
    ] = USUAL.sigma_exposure_m,
    sigma_exposure_deg: Annotated[
        float, positive("What their attitudes are off by besides.")
    ] = USUAL.sigma_exposure_deg,
    classes: Classes = None,
    returns: ReturnsOption = "all",
    cloud_epsg: CloudEpsg = None,
    cloud_unit: CloudUnit = None,
    max_rounds: Annotated[int, typer.Option(min=1, help="Most rounds of search and adjustment.")] = MAX_STRIP_ROUNDS,
) -> None:
    """Fit the strips of a cloud to each other; write the corrected cloud and trajectory, and what was wrong.

    With --block the photographs of the flight, too: trajectory, scanner and camera at once. With --control surveyed
    points, which are the datum.

    --class and --returns choose the points of the planes; the whole cloud is corrected. Exit code 1: written, but
    the verdict is red, as where it still changes.
    """
    sigmas = {
        "sigma_position_m": sigma_position_m,
        "sigma_attitude_deg": sigma_attitude_deg,
        "sigma_heading_deg": sigma_heading_deg,
    }
    given: dict[str, Any] = {name: sigma for name, sigma in sigmas.items() if sigma is not None}
    if most_planes < 1:
        raise InputError(f"--most-planes {most_planes}: give 1 or more")
    settings = StripSettings(
        cell_m=cell_m,
        roughness_m=roughness_m,
        most=most_planes,
        knots_s=knots_s,
        correlation_s=correlation_s,
        sigma_exposure_m=sigma_exposure_m,
        sigma_exposure_deg=sigma_exposure_deg,
    )
    held = [name.strip() for name in hold.split(",") if name.strip()]
    files = StripFiles(
        cloud,
        trajectory,
        trajectory_shift_s,
        block,
        exposure_shift_s,
        class_numbers(classes),
        returns,
        cloud_epsg,
        cloud_unit,
        control,
        breaklines,
    )
    settings = dataclasses.replace(settings, **given)
    choices = StripChoices(settings, set(given), _priors(adjust, pattern), held, False, max_rounds)
    adjust_flight(output, context, files, choices, out)


def _priors(adjust: str | None, pattern: str | None) -> ScannerPriors | None:
    """FREE what `adjust` names of the scanner; None where nothing is said of it."""
    if adjust is None and pattern is None:
        return None
    text = "boresight" if adjust is None else adjust
    names = [] if text.strip() == "none" else [name.strip() for name in text.split(",")]
    for name in names:
        if name not in SCANNER:
            raise InputError(
                f"--adjust {name or repr(text)}: a scanner has {', '.join(SCANNER)}; name some of these, or none"
            )
    return scanner_priors(names, pattern)
