"""`jaxphoto stability`: how alike two interior orientations are."""

import math
from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.app import app
from jaxphoto.cli.console import plain_console
from jaxphoto.cli.grid_options import check_grid, method_of, points_of
from jaxphoto.errors import InputError
from jaxphoto.io.cameras import CameraFile, read_camera_file
from jaxphoto.report import print_warning
from jaxphoto.report.stability import Compared, print_stability, write_stability
from jaxphoto.stability import METHODS, analyse
from jaxphoto.writing import check_folder


@app.command("stability")
def stability_command(
    first: Annotated[Path, typer.Argument(metavar="A", help="Results, interior.csv or camera file of one set.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="The same of the other set.")],
    method: Annotated[str, typer.Option(help=f"Alignment that the verdict is of: {', '.join(METHODS)}.")] = "rot",
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
    chosen = method_of(method)
    if not (math.isfinite(noise_px) and noise_px > 0):
        raise InputError(f"--noise-px {noise_px:g}: give the noise of image coordinates, a positive number of pixels")
    if not 0 <= relief < 1:
        raise InputError(f"--relief {relief:g}: give a part of the object's distance, from 0 to less than 1")
    check_grid(grid, extent)
    if out is not None:
        check_folder(out, first, second)
    names = (camera, camera_b if camera_b is not None else camera)
    both = a, b = [
        read_camera_file(path, camera=name, pixel_mm=pixel_mm, block=block)
        for path, name in zip((first, second), names, strict=True)
    ]
    _check_one_sensor(a, b, first, second)
    found = analyse(a.interior, b.interior, points_of(a.sensor, grid, extent), (a.covariance, b.covariance), relief)
    console, noise_mm = plain_console(), noise_px * a.sensor.pixel_mm
    one, other = (
        Compared(f"{letter} ({path})", file.interior, file.covariance is not None)
        for letter, path, file in zip("AB", (first, second), both, strict=True)
    )
    for letter, file in zip("AB", both, strict=True):
        if file.note:
            print_warning(f"{letter}: {file.note}", console, soft_wrap=True)
    print_stability(found, (one, other), a.sensor.pixel_mm, noise_mm, chosen, console)
    if out is not None:
        write_stability(found, (one, other), a.sensor, noise_mm, chosen, out)
        console.print(f"results in {out} (open report.html)")


def _check_one_sensor(a: CameraFile, b: CameraFile, first: Path, second: Path) -> None:
    one, other = a.sensor, b.sensor
    if (one.width_px, one.height_px) != (other.width_px, other.height_px):
        raise InputError(
            f"{first} is of {one.width_px} x {one.height_px} px, {second} of {other.width_px} x {other.height_px} px; "
            "compare two sets of one camera"
        )
    if not math.isclose(one.pixel_mm, other.pixel_mm, rel_tol=1e-6):
        raise InputError(
            f"the pixel of {first} is {one.pixel_mm:g} mm, that of {second} {other.pixel_mm:g} mm; where one of them "
            "was assumed, give the true one by --pixel-mm"
        )
