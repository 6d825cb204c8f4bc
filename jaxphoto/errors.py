"""The errors a user can cause, each one sentence that names the place and the mend.

Every message says what was found, where (file, row, id or unknown), and what to do. A failed solve is
not an error: it is an outcome of the result (see `jaxphoto.adjustment.result.Outcome`).
"""

import re
import reprlib
from collections.abc import Iterable, Sequence

# Of a message: what is longer is left out in the middle, because the place stands first and the mend last.
_BEGINNING, _END = 900, 500
# Of one word (a path may be as long), and of a value that is quoted.
_WORD = re.compile(r"\S{400,}")
_QUOTED = 100


def shown(text: str) -> str:
    """`text` as it may stand in one line of a terminal: what cannot be printed is escaped, and what is long is cut.

    Names and cells of files are in messages; their control characters would be commands to the terminal.
    """
    return _WORD.sub(lambda word: f"{word[0][:200]}...{word[0][-50:]}", printable(_short(text)))


def printable(text: str) -> str:
    """`text` with escapes in place of what cannot be printed."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def quoted(value: object) -> str:
    """`repr(value)`, short whatever the value: for messages."""
    return _SHORT.repr(value)


class JaxphotoError(ValueError):
    """Anything a user can mend; the command line prints it as one sentence and ends with exit code 2."""

    def __init__(self, message: str = ""):
        super().__init__(shown(message))


class InputError(JaxphotoError):
    """A file, a row or a number that cannot be read as what it claims to be."""


class RowError(InputError):
    """Rows of a file, of which the message names the first; `rows` are the numbers of all that are wrong in that way.

    What reads them may go on without them.
    """

    def __init__(self, message: str, rows: Iterable[int]):
        super().__init__(message)
        self.rows = frozenset(rows)


class BlockError(JaxphotoError):
    """Observations that cannot make an adjustment: unknown ids, too few rays, points behind the camera."""


class GroupsError(BlockError):
    """Images in `groups` (of their names) that nothing orients to one another, though matches join them."""

    def __init__(self, message: str, groups: Iterable[Iterable[str]]):
        super().__init__(message)
        self.groups = tuple(frozenset(group) for group in groups)


class DatumError(JaxphotoError):
    """A block whose observations leave its position, orientation or scale undetermined."""


class RankError(JaxphotoError):
    """Unknowns that the observations cannot tell apart, although the datum is determined.

    `points` are the numbers of object points where they alone are at fault: rays that do not place them.
    """

    def __init__(self, message: str = "", points: Sequence[int] = ()):
        super().__init__(message)
        self.points = tuple(points)


def few(names: Sequence[str], joint: str = ", ") -> str:
    """The first three names, and how many more there are."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return joint.join(names[:_NAMED]) + more


_NAMED = 3


def counted(number: int, thing: str) -> str:
    """1 point, or 2 points."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def camera_words(name: str) -> str:
    """How a sentence calls a camera: by its name, but for one that is called just that."""
    return "the camera" if name == "camera" else f"camera {name}"


def _short(text: str) -> str:
    return text if len(text) <= _BEGINNING + _END else f"{text[:_BEGINNING]} ... {text[-_END:]}"


_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = _QUOTED
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 8
