"""One-line descriptions of calibration boards, as on the command line.

chessboard:8x6:square_mm=30            inner corners: columns x rows
circles:4x11:spacing_mm=20:diameter_mm=15
charuco:7x5:square_mm=30:marker_mm=22:dictionary=4X4_50
"""

from collections.abc import Callable

from jaxphoto.errors import InputError
from jaxphoto.extras.photos.targets.circles import CircleGrid
from jaxphoto.extras.photos.targets.markers import DICTIONARIES, CharucoBoard, Chessboard
from jaxphoto.extras.photos.targets.pattern import Pattern
from jaxphoto.io.text_tables import is_number

SYNTAX = {
    "chessboard": "chessboard:8x6:square_mm=30",
    "circles": "circles:4x11:spacing_mm=20:diameter_mm=15",
    "charuco": "charuco:7x5:square_mm=30:marker_mm=22:dictionary=4X4_50",
}
"""Syntax by kind of board."""

_MADE: dict[str, tuple[Callable[..., Pattern], tuple[str, ...], int]] = {
    "chessboard": (Chessboard, ("square_mm",), 3),
    "circles": (CircleGrid, ("spacing_mm", "diameter_mm"), 2),
    "charuco": (CharucoBoard, ("square_mm", "marker_mm", "dictionary"), 2),
}


def read_board(description: str) -> Pattern:
    """Create a board from a one-line description (mm). Raise InputError, with the syntax, for an invalid one."""
    kind, _, rest = description.partition(":")
    if kind not in SYNTAX:
        raise InputError(f"--board {description}: unknown board {kind!r}; write one of {', '.join(SYNTAX.values())}")
    size, *settings = rest.split(":")
    make, names, least = _MADE[kind]
    counts = size.lower().split("x")
    if len(counts) != 2 or not all(n.isdecimal() and least <= int(n) <= 500 for n in counts):
        raise _bad(description, kind, f"{size!r} is not columns x rows, {least} to 500 each")
    texts: dict[str, str] = {}
    for setting in settings:
        name, sign, value = setting.partition("=")
        if not sign or name not in names or name in texts:
            raise _bad(description, kind, f"{setting!r} is not one of {', '.join(f'{n}=...' for n in names)}")
        texts[name] = value
    if missing := [name for name in names if name not in texts]:
        raise _bad(description, kind, f"{missing[0]} is missing")
    values = {name.removesuffix("_mm"): _value(description, kind, name, text) for name, text in texts.items()}
    try:
        return make(*map(int, counts), **{f"{k}_m" if k != "dictionary" else k: v for k, v in values.items()})
    except ValueError as error:
        raise _bad(description, kind, str(error)) from None


def _value(description: str, kind: str, name: str, text: str) -> float | str:
    if name == "dictionary":
        if text.upper() not in DICTIONARIES:
            raise _bad(description, kind, f"unknown dictionary {text!r} (use one of {', '.join(DICTIONARIES)})")
        return text.upper()
    if not is_number(text) or not 0 < float(text) < 1e6:
        raise _bad(description, kind, f"{name} is {text!r}, not a positive number of millimetres")
    return float(text) / 1000


def _bad(description: str, kind: str, message: str) -> InputError:
    return InputError(f"--board {description}: {message}; write it like {SYNTAX[kind]}")
