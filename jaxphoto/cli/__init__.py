"""The command line: read, do, write; one sentence and exit code 2 for what a user can mend."""

import sys
import warnings

import typer

from jaxphoto.cli.app import app
from jaxphoto.errors import JaxphotoError, printable, shown

__all__ = ["app", "main"]


def main() -> None:
    """Entry point of the command `jaxphoto`."""
    warnings.showwarning = _show_warning
    try:
        app(standalone_mode=True)
    except JaxphotoError as error:
        typer.echo(f"jaxphoto: {error}", err=True)
        sys.exit(2)
    except OSError as error:
        where = error.filename if error.filename is not None else "a file"
        typer.echo(
            f"jaxphoto: {printable(str(where))}: {error.strerror or error}; name a place that can be read and written",
            err=True,
        )
        sys.exit(2)


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Warnings for the user in one line, without the place in our code."""
    typer.echo(f"warning: {shown(str(message))}", err=True)
