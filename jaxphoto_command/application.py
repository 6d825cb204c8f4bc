"""The typer application, its entry point, and the registration of commands."""

import ctypes
import functools
import gc
import inspect
import sys
from collections.abc import Callable
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer import Option

from jaxphoto_command.output import Output

_Function = Callable[..., None]
_PANEL = "Output"
_COMMON = {
    "json": Annotated[bool, Option("--json", help="Print one JSON object, for programs.", rich_help_panel=_PANEL)],
    "quiet": Annotated[bool, Option("--quiet", "-q", help="Print only warnings and errors.", rich_help_panel=_PANEL)],
    "verbose": Annotated[
        bool, Option("--verbose", "-v", help="Log each step, iteration and compilation.", rich_help_panel=_PANEL)
    ],
}
# Numbers of new objects, and of younger collections, before a generation is collected (`gc.set_threshold`).
_THRESHOLDS = (100_000, 50, 100)
# Parameter M_ARENA_MAX of glibc's mallopt (malloc.h).
_ARENA_MAX = -8

app = typer.Typer(
    help="Differentiable photogrammetry: calibrate a camera as it flies.",
    epilog="Start with: jaxphoto example cross_block, then jaxphoto adjust cross_block --out results",
    context_settings={"help_option_names": ["-h", "--help"]},
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@app.callback(invoke_without_command=True)
def root(show_version: Annotated[bool, Option("--version", help="Print the version and exit.")] = False) -> None:
    """Print the version."""
    if show_version:
        typer.echo(f"jaxphoto {version('jaxphoto')}")
        raise typer.Exit


def command(name: str, panel: str, example: str, more: str = "") -> Callable[[_Function], _Function]:
    """Register a function of an `Output` and options as a command with --json, --quiet and --verbose.

    `more` is an additional paragraph of the help, after the docstring.
    """

    def register(function: _Function) -> _Function:
        @functools.wraps(function)
        def run(context: typer.Context, json: bool, quiet: bool, verbose: bool, **options: Any) -> None:
            with Output(context, json, quiet, verbose) as output:
                function(output, **options)

        kind = inspect.Parameter.KEYWORD_ONLY
        common = [inspect.Parameter(n, kind, default=False, annotation=a) for n, a in _COMMON.items()]
        options = [p.replace(kind=kind) for p in inspect.signature(function).parameters.values()][1:]
        parameters = [inspect.Parameter("context", kind, annotation=typer.Context), *options, *common]
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in parameters}
        paragraphs = [*(inspect.getdoc(function) or "").split("\n\n"), more]
        text = "\n\n".join(" ".join(part.split()) for part in paragraphs if part)
        app.command(name, help=text, epilog=f"Example: {example}", rich_help_panel=panel)(run)
        return function

    return register


def main() -> None:
    """Run the command line. An error of the user gives one sentence and exit code 2."""
    share_one_pool()
    # A command creates objects that live to its end: collecting as often as by default takes a tenth of its time.
    gc.set_threshold(*_THRESHOLDS)
    try:
        app(prog_name="jaxphoto")
    except (KeyboardInterrupt, SystemExit) as stop:
        # Treat exit code 130 as an interruption: typer exits with it.
        if isinstance(stop, SystemExit) and stop.code != 130:
            raise
        typer.echo("jaxphoto: interrupted", err=True)
        sys.exit(130)
    except Exception as error:
        text = message(error)
        if text is None:
            raise
        typer.echo(f"jaxphoto: {text}", err=True)
        sys.exit(2)


def message(error: Exception) -> str | None:
    """Return the message of an error that a user can resolve; None for any other error."""
    from jaxphoto.errors import JaxphotoError
    from jaxphoto.optional import EXTRAS, MissingExtra

    if isinstance(error, JaxphotoError):
        return "; ".join([str(error), *getattr(error, "__notes__", [])])
    if isinstance(error, ModuleNotFoundError):
        module = (error.name or "").partition(".")[0]
        return str(MissingExtra(module)) if module in EXTRAS else None
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}. Give a path that can be read and written."
    # Match the text of the error: XLA has a single class for all its errors.
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "not enough memory. Close other programs, or reduce the input (a part of the block, fewer points)."
    return None


def share_one_pool() -> None:
    """Make all threads allocate from one glibc arena. Call it before threads are started.

    An arena of a thread returns large arrays to the system at once, and each new array costs page faults.
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(_ARENA_MAX, 1)
