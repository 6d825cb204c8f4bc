"""`jaxphoto convert`: another program's files in, a block folder out; or a block in, a COLMAP model out."""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.app import app
from jaxphoto.cli.console import plain_console
from jaxphoto.errors import InputError
from jaxphoto.io import convert, read_source
from jaxphoto.io.block_folder import check_block_target
from jaxphoto.io.colmap import check_model_target, write_colmap_model

_TARGETS = ("block", "colmap")


@app.command("convert")
def convert_command(
    source: Annotated[Path, typer.Argument(help="File or folder of another program, or a block folder.")],
    out: Annotated[Path, typer.Argument(help="Folder to write.")],
    source_format: Annotated[
        str | None, typer.Option("--format", help="Format of SOURCE; recognised when not given.")
    ] = None,
    to: Annotated[str, typer.Option(help=f"What OUT becomes: {', '.join(_TARGETS)}.")] = "block",
) -> None:
    """Turn another program's files into a block folder, or a block into a COLMAP model."""
    if to not in _TARGETS:
        raise InputError(f"--to {to}: there are {', '.join(_TARGETS)}")
    if to == "block":
        check_block_target(out, source)
        convert(source, out, source_format)
    else:
        check_model_target(out, source)
        for name, conversion in write_colmap_model(read_source(source, source_format), out).items():
            fit = f"fitted, rms {conversion.rms_px:.3g} px, largest {conversion.max_px:.3g} px"
            plain_console().print(f"camera {name}: {'exact' if conversion.max_px == 0 else fit}", soft_wrap=True)
    plain_console().print(f"wrote {out}", soft_wrap=True)
