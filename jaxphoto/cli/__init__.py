"""The command line: read, do, write; one sentence and exit code 2 for what a user can mend."""

import re
import sys
import warnings

import jax
import typer

from jaxphoto.cli.app import app
from jaxphoto.cli.console import show_warning
from jaxphoto.errors import JaxphotoError, printable
from jaxphoto.writing import discard_all
from jaxphoto_command import tidy_up, wait_if_ending

__all__ = ["app", "main"]

# What a lean installation leaves out (docs/install.md): how it is imported, and installed.
_LEFT_OUT = {
    "cv2": "jaxphoto[photos]",
    "laspy": "laspy[lazrs]",
    "pyarrow": "pyarrow",
    "rasterio": "rasterio",
    "xarray": "xarray",
}


def main() -> None:
    """Entry point of the command `jaxphoto`."""
    warnings.showwarning = show_warning
    tidy_up.append(discard_all)
    try:
        app(standalone_mode=True)
    except JaxphotoError as error:
        wait_if_ending()
        said = "; ".join([str(error), *getattr(error, "__notes__", [])])
        typer.echo(f"jaxphoto: {said}", err=True)
        sys.exit(2)
    except ModuleNotFoundError as error:
        package = _LEFT_OUT.get((error.name or "").partition(".")[0])
        if package is None:
            raise
        wait_if_ending()
        typer.echo(f"jaxphoto: {package} is needed for this and not there: pip install '{package}'", err=True)
        sys.exit(2)
    except OSError as error:
        wait_if_ending()
        where = error.filename if error.filename is not None else "a file"
        typer.echo(
            f"jaxphoto: {printable(str(where))}: {error.strerror or error}; name a place that can be read and written",
            err=True,
        )
        sys.exit(2)
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        # XLA has one error for everything.
        if isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        wait_if_ending()
        asked = re.search(r"[\d.]+ ?(bytes|[KMGTPE]iB)", str(error))
        wanted = f": {asked[0]} were asked for at once" if asked else ""
        typer.echo(
            f"jaxphoto: memory does not suffice{wanted}; close other programs, take a larger machine, or give it less "
            "(a part of the block, fewer points or returns)",
            err=True,
        )
        sys.exit(2)
