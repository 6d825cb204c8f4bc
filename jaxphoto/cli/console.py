"""Where commands print: names of files and of users are text there, never markup or commands to a terminal."""

import time
from collections.abc import Callable

from rich.console import Console, RenderableType
from rich.status import Status
from rich.text import Text

from jaxphoto.errors import printable

# Between lines off a terminal.
_LINE_S = 30.0


class PlainStatus(Status):
    """What is being done, as plain text: off a terminal, where nothing moves, a line of it now and then."""

    def __init__(self, status: RenderableType, clock: Callable[[], float] = time.monotonic, **options):
        super().__init__(_plain(status), **options)
        self._clock, self._last_line = clock, clock()

    def update(self, status: RenderableType | None = None, **options) -> None:
        """What is done from now on."""
        super().update(None if status is None else _plain(status), **options)
        now = self._clock()
        if status is not None and not self.console.is_terminal and now - self._last_line >= _LINE_S:
            self.console.print(_plain(status), soft_wrap=True)
            self._last_line = now


class _PlainConsole(Console):
    """A console to which no text is markup, an emoji or a command."""

    def render_str(self, text: str, **options) -> Text:
        return super().render_str(_lines(text), **options)

    def status(self, status: RenderableType, **options) -> Status:
        return PlainStatus(status, console=self, **options)


def plain_console(*, stderr: bool = False, quiet: bool = False) -> Console:
    """A console that prints names as they are: what is markup of rich's in them stays text. Or nothing, if `quiet`."""
    return _PlainConsole(stderr=stderr, markup=False, highlight=False, emoji=False, quiet=quiet)


def _plain(text: RenderableType) -> RenderableType:
    return Text(_lines(text)) if isinstance(text, str) else text


def _lines(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))
