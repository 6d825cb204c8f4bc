"""`jaxphoto halves`: a block in; by which factor its standard deviations lie, and a band over the format out."""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.choices import one_of
from jaxphoto.cli.grid_options import check_grid, points_of
from jaxphoto.cli.judged_block import print_judgement
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.extras.formats import write_camera_file
from jaxphoto.io import read_block
from jaxphoto.procedures.halves import CUTS, camera_of, halves
from jaxphoto.report.halves import print_halves, write_halves
from jaxphoto.stability import METHODS, Method
from jaxphoto.writing import check_folder


@command("halves")
def halves_command(
    output: Output,
    context: typer.Context,
    block: Annotated[Path, typer.Argument(help="Block folder (see docs/block_folder.md).")],
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    by: Annotated[
        str, typer.Option(help="What stays together: image, strip, or a partition of block.toml such as day.")
    ] = "image",
    cuts: Annotated[int, typer.Option(min=1, help="Times that the block is cut.")] = CUTS,
    seed: Annotated[int, typer.Option(min=0, help="Of the draw of the cuts.")] = 0,
    method: Annotated[Method, one_of(METHODS, help="What the orientation of images may take up.")] = "rot",
    grid: Annotated[str, typer.Option(help="Columns and rows of cells.")] = "15x11",
    extent: Annotated[
        str | None, typer.Option(help="Width and height of the grid in mm, such as 4.0x3.0; the format if not given.")
    ] = None,
    camera: Annotated[str | None, typer.Option(help="Which camera, where the block has several.")] = None,
) -> None:
    """Judge the standard deviations of a calibration by random halves of its block.

    Both halves of each cut are adjusted, and what they differ by is compared with what their covariances promise.
    """
    check_grid(grid, extent)
    check_folder(out, block)
    with output.progress.status("reading the block") as status:
        read, made = read_block(block), made_by(context, block)
        cells = points_of(read.sensors[camera_of(read, camera)], grid, extent)
        found = halves(read, cells, by=by, camera=camera, n_cuts=cuts, seed=seed, method=method, report=status.update)
        status.update(f"writing {out}")
        interior = found.adjusted.unknowns.interior[found.camera]
        write_halves(
            found,
            out,
            lambda folder: write_camera_file(
                folder / "camera.toml",
                read.sensors[found.camera],
                interior,
                name=found.camera,
                covariance=found.widened,
            ),
            made,
        )
    print_judgement(found.adjusted, output)
    print_halves(found, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
