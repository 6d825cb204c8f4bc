"""`jaxphoto calibrate`: photographs of a board in, the calibrated camera out."""

import time
from functools import partial
from itertools import count
from pathlib import Path
from threading import Thread
from typing import Annotated

import typer

import jaxphoto
from jaxphoto.camera import DISTORTIONS
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.errors import InputError
from jaxphoto.extras.photos.features import read_grey
from jaxphoto.extras.photos.targets import SYNTAX, find_targets, read_board
from jaxphoto.io import write_block
from jaxphoto.io.photographs import photographs, sensor_and_interior
from jaxphoto.procedures.calibration import calibrate, distortion_model, free_parameters
from jaxphoto.report import prepare_pictures, print_adjustment, verdict_of
from jaxphoto.report.calibration import print_calibration, write_calibration
from jaxphoto.writing import check_folder


@command("calibrate", f"Boards: {', '.join(SYNTAX.values())}.")
def calibrate_command(
    output: Output,
    context: typer.Context,
    images: Annotated[list[Path], typer.Argument(help="Photographs of the board, all by one camera at one focus.")],
    board: Annotated[str, typer.Option(help="What was photographed, in the words above.")],
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    model: Annotated[str, one_of(DISTORTIONS, help="Distortion.")] = "smac",
    r0_mm: Annotated[float, typer.Option(help="Balance radius R0 of SMAC.")] = 0.0,
    free: Annotated[
        str | None, typer.Option(help="What is estimated, by commas: c,xp,yp,k1,... (default: usual).")
    ] = None,
    pixel_mm: Annotated[float | None, typer.Option(help="Size of a pixel (default: from EXIF).")] = None,
    c_mm: Annotated[float | None, typer.Option(help="Principal distance to start from (default: from EXIF).")] = None,
    board_sigma_mm: Annotated[
        float | None, typer.Option(help="Standard deviation of the board's coordinates (default: they are fixed).")
    ] = None,
    max_steps: Annotated[int, typer.Option(min=1, help="Most iterations of an adjustment.")] = jaxphoto.MAX_STEPS,
) -> None:
    """Calibrate a camera with photographs of a board. Exit code 1: written, but not converged or not settled."""
    if board_sigma_mm is not None and not board_sigma_mm > 0:
        raise InputError(f"--board-sigma-mm {board_sigma_mm:g} is not positive; leave it out for a board that is exact")
    check_folder(out, *images)
    pattern, taken = read_board(board), photographs(images)
    start = sensor_and_interior(taken, pixel_mm, c_mm)
    wanted = None if free is None else [name.strip() for name in free.split(",") if name.strip()]
    free_parameters(model, distortion_model(model, start.sensor, r0_mm), wanted)
    Thread(target=prepare_pictures, daemon=True).start()
    began = time.perf_counter()
    with output.progress.status("looking for the board") as status:
        number = count(1)
        look = lambda _: status.update(f"looking for the board: photograph {next(number)} of {len(taken)}")  # noqa: E731
        targets = find_targets(taken, pattern, look)
        seconds = {"read": time.perf_counter() - began}
        status.update(f"calibrating with {len(targets.detections)} photographs")
        done = calibrate(
            pattern.board,
            targets.detections,
            start.sensor,
            start.interior,
            model=model,
            r0_mm=r0_mm,
            free=wanted,
            board_sigma_m=None if board_sigma_mm is None else board_sigma_mm / 1000,
            max_steps=max_steps,
        )
        done = done._replace(left_out=targets.left_out | done.left_out)
        status.update(f"writing {out}")
        pictures = {photograph.name: partial(read_grey, photograph.path) for photograph in taken}
        tables = write_calibration(
            done,
            out,
            seconds,
            pictures,
            lambda folder: write_block(done.adjusted.block, folder / "block"),
            detections=targets.detections,
            start=start.origin,
            made=made_by(context, *images),
            # A size that nobody gave is the unit of every length in the report.
            notes=() if pixel_mm is not None else (start.origin,),
        )
    output.screen.print(start.origin)
    print_adjustment(tables, verdict_of(tables), output.screen)
    print_calibration(done, output.screen)
    output.wrote(out, f"results in {out} (open report.html and photographs.html)")
    if not done.converged:
        raise typer.Exit(1)
