"""Commands that compare calibrations."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from jaxphoto_command import options as opt
from jaxphoto_command.application import command
from jaxphoto_command.output import Output

PANEL = "Camera comparison"
_TWO_CALIBRATIONS = (
    "jaxphoto example recipe && for k in 1 2; do jaxphoto simulate recipe.toml --seed $k --out block_$k && "
    "jaxphoto adjust block_$k --out results_$k; done && "
)
CameraA = Annotated[Path, Argument(metavar="A", help="Results or camera file of one calibration.")]
CameraFileB = Annotated[Path, Argument(metavar="B", help="Results or camera file of the other calibration.")]
OptionalOut = Annotated[Path | None, Option(help="Output folder for tables, figures and report.")]


@command("stability", PANEL, f"{_TWO_CALIBRATIONS}jaxphoto stability results_1 results_2 --out stability")
def stability(
    output: Output,
    first: CameraA,
    second: CameraFileB,
    method: opt.Alignment = "rot",
    grid: opt.Grid = "15x11",
    extent: opt.Extent = None,
    noise_px: Annotated[float, Option(callback=opt.positive, help="Standard deviation of image coordinates.")] = 1.0,
    relief: Annotated[float, Option(help="Relief of the object points for spr, as a fraction of distance.")] = 0.0,
    camera: opt.Camera = None,
    camera_b: opt.CameraB = None,
    pixel_mm: opt.PixelSize = None,
    block: opt.ResultBlock = None,
    out: OptionalOut = None,
) -> None:
    """Compare the ray bundles of two interior orientations (Habib et al. 2006), with uncertainty."""
    from jaxphoto.report.stability import print_stability, stability_summary, write_stability
    from jaxphoto.stability import analyse
    from jaxphoto.writing import check_folder
    from jaxphoto_command.certificate import read_two

    if not 0 <= relief < 1:
        raise typer.BadParameter(f"--relief {relief:g}: give a fraction of the object distance, 0 <= relief < 1.")
    if out is not None:
        check_folder(out, first, second)
    a, b = read_two((first, second), (camera, camera_b), pixel_mm, block)
    with output.progress("comparing"):
        points = opt.grid_points(a.sensor, grid, extent)
        analysis = analyse(a.interior, b.interior, points, (a.covariance, b.covariance), relief)
    noise_mm = noise_px * a.sensor.pixel_mm
    sets = _compared(output, (first, second), (a, b))
    print_stability(analysis, sets, a.sensor.pixel_mm, noise_mm, method, output.screen)
    output.add(**stability_summary(analysis, sets, noise_mm, method))
    if out is not None:
        write_stability(analysis, sets, a.sensor, noise_mm, method, out, output.command_record(first, second))
        output.wrote(out, f"results in {out} (open report.html)")


@command("compare", PANEL, f"{_TWO_CALIBRATIONS}jaxphoto compare results_1 results_2 --out change")
def compare(
    output: Output,
    first: CameraA,
    second: CameraFileB,
    method: opt.Alignment = "rot",
    grid: opt.Grid = "15x11",
    extent: opt.Extent = None,
    camera: opt.Camera = None,
    camera_b: opt.CameraB = None,
    pixel_mm: opt.PixelSize = None,
    block: opt.ResultBlock = None,
    out: OptionalOut = None,
) -> None:
    """Test whether a camera has changed between two calibrations: parameters and ray bundle."""
    from jaxphoto.report.stability import change_summary, print_change, write_change
    from jaxphoto.stability import change
    from jaxphoto.writing import check_folder
    from jaxphoto_command.certificate import check_two_calibrations, read_two, share_measurements

    if out is not None:
        check_folder(out, first, second)
    a, b = read_two((first, second), (camera, camera_b), pixel_mm, block)
    check_two_calibrations(a, b, first, second)
    if share_measurements(first, second):
        output.warn("A and B share photographs or image points; the test assumes independent ones")
    with output.progress("comparing"):
        points = opt.grid_points(a.sensor, grid, extent)
        result = change(a.interior, b.interior, points, (a.covariance, b.covariance), method)
    sets = _compared(output, (first, second), (a, b))
    print_change(result, sets, a.sensor, output.screen)
    output.add(**change_summary(result, a.sensor))
    if out is not None:
        write_change(result, sets, a.sensor, out, output.command_record(first, second))
        output.wrote(out, f"results in {out} (open report.html)")


@command(
    "models",
    PANEL,
    "jaxphoto example cross_block && jaxphoto models cross_block --models brown:k1,brown:k1+k2,opencv --out models",
)
def models(
    output: Output,
    block: opt.Block,
    out: opt.Out,
    models: Annotated[
        str, Option(help="Models, comma-separated: brown (usual parameters), brown:all, brown:none, brown:k1+k2, smac.")
    ] = "brown:none,brown:k1,brown:k1+k2,brown:k1+k2+k3,brown,brown:all",
    folds: Annotated[int, Option(min=0, help="Folds of the cross-validation; 0 for none.")] = 5,
    seed: opt.Seed = 0,
) -> None:
    """Compare distortion models by cross-validation, information criteria and significance."""
    from jaxphoto.io import read_block
    from jaxphoto.procedures.model_choice import model_choice
    from jaxphoto.report.model_choice import print_model_choice, write_model_choice
    from jaxphoto.writing import check_folder

    check_folder(out, block)
    start = time.perf_counter()
    with output.progress("reading the block") as progress:
        read, record = read_block(block), output.command_record(block)
        seconds = {"read": time.perf_counter() - start}
        choice = model_choice(read, opt.names(models), k=folds, seed=seed, report=progress.update)
        seconds["adjust"] = time.perf_counter() - start - seconds["read"]
        progress.update(f"writing {out}")
        write_model_choice(choice, read, out, seconds, record)
    print_model_choice(choice, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
    if not choice.by_bic:
        raise typer.Exit(1)


def _compared(output: Output, paths: tuple[Path, Path], files: tuple[Any, Any]) -> tuple[Any, Any]:
    """Return calibrations A and B for a comparison, and print the notes of their files."""
    from jaxphoto_command.certificate import compared

    for letter, file in zip("AB", files, strict=True):
        if file.note:
            output.warn(f"{letter}: {file.note}")
    a, b = (compared(letter, *pair) for letter, pair in zip("AB", zip(paths, files, strict=True), strict=True))
    return a, b
