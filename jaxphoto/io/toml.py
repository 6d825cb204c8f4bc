"""TOML as every reader gets it: a file of bounded size, depth and numbers, without names that do harm."""

import re
import tomllib
from pathlib import Path
from typing import Any

from jaxphoto.errors import InputError, quoted
from jaxphoto.io.names import control_in, harm_in
from jaxphoto.io.whole_text import SMALL, read_text

# Tables in tables and lists in lists; the deepest here are five.
_DEEPEST = 20
# The range of TOML's whole numbers. Longer ones are neither counted nor printed in reasonable time.
_LARGEST = 2**63
# Between two commas, brackets or signs of equality: the time that a key takes grows with the square of its points.
_POINTS = 500


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as it stands.

    Raises InputError with the line of a syntax error, and for what no file here needs: deep tables, whole numbers that
    are larger than TOML has, keys that cannot be names.
    """
    text = read_text(path, SMALL)
    for row, line in enumerate(text.split("\n"), start=1):
        if line.count(".") > _POINTS and max(part.count(".") for part in re.split(r"[=,\[\]{}]", line)) > _POINTS:
            raise InputError(f"{path.name}, row {row}: a name has more than {_POINTS} points; give it fewer")
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path.name}: {error}; correct the TOML there") from None
    except RecursionError:
        raise InputError(f"{path.name}: lists or tables are nested too deeply; write them flat") from None
    except ValueError:
        # Of Python's conversion of digits.
        raise InputError(f"{path.name}: a number has more digits than can be read; shorten it") from None
    _check(path.name, values)
    return values


def _check(file: str, values: dict[str, Any]) -> None:
    """Raise InputError for depth, whole numbers, keys and control characters; without recursion."""
    waiting: list[tuple[str, Any, int]] = [("", values, 0)]
    while waiting:
        place, value, depth = waiting.pop()
        if depth > _DEEPEST:
            raise InputError(f"{file}, {place}: lists or tables are nested too deeply; write them flat")
        if isinstance(value, dict):
            for key, below in value.items():
                if harm := harm_in(key):
                    raise InputError(f"{file}, [{place}]: the key {quoted(key)} {harm}".replace(" [],", ""))
                waiting.append((f"{place}.{key}" if place else key, below, depth + 1))
        elif isinstance(value, list):
            waiting += [(place, below, depth + 1) for below in value]
        elif isinstance(value, str) and control_in(value.replace("\t", " ").replace("\n", " ")):
            raise InputError(f"{file}, {place}: {quoted(value)} has a control character; write plain text")
        elif isinstance(value, int) and not -_LARGEST <= value < _LARGEST:
            raise InputError(f"{file}, {place}: a whole number is larger than TOML has; write it like 12.34")
