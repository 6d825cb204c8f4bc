"""What a command tells, and to whom: a person who looks on, or a program that reads one JSON object.

Every command has `--json`, `--quiet` and `--verbose`; they are declared and obeyed here alone.
"""

import copy
import functools
import inspect
import json
import logging
import math
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import typer

import jaxphoto
from jaxphoto.cli.app import ReadableCommand, app
from jaxphoto.cli.compile_times import CompileTimes
from jaxphoto.cli.console import plain_console, show_warning
from jaxphoto.errors import InputError, shown
from jaxphoto.io.json_file import read_json
from jaxphoto.report.findings import COLOURS
from jaxphoto.report.terminal import plain, print_warning
from jaxphoto.writing import files_in

_PANEL = "What is told"
_OPTIONS = {
    "as_json": typer.Option("--json", help="Print one JSON object, for programs.", rich_help_panel=_PANEL),
    "quiet": typer.Option("--quiet", "-q", help="Print warnings and errors alone.", rich_help_panel=_PANEL),
    "verbose": typer.Option(
        "--verbose", "-v", help="A line for each step, iteration and program compiled.", rich_help_panel=_PANEL
    ),
}
OF_OUTPUT = tuple(_OPTIONS)
"""Parameters of every command, which say nothing of how its results come about."""
# What an option takes.
_WORDS = {Path: "PATH", list[Path]: "PATH", list[str]: "NAME", float: "NUMBER", int: "N", str: "TEXT"}
# Less is nobody's concern.
WORTH_TELLING_S = 2.0
"""Of compiling."""
_ADJUSTMENTS = logging.getLogger("jaxphoto.adjustment")


class Output:
    """What one command tells as it goes on, and in the end."""

    def __init__(self, command: str, as_json: bool = False, quiet: bool = False, verbose: bool = False) -> None:
        self._command, self._as_json, self._quiet = command, as_json, quiet
        self._began = time.perf_counter()
        self._warnings, self._files, self._summary = list[str](), list[str](), dict[str, Any]()
        self.screen = plain_console(quiet=quiet or as_json)
        """Where the outcome is printed."""
        self.progress = plain_console(stderr=True, quiet=quiet, each_step=self._line if verbose else None)
        """Where it is told what is being done."""
        self._steps = _Lines(self._line) if verbose else None
        if self._steps:
            _ADJUSTMENTS.addHandler(self._steps)
            _ADJUSTMENTS.setLevel(logging.INFO)
        told = (lambda name, seconds: self._line(f"compiled {name} in {seconds:.1f} s")) if verbose else None
        self._compiled = CompileTimes(told)

    def warn(self, text: str) -> None:
        """Say what speaks against the input or the outcome."""
        self._warnings.append(shown(text))
        print_warning(text, plain_console(stderr=True), soft_wrap=True)

    def show_warning(self, message: object, *_: object, **__: object) -> None:
        """Say a Python warning."""
        self._warnings.append(shown(str(message)))
        show_warning(message)

    def wrote(self, path: Path, sentence: str) -> None:
        """Say in a sentence that a file or folder was written; what a summary.json in it says is told, too."""
        inside = files_in(path) if path.is_dir() else []
        self._files += [str(path / name) for name in inside] or [str(path)]
        if "summary.json" in inside:
            self.tell(**read_json(path / "summary.json"))
        self.say(sentence)

    def say(self, sentence: str) -> None:
        """Say something of the outcome."""
        self.screen.print(plain(sentence), soft_wrap=True)

    def tell(self, **values: Any) -> None:
        """Tell programs more of the outcome."""
        self._summary |= values

    def told(self, exit_code: int) -> dict[str, Any]:
        """All that was told, as docs/command_line.md says."""
        summary, verdict, findings = self._summary, None, []
        if summary.get("verdict") in COLOURS.values():
            summary = dict(summary)
            verdict, findings = summary.pop("verdict"), summary.pop("findings", [])
        return _plain(
            {
                "command": self._command,
                "version": jaxphoto.__version__,
                "exit_code": exit_code,
                "verdict": verdict,
                "findings": findings,
                "warnings": self._warnings,
                "written": self._files,
                "summary": summary,
                "seconds": time.perf_counter() - self._began,
                "compiling": self._compiled.told,
            }
        )

    def end(self, exit_code: int) -> None:
        """Say how long compiling took; or as JSON all that was told."""
        if self._as_json:
            typer.echo(json.dumps(self.told(exit_code), indent=2, allow_nan=False))
        elif self._compiled.seconds >= WORTH_TELLING_S:
            self.progress.print(self._compiled.sentence, soft_wrap=True)

    def close(self) -> None:
        """Hear of nothing more."""
        self._compiled.stop()
        if self._steps:
            _ADJUSTMENTS.removeHandler(self._steps)
            _ADJUSTMENTS.setLevel(logging.NOTSET)

    def _line(self, text: str) -> None:
        said = f"{time.perf_counter() - self._began:7.1f} s  {text}"
        plain_console(stderr=True, quiet=self._quiet).print(plain(said), soft_wrap=True)


class _Lines(logging.Handler):
    """What is logged, as lines."""

    def __init__(self, line: Callable[[str], None]) -> None:
        super().__init__()
        self._told = line

    def emit(self, record: logging.LogRecord) -> None:
        """Tell it."""
        self._told(record.getMessage())


def command(name: str, *more: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function of `output` and options as the command `name`, with the options that every command has.

    `more` are paragraphs of its help after those of the docstring.
    """

    def register(function: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(function)
        def told(as_json: bool, quiet: bool, verbose: bool, **options: Any) -> None:
            if quiet and verbose:
                raise InputError("--quiet and --verbose contradict each other; leave one of them out")
            output = Output(name, as_json, quiet, verbose)
            before, warnings.showwarning = warnings.showwarning, output.show_warning
            try:
                function(output, **options)
            except typer.Exit as stop:
                output.end(stop.exit_code)
                raise
            else:
                output.end(0)
            finally:
                warnings.showwarning = before
                output.close()

        _declare(told, function)
        app.command(name, help=_flowing(function, more), cls=ReadableCommand)(told)
        return function

    return register


def _declare(told: Any, function: Callable[..., None]) -> None:
    """Give `told` the parameters of `function` but the output, and those of every command."""
    own = list(inspect.signature(function).parameters.values())
    if not own or own[0].name != "output":
        raise TypeError(f"{function.__name__} must take what it tells by as its first parameter, output")
    kind = inspect.Parameter.KEYWORD_ONLY
    common = [
        inspect.Parameter(name, kind, default=False, annotation=Annotated[bool, option])
        for name, option in _OPTIONS.items()
    ]
    given = [parameter.replace(kind=kind, annotation=_in_short(parameter)) for parameter in own[1:]]
    told.__signature__ = inspect.Signature([*given, *common])
    told.__annotations__ = {p.name: p.annotation for p in [*given, *common]}


def _flowing(function: Callable[..., None], more: Iterable[str]) -> str:
    """What a function is for, in paragraphs that have no lines of their own."""
    own = (inspect.getdoc(function) or "").split("\n\n")
    return "\n\n".join(" ".join(part.split()) for part in [*own, *more])


def _in_short(parameter: inspect.Parameter) -> Any:
    """The annotation of a parameter, with a word for what it takes, as help shows it."""
    annotation = parameter.annotation
    if get_origin(annotation) is not Annotated:
        return annotation
    of, option = get_args(annotation)
    word: str | None = parameter.name.upper()
    if not isinstance(option, typer.models.ArgumentInfo):
        word = next((word for kind, word in _WORDS.items() if kind is of or kind in get_args(of)), None)
    if option.metavar is not None or word is None:
        return annotation
    option = copy.copy(option)
    option.metavar = word
    return Annotated[of, option]


def _plain(value: Any) -> Any:
    """As JSON has it: no number that is none, no arrays, no paths."""
    if isinstance(value, Mapping):
        return {str(name): _plain(v) for name, v in value.items()}
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, bool | int | str) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return [_plain(v) for v in value] if isinstance(value, Iterable) else str(value)
