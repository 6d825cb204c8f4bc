"""`jaxphoto stability`: how alike two interior orientations are."""

import math
from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.choices import one_of
from jaxphoto.cli.grid_options import check_grid, points_of
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.two_cameras import compared, read_two
from jaxphoto.errors import InputError
from jaxphoto.report.stability import print_stability, stability_summary, write_stability
from jaxphoto.stability import METHODS, Method, analyse
from jaxphoto.writing import check_folder


@command("stability")
def stability_command(
    output: Output,
    context: typer.Context,
    first: Annotated[Path, typer.Argument(metavar="A", help="Results, interior.csv or camera file of one set.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="The same of the other set.")],
    method: Annotated[Method, one_of(METHODS, help="Alignment that the verdict is of.")] = "rot",
    grid: Annotated[str, typer.Option(help="Columns and rows of the grid.")] = "15x11",
    extent: Annotated[
        str | None, typer.Option(help="Width and height of the grid in mm, such as 4.0x3.0; the format if not given.")
    ] = None,
    noise_px: Annotated[float, typer.Option(help="Noise of image coordinates in pixels.")] = 1.0,
    relief: Annotated[
        float, typer.Option(help="Of spr: relief of the object points, as a part of their distance.")
    ] = 0.0,
    camera: Annotated[str | None, typer.Option(help="Which camera, where a file holds several.")] = None,
    camera_b: Annotated[str | None, typer.Option(help="Which camera of B, where it is called otherwise there.")] = None,
    pixel_mm: Annotated[float | None, typer.Option(help="Size of a pixel, where files do not say it.")] = None,
    block: Annotated[
        Path | None, typer.Option(help="Block of which interior.csv is, where results do not say the model.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for tables, map and page.")] = None,
) -> None:
    """Compare the bundles of rays of two interior orientations (Habib et al. 2006), with uncertainty."""
    if not (math.isfinite(noise_px) and noise_px > 0):
        raise InputError(f"--noise-px {noise_px:g}: give the noise of image coordinates, a positive number of pixels")
    if not 0 <= relief < 1:
        raise InputError(f"--relief {relief:g}: give a part of the object's distance, from 0 to less than 1")
    check_grid(grid, extent)
    if out is not None:
        check_folder(out, first, second)
    both = a, b = read_two((first, second), (camera, camera_b), pixel_mm, block)
    with output.progress.status("comparing"):
        points = points_of(a.sensor, grid, extent)
        found = analyse(a.interior, b.interior, points, (a.covariance, b.covariance), relief)
    noise_mm = noise_px * a.sensor.pixel_mm
    one, other = compared("A", first, a), compared("B", second, b)
    for letter, file in zip("AB", both, strict=True):
        if file.note:
            output.warn(f"{letter}: {file.note}")
    print_stability(found, (one, other), a.sensor.pixel_mm, noise_mm, method, output.screen)
    output.tell(**stability_summary(found, (one, other), noise_mm, method))
    if out is not None:
        write_stability(found, (one, other), a.sensor, noise_mm, method, out, made_by(context, first, second))
        output.wrote(out, f"results in {out} (open report.html)")
