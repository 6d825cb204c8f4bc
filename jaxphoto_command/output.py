"""Output of a command: text for people, one JSON object for programs, progress on standard error."""

import json
import logging
import shlex
import time
import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

COMPILE_NOTE_S = 2.0
"""Minimum time (s) of waiting for compilations that is reported at the end."""
# Minimum compile time (s) of a program that is logged.
_COMPILE_LOG_S = 0.1
# Name of the records of JAX: a scalar at the start of a compilation, and its duration at the end.
_COMPILED = "/jax/core/compile/backend_compile_duration"
# Note on a compilation in progress, and the time (s) after which it is shown.
_COMPILING, _NOTICEABLE_S = "; compiling (first run of this kind, cached afterwards)", 0.5
_FLAGS = ("json", "quiet", "verbose")
_LOG = logging.getLogger("jaxphoto")


class Progress:
    """Progress of a long operation: a line on a terminal, or log records with --verbose."""

    def __init__(self, bar: "Bar", description: str) -> None:
        self._bar, self._task, self._description = bar, bar.add_task("", total=None), ""
        self.update(description)

    def update(self, description: str) -> None:
        """Start a step of unknown length."""
        self._start(description, None)

    def steps(self, description: str, done: int, total: int | None, note: str = "") -> None:
        """Report that `done` of `total` steps are complete, with a note; rich estimates the remaining time."""
        if description != self._description:
            self._start(description, total)
        self._bar.update(self._task, completed=done, description=f"{description}{note}")

    def _start(self, description: str, total: int | None) -> None:
        self._bar.remove_task(self._task)
        self._task, self._description = self._bar.add_task(description, total=total), description
        _LOG.info(description)


class Output:
    """Results, warnings and progress of one command."""

    def __init__(self, context: typer.Context, as_json: bool, quiet: bool, verbose: bool) -> None:
        if quiet and verbose:
            raise typer.BadParameter("--quiet and --verbose contradict each other. Omit one of them.")
        from rich.console import Console

        self.context, self._json, self._quiet = context, as_json, quiet
        plain = {"markup": False, "highlight": False, "emoji": False}
        self.screen = Console(quiet=quiet or as_json, **plain)  # type: ignore[arg-type]
        """Console of the results."""
        self._start, self._warnings, self._files = time.perf_counter(), list[str](), list[str]()
        self._summary, self._compile_s = dict[str, Any](), defaultdict[str, float](float)
        self._compilations, self._waited_s = list[float](), 0.0
        self._log = logging.StreamHandler() if verbose else None

    def __enter__(self) -> "Output":
        # Import jaxphoto before JAX: it sets environment variables that JAX reads.
        import jaxphoto  # noqa: F401

        self._showwarning = warnings.showwarning
        warnings.showwarning = lambda message, *_, **__: self.warn(str(message))
        if self._log:
            self._log.setFormatter(logging.Formatter("{relativeCreated:9.0f} ms  {message}", style="{"))
            _LOG.addHandler(self._log)
            _LOG.setLevel(logging.INFO)
        import jax.monitoring

        jax.monitoring.register_scalar_listener(self._compiling)
        jax.monitoring.register_event_duration_secs_listener(self._compiled)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, traceback: object) -> None:
        import jax.monitoring

        jax.monitoring.unregister_scalar_listener(self._compiling)
        jax.monitoring.unregister_event_duration_listener(self._compiled)
        warnings.showwarning = self._showwarning
        if self._log:
            _LOG.removeHandler(self._log)
            _LOG.setLevel(logging.NOTSET)
        if error is None or isinstance(error, typer.Exit):
            self._end(0 if error is None else error.exit_code)

    @contextmanager
    def progress(self, description: str) -> Iterator[Progress]:
        """Display progress of a long operation on standard error."""
        from rich import progress
        from rich.console import Console
        from rich.text import Text

        class Description(progress.ProgressColumn):
            def render(column, task: progress.Task) -> Text:
                return Text(task.description + (_COMPILING if self._is_compiling else ""))

        class Remaining(progress.TimeRemainingColumn):
            """Remaining time of steps of equal cost; empty while a program is compiled."""

            def render(column, task: progress.Task) -> Text:
                return super().render(task) if task.total is not None and not self._is_compiling else Text()

        columns = (
            progress.SpinnerColumn(),
            Description(),
            progress.BarColumn(),
            progress.TimeElapsedColumn(),
            Remaining(),
        )
        console = Console(stderr=True)
        hidden = self._quiet or self._log is not None or not console.is_terminal
        with progress.Progress(*columns, console=console, transient=True, redirect_stdout=False, disable=hidden) as bar:
            yield Progress(bar, description)

    def warn(self, text: str) -> None:
        """Print a warning about the input or the results."""
        self._warnings.append(text)
        typer.echo(f"warning: {text}", err=True)

    def say(self, *lines: str) -> None:
        """Print lines of the results."""
        for line in lines:
            self.screen.print(line, soft_wrap=True)

    def table(self, title: str, headings: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> None:
        """Print a table of the results."""
        from rich.table import Table

        table = Table(title=title)
        for heading in headings:
            # Wrap long numbers instead of truncating them.
            table.add_column(heading, overflow="fold")
        for row in rows:
            table.add_row(*row)
        self.screen.print(table)

    def wrote(self, path: Path, text: str) -> None:
        """Report a written file or folder; its summary.json is added to the JSON object."""
        from jaxphoto.io.text_files import read_json
        from jaxphoto.writing import files_in

        inside = files_in(path) if path.is_dir() else []
        self._files += [str(path / name) for name in inside] or [str(path)]
        if "summary.json" in inside:
            self.add(**read_json(path / "summary.json"))
        self.say(text)

    def add(self, **values: Any) -> None:
        """Add values to the summary of the JSON object."""
        self._summary |= values

    def command_line(self) -> str:
        """Return the command line with all options except the output folder, quoted for a shell."""
        words = ["jaxphoto", str(self.context.info_name)]
        for parameter in self.context.command.params:
            value = self.context.params.get(str(parameter.name))
            if parameter.name in ("out", *_FLAGS) or value is None or value is False or value == "":
                continue
            values = [str(v) for v in value] if isinstance(value, list | tuple) else [str(value)]
            if parameter.param_type_name == "argument":
                words += values
            elif value is True:
                words.append(parameter.opts[0])
            else:
                words += (word for v in values for word in (parameter.opts[0], v))
        return shlex.join(words)

    def command_record(self, *inputs: Path | None) -> Any:
        """Return the command line and the hashes of its input files and folders."""
        from jaxphoto.report.page import CommandRecord
        from jaxphoto_command.certificate import hashes

        return CommandRecord(
            self.command_line(), [file for path in inputs if path is not None for file in hashes(path)]
        )

    def options(self, **values: Any) -> dict[str, Any]:
        """Return the options that are not paths, updated by `values`, as the method of a result."""
        params = {name: v for name, v in (self.context.params | values).items() if name not in _FLAGS}
        return {
            "method": {
                "command": self.context.info_name,
                **{name: v for name, v in params.items() if v is None or isinstance(v, str | int | float)},
            }
        }

    @property
    def _is_compiling(self) -> bool:
        """True if a program has been compiled for a noticeable time."""
        return any(time.perf_counter() - start > _NOTICEABLE_S for start in tuple(self._compilations))

    def _compiling(self, event: str, value: float, **tags: Any) -> None:
        if event == _COMPILED:
            self._compilations.append(time.perf_counter())

    def _compiled(self, event: str, duration_secs: float, **tags: Any) -> None:
        from jaxphoto.compiling.run import WAITED

        if event == WAITED:
            self._waited_s += duration_secs
        if event == _COMPILED:
            name = str(tags.get("fun_name", "")).removeprefix("jit(").removesuffix(")").removesuffix("_of_arrays")
            self._compile_s[name] += duration_secs
            # Programs may be compiled in parallel: the start of the oldest remains.
            if self._compilations:
                self._compilations.pop()
            if duration_secs >= _COMPILE_LOG_S:
                _LOG.info("compiled %s in %.1f s", name, duration_secs)

    def _end(self, exit_code: int) -> None:
        if not self._json:
            if self._waited_s >= COMPILE_NOTE_S and not self._quiet:
                typer.echo(f"waited {self._waited_s:.1f} s for compilation (cached for similar blocks)", err=True)
            return
        import jaxphoto

        summary, judged = dict(self._summary), self._summary.get("verdict") in ("green", "amber", "red")
        values = {
            "command": self.context.info_name,
            "version": jaxphoto.__version__,
            "exit_code": exit_code,
            "verdict": summary.pop("verdict") if judged else None,
            "findings": summary.pop("findings", []) if judged else [],
            "warnings": self._warnings,
            "written": self._files,
            "summary": summary,
            "seconds": time.perf_counter() - self._start,
            "compiling": {
                "waited_s": self._waited_s,
                "seconds": sum(self._compile_s.values()),
                "programs": self._compile_s,
            },
        }
        # Write arrays as lists, paths as text, and NaN and infinity as null: JSON has neither.
        text = json.dumps(values, default=lambda v: v.tolist() if hasattr(v, "tolist") else str(v))
        typer.echo(json.dumps(json.loads(text, parse_constant=lambda _: None), indent=2))
