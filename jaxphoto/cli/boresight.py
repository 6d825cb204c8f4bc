"""`jaxphoto boresight`: a block in, the misalignment of its camera in four steps out."""

import time
from pathlib import Path
from typing import Annotated

import typer

import jaxphoto
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.io import read_block
from jaxphoto.procedures import boresight
from jaxphoto.report import print_boresight, write_boresight
from jaxphoto.writing import check_folder


@command("boresight")
def boresight_command(
    output: Output,
    context: typer.Context,
    block: Annotated[Path, typer.Argument(help="Block folder (see docs/block_folder.md).")],
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    go_on: Annotated[
        bool, typer.Option("--go-on", help="Go on after a step that it makes no sense to go on from.")
    ] = False,
    max_steps: Annotated[int, typer.Option(min=1, help="Most iterations of each adjustment.")] = jaxphoto.MAX_STEPS,
) -> None:
    """Boresight misalignment in four steps. Exit code 1: written, but a step is not passed or not converged."""
    check_folder(out, block)
    began = time.perf_counter()
    with output.progress.status("reading the block") as status:
        read, made = read_block(block), made_by(context, block)
        seconds = {"read": time.perf_counter() - began}
        steps = boresight(read, go_on=go_on, max_steps=max_steps, report=status.update)
        status.update(f"writing {out}")
        write_boresight(steps, out, seconds, made)
    print_boresight(steps, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
    if not all(step.go_on for step in steps):
        raise typer.Exit(1)
