"""`jaxphoto compare`: has a camera changed between two calibrations, and where in the format?"""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.choices import one_of
from jaxphoto.cli.grid_options import check_grid, points_of
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.two_cameras import check_two_calibrations, compared, read_two, share_measurements
from jaxphoto.report.stability import change_summary, print_change, write_change
from jaxphoto.stability import METHODS, Method, change
from jaxphoto.writing import check_folder


@command("compare")
def compare_command(
    output: Output,
    context: typer.Context,
    first: Annotated[Path, typer.Argument(metavar="A", help="Results or camera file of one calibration.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="The same of the other, by other photographs.")],
    method: Annotated[Method, one_of(METHODS, help="What the orientation of images may take up.")] = "rot",
    grid: Annotated[str, typer.Option(help="Columns and rows of the grid.")] = "15x11",
    extent: Annotated[
        str | None, typer.Option(help="Width and height of the grid in mm, such as 4.0x3.0; the format if not given.")
    ] = None,
    camera: Annotated[str | None, typer.Option(help="Which camera, where a file holds several.")] = None,
    camera_b: Annotated[str | None, typer.Option(help="Which camera of B, where it is called otherwise there.")] = None,
    pixel_mm: Annotated[float | None, typer.Option(help="Size of a pixel, where files do not say it.")] = None,
    block: Annotated[
        Path | None, typer.Option(help="Block of which interior.csv is, where results do not say the model.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for tables, maps and page.")] = None,
) -> None:
    """Test whether a camera has changed between two calibrations: by parameters, by its rays, and where."""
    check_grid(grid, extent)
    if out is not None:
        check_folder(out, first, second)
    a, b = read_two((first, second), (camera, camera_b), pixel_mm, block)
    check_two_calibrations(a, b, first, second)
    if share_measurements(first, second):
        output.warn("A and B are of the same photographs or image points; the test takes them to be of others")
    with output.progress.status("comparing"):
        points = points_of(a.sensor, grid, extent)
        found = change(a.interior, b.interior, points, (a.covariance, b.covariance), method)
    sets = compared("A", first, a), compared("B", second, b)
    for letter, file in (("A", a), ("B", b)):
        if file.note:
            output.warn(f"{letter}: {file.note}")
    print_change(found, sets, a.sensor, output.screen)
    output.tell(**change_summary(found, a.sensor))
    if out is not None:
        write_change(found, sets, a.sensor, out, made_by(context, first, second))
        output.wrote(out, f"results in {out} (open report.html)")
