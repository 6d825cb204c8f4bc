"""Errors caused by input: one sentence each, with the location and the cure.

Every message specifies the problem, the location (file, row, id or unknown), and the cure. A solution that fails is not
an error but an outcome of the result (see `jaxphoto.adjustment.result.Outcome`).
"""

import re
import reprlib
from collections.abc import Iterable, Sequence

# Maximum length of a message in characters. Longer messages are cut in the middle: the location is at the start, the
# cure at the end.
_BEGINNING, _END = 900, 500
# Maximum lengths of one word (a path may be this long), and of a quoted value, in characters.
_WORD = re.compile(r"\S{400,}")
_QUOTED = 100


def shown(text: str) -> str:
    """Return `text` for one line of a terminal: escape unprintable characters, shorten long words.

    Messages contain names and cells of files, whose control characters a terminal would execute.
    """
    return _WORD.sub(lambda word: f"{word[0][:200]}...{word[0][-50:]}", printable(_short(text)))


def printable(text: str) -> str:
    """Escape unprintable characters."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def quoted(value: object) -> str:
    """Return `repr(value)`, shortened: for messages."""
    return _SHORT.repr(value)


class JaxphotoError(ValueError):
    """Any error the user can correct; the command line prints it as one sentence and exits with code 2."""

    def __init__(self, message: str = ""):
        super().__init__(shown(message))


class InputError(JaxphotoError):
    """File, row or value that cannot be read."""


class RowError(InputError):
    """Invalid rows of a file: the message names the first; `rows` are the numbers of all rows with this error.

    Readers may continue without them.
    """

    def __init__(self, message: str, rows: Iterable[int]):
        super().__init__(message)
        self.rows = frozenset(rows)


class BlockError(JaxphotoError):
    """Observations that cannot form an adjustment: unknown ids, too few rays, points behind the camera."""


class GroupsError(BlockError):
    """Images in `groups` (of names) that cannot be oriented relative to each other, although matches connect them."""

    def __init__(self, message: str, groups: Iterable[Iterable[str]]):
        super().__init__(message)
        self.groups = tuple(frozenset(group) for group in groups)


class DatumError(JaxphotoError):
    """Block whose observations leave position, orientation or scale undetermined."""


class RankError(JaxphotoError):
    """Unknowns that the observations cannot separate, although the datum is determined.

    `points` are the indices of object points if the cause is only that their rays do not determine them.
    """

    def __init__(self, message: str = "", points: Sequence[int] = ()):
        super().__init__(message)
        self.points = tuple(points)


def few(names: Sequence[str], joint: str = ", ") -> str:
    """Format the first three names, and the number of others."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return joint.join(names[:_NAMED]) + more


_NAMED = 3


def counted(number: int, thing: str) -> str:
    """Format a count: 1 point, or 2 points."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def camera_words(name: str) -> str:
    """Return the name of a camera for a sentence; "the camera" if its name is "camera"."""
    return "the camera" if name == "camera" else f"camera {name}"


def _short(text: str) -> str:
    return text if len(text) <= _BEGINNING + _END else f"{text[:_BEGINNING]} ... {text[-_END:]}"


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = _QUOTED
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 8
