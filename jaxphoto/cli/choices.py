"""Options that take one of a list of names: help shows the list, a shell completes it, anything else is refused."""

from collections.abc import Iterable

import typer

from jaxphoto.errors import InputError


def one_of(names: Iterable[str], *words: str, help: str) -> typer.models.OptionInfo:
    """An option, called as the argument or by `words`, whose value is one of `names`, or the default.

    Any other raises InputError before the command begins.
    """
    known = tuple(names)

    def check(param: typer.CallbackParam, value: str | None) -> str | None:
        if value is not None and value not in known:
            raise InputError(f"{param.opts[0]} {value}: there are {', '.join(known)}")
        return value

    def begun(incomplete: str) -> list[str]:
        return [name for name in known if name.startswith(incomplete)]

    # `str` in place of what typer makes of a Literal, whose error looks like none of ours.
    return typer.Option(*words, metavar=" | ".join(known), help=help, parser=str, callback=check, autocompletion=begun)
