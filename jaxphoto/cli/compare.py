"""`jaxphoto compare`: has a camera changed between two calibrations, and where in the format?"""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.app import app
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.console import plain_console
from jaxphoto.cli.grid_options import check_grid, points_of
from jaxphoto.cli.made import made_by
from jaxphoto.cli.two_cameras import compared, read_two
from jaxphoto.report import print_warning
from jaxphoto.report.change import print_change, write_change
from jaxphoto.stability import METHODS, Method, change
from jaxphoto.writing import check_folder


@app.command("compare")
def compare_command(
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
    found = change(a.interior, b.interior, points_of(a.sensor, grid, extent), (a.covariance, b.covariance), method)
    console = plain_console()
    sets = compared("A", first, a), compared("B", second, b)
    for letter, file in (("A", a), ("B", b)):
        if file.note:
            print_warning(f"{letter}: {file.note}", console, soft_wrap=True)
    print_change(found, sets, a.sensor, console)
    if out is not None:
        write_change(found, sets, a.sensor, out, made_by(context, first, second))
        console.print(f"results in {out} (open report.html)")
