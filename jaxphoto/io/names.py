"""What ids and names of files may not be, because of the places where results show them.

A control character is a command to a terminal, and characters that turn the direction of writing show another name
than there is. What begins like a formula is computed by a spreadsheet that opens the results: such names are refused
rather than changed, so that all tables have the ids of the user's files.
"""

import fnmatch
import re
from collections.abc import Iterable, Sequence

from jaxphoto.errors import InputError

LONGEST = 256
"""Characters of a name."""
# Without the end of a line.
_UNSEEN = "\x00-\x09\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff"
_CONTROL = re.compile(f"[\n{_UNSEEN}]")
# A signed word or number (-1, +5a) is what it looks like.
_FORMULA = re.compile(r"\s*(?:[=@]|[-+](?![\w.]*$))")


def harm_in(name: str) -> str:
    """What is wrong with a name, and the mend; empty where nothing is."""
    if len(name) > LONGEST:
        return f"has {len(name)} characters, and a name has at most {LONGEST}; give it a shorter one"
    if control_in(name):
        return "has a control character, which a terminal would obey; give it another name"
    if _FORMULA.match(name):
        return "begins like a formula, which a spreadsheet would compute; give it another name"
    return ""


def points_called(points: Sequence[str], names: Iterable[str], where: str) -> tuple[str, ...]:
    """The points that names mean, in which * stands for any letters. Raises InputError for one that means none."""
    named = {name: [point for point in points if fnmatch.fnmatchcase(point, name)] for name in names}
    for name, found in named.items():
        if not found:
            raise InputError(f"{where} {name}: no point of the block is called so; correct the name")
    return tuple(dict.fromkeys(point for found in named.values() for point in found))


def control_in(text: str) -> bool:
    """Whether a text has characters that are commands, or that cannot be written."""
    return _CONTROL.search(text) is not None
