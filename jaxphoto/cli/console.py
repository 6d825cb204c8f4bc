"""Where commands print: names of files and of users are text there, never markup or commands to a terminal."""

import re
import time
from collections.abc import Callable
from threading import Event, Thread

import typer
from rich.console import Console, RenderableType
from rich.status import Status
from rich.text import Text

from jaxphoto.cli.progress import Pace, in_words
from jaxphoto.errors import printable, shown

# Between lines off a terminal; and of one step where a line is wanted of each.
_LINE_S, _STEP_S = 30.0, 2.0
_NUMBERED = re.compile(r"(.*[a-z]) (\d+) of (\d+)")
# Before it is worth saying how long a step has taken.
_LONG_S = 2.0


class PlainStatus(Status):
    """What is being done, as plain text, and for how long; off a terminal, where nothing moves, a line now and then.

    Where it says "image 3 of 9", it says how long the rest takes, too. `each_step` is told of all that is done.
    """

    def __init__(
        self,
        status: str,
        clock: Callable[[], float] = time.monotonic,
        line_s: float = _LINE_S,
        each_step: Callable[[str], None] | None = None,
        **options,
    ) -> None:
        self._clock, self._line_s, self._each_step, self._pace = clock, line_s, each_step, Pace(clock)
        self._text, self._began, self._last_step, self._stopped = "", 0.0, 0.0, Event()
        super().__init__(_Now(self.line), **options)
        self.update(status)

    def update(self, status: RenderableType | None = None, **options) -> None:
        """What is done from now on."""
        if not isinstance(status, str):
            super().update(status, **options)
            return
        if numbered := _NUMBERED.fullmatch(status):
            what, number, of = numbered[1], int(numbered[2]), int(numbered[3])
            if number == 1:
                self._pace.begins()
            left = self._pace.left(what, number - 1, of)
            status += f", {in_words(left)} left" if number > 1 else ""
        now, new = self._clock(), _step(status) != _step(self._text)
        self._text = status
        if new:
            self._began = now
        if self._each_step and (new or now - self._last_step >= _STEP_S):
            self._last_step = now
            self._each_step(status)

    def line(self) -> str:
        """What is being done, and for how many seconds where it does not say how many are left."""
        since = self._clock() - self._began
        return self._text if since < _LONG_S or self._text.endswith(" left") else f"{self._text} ({since:.0f} s)"

    def start(self) -> None:
        """Begin to show it."""
        super().start()
        if not self.console.is_terminal and not self._each_step:
            self._stopped.clear()
            Thread(target=self._say_now_and_then, daemon=True).start()

    def stop(self) -> None:
        """Show it no longer."""
        self._stopped.set()
        super().stop()

    def _say_now_and_then(self) -> None:
        while not self._stopped.wait(self._line_s):
            self.console.print(Text(_lines(self.line())), soft_wrap=True)


class _Now:
    """A line as it reads whenever it is drawn."""

    def __init__(self, line: Callable[[], str]) -> None:
        self._line = line

    def __rich__(self) -> Text:
        return Text(_lines(self._line()))


class _PlainConsole(Console):
    """A console to which no text is markup, an emoji or a command."""

    def __init__(self, each_step: Callable[[str], None] | None, **options) -> None:
        super().__init__(**options)
        self._each_step = each_step

    def render_str(self, text: str, **options) -> Text:
        return super().render_str(_lines(text), **options)

    def status(self, status: RenderableType, **options) -> Status:
        return PlainStatus(str(status), each_step=self._each_step, console=self, **options)


def plain_console(
    *, stderr: bool = False, quiet: bool = False, each_step: Callable[[str], None] | None = None
) -> Console:
    """A console that prints names as they are: what is markup of rich's in them stays text. Or nothing, if `quiet`.

    Its status tells `each_step`, if there is such, of all that is done.
    """
    return _PlainConsole(each_step, stderr=stderr, markup=False, highlight=False, emoji=False, quiet=quiet)


def show_warning(message: object, *_: object, **__: object) -> None:
    """A Python warning in one line, without the place in our code."""
    typer.echo(f"warning: {shown(str(message))}", err=True)


def _step(text: str) -> str:
    """A status without how far it is."""
    return re.split(r":|\d+ of \d+", text)[0]


def _lines(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))
