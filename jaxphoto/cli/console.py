"""Where commands print: names of files and of users are text there, never markup or commands to a terminal."""

from rich.console import Console, RenderableType
from rich.status import Status
from rich.text import Text

from jaxphoto.errors import printable


class _PlainStatus(Status):
    """What is being done, as plain text."""

    def __init__(self, status: RenderableType, **options):
        super().__init__(_plain(status), **options)

    def update(self, status: RenderableType | None = None, **options) -> None:
        super().update(None if status is None else _plain(status), **options)


class _PlainConsole(Console):
    """A console to which no text is markup, an emoji or a command."""

    def render_str(self, text: str, **options) -> Text:
        return super().render_str(_lines(text), **options)

    def status(self, status: RenderableType, **options) -> Status:
        return _PlainStatus(status, console=self, **options)


def plain_console(*, stderr: bool = False) -> Console:
    """A console that prints names as they are: what is markup of rich's in them stays text."""
    return _PlainConsole(stderr=stderr, markup=False, highlight=False, emoji=False)


def _plain(text: RenderableType) -> RenderableType:
    return Text(_lines(text)) if isinstance(text, str) else text


def _lines(text: str) -> str:
    return "\n".join(map(printable, text.split("\n")))
