"""The application that every command registers with."""

from typing import Annotated

import typer

import jaxphoto

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
