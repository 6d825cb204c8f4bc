"""The command line: read, do, write; one sentence and exit code 2 for what a user can mend."""

import sys
import time
import warnings
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

import jaxphoto
from jaxphoto.errors import JaxphotoError
from jaxphoto.io import convert, read_block
from jaxphoto.procedures import adjust
from jaxphoto.report import Tables, check_target, print_adjustment, warnings_of, write_results
from jaxphoto.statistics import EOP_NAMES

app = typer.Typer(
    help="Differentiable photogrammetry: calibrate a camera as it flies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def _root(
    show_version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    if show_version:
        typer.echo(f"jaxphoto {jaxphoto.__version__}")
        raise typer.Exit


@app.command("adjust")
def adjust_command(
    block: Annotated[Path, typer.Argument(help="Block folder (see docs/block_folder.md).")],
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    rotations: Annotated[
        str, typer.Option(help=f"Rotations the correlations mean: {', '.join(EOP_NAMES)}.")
    ] = "omega_phi_kappa",
    max_steps: Annotated[int, typer.Option(min=1, help="Most iterations.")] = jaxphoto.MAX_STEPS,
) -> None:
    """Adjust a block and write tables, statistics and a report. Exit code 1: written, but not converged."""
    if rotations not in EOP_NAMES:
        raise JaxphotoError(f"--rotations {rotations}: there are {', '.join(EOP_NAMES)}")
    check_target(out)
    console, errors = Console(), Console(stderr=True)
    began = time.perf_counter()
    with errors.status("reading the block") as status:
        read = read_block(block)
        seconds = {"read": time.perf_counter() - began}
        status.update(
            f"adjusting {len(read.images)} images, {len(read.points)} points, "
            f"{len(read.image_points.image)} image points"
        )
        adjusted = adjust(read, max_steps=max_steps)
        status.update("computing statistics")
        tables = Tables(adjusted, rotations)  # type: ignore[arg-type]
        verdict = warnings_of(tables)
        status.update(f"writing {out}")
        times = adjusted.seconds | seconds
        order = ("read", "compile", "solve", "covariance")
        write_results(tables, verdict, out, {name: times[name] for name in order})
    print_adjustment(tables, verdict, console)
    console.print(f"results in {out} (open report.html)", highlight=False)
    if not bool(adjusted.converged):
        raise typer.Exit(1)


@app.command("convert")
def convert_command(
    source: Annotated[Path, typer.Argument(help="File or folder of another program.")],
    block: Annotated[Path, typer.Argument(help="Block folder to write.")],
    source_format: Annotated[
        str | None, typer.Option("--format", help="Format of the source; recognised when not given.")
    ] = None,
) -> None:
    """Turn another program's files into a block folder."""
    convert(source, block, source_format)
    typer.echo(f"wrote {block}")


def main() -> None:
    """Entry point of the command `jaxphoto`."""
    warnings.showwarning = _show_warning
    try:
        app(standalone_mode=True)
    except JaxphotoError as error:
        typer.echo(f"jaxphoto: {error}", err=True)
        sys.exit(2)


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Warnings for the user in one line, without the place in our code."""
    typer.echo(f"warning: {message}", err=True)
