"""Options that take one of a list of names, which help shows and a shell completes, or a number that is one."""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import typer

from jaxphoto.errors import InputError

# Longer lists leave no room for help beside them.
_WIDE = 20


def one_of(
    names: Iterable[str], *words: str, help: str, about: Mapping[str, str] = MappingProxyType({})
) -> typer.models.OptionInfo:
    """An option, called as the argument or by `words`, whose value is one of `names`, or the default.

    Any other raises InputError before the command begins. Help shows what is told `about` each.
    """
    known = tuple(names)

    def check(param: typer.CallbackParam, value: str | None) -> str | None:
        if value is not None and value not in known:
            raise InputError(f"{param.opts[0]} {value}: there are {', '.join(known)}")
        return value

    def begun(incomplete: str) -> list[str]:
        return [name for name in known if name.startswith(incomplete)]

    listed = " | ".join(known)
    if about:
        listed, help = "NAME", "\n\n".join([help, *(f"{name}: {what}" for name, what in about.items())])
    elif len(listed) > _WIDE:
        listed, help = "NAME", f"{help} One of: {', '.join(known)}."
    # `str` in place of what typer makes of a Literal, whose error looks like none of ours.
    return typer.Option(*words, metavar=listed, help=help, parser=str, callback=check, autocompletion=begun)


# Before it had the name that it has everywhere, OUT came second.
Second = Annotated[Path | None, typer.Argument(hidden=True, metavar="OUT")]


def place(out: Path | None, second: Path | None) -> Path:
    """Where to write, by --out or as the second argument. Raises InputError where it is told twice or not at all."""
    if out is not None and second is not None:
        raise InputError(f"--out {out} and {second} are two places to write to; name one")
    told = out if out is not None else second
    if told is None:
        raise InputError("nothing says where to write: add --out")
    return told


def seconds(help: str) -> typer.models.OptionInfo:
    """An option whose value is a finite number of seconds. Any other raises InputError before the command begins."""
    return _number(help, "a number of seconds", -math.inf)


def positive(help: str) -> typer.models.OptionInfo:
    """An option whose value is a positive finite number, or its default, likewise."""
    return _number(help, "a positive number", 0.0)


def _number(help: str, what: str, above: float) -> typer.models.OptionInfo:
    def check(param: typer.CallbackParam, value: float | None) -> float | None:
        if value is not None and not above < value < math.inf:
            raise InputError(f"{param.opts[0]} {value:g}: give {what}")
        return value

    return typer.Option(help=help, callback=check)
