"""`jaxphoto convert`: another program's files in, a block folder out."""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.app import app
from jaxphoto.io import convert


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
