"""How results came about: command, versions, date, and the hashes of what was read."""

import datetime
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

from jaxphoto.report.document import Element, Heading, Rows
from jaxphoto.writing.inputs import InputFile

PROVENANCE = "Provenance"
_PACKAGES = ("jaxphoto", "jax", "optimistix", "equinox", "lineax", "numpy", "pandas")


class Made(NamedTuple):
    """How results came about."""

    command: str
    """As it is typed, without where its results went."""
    inputs: Sequence[InputFile] = ()


def made_section(made: Made) -> Iterator[Element]:
    """The section of a report that says it."""
    yield Heading(PROVENANCE)
    rows = [
        ("computed", datetime.date.today().isoformat()),
        ("command", made.command),
        ("versions", ", ".join(f"{name} {number}" for name, number in versions().items())),
    ]
    yield Rows(("", ""), tuple(rows))
    if made.inputs:
        files = tuple((f.file, str(f.n_bytes), f.sha256) for f in made.inputs)
        yield Rows(("file", "bytes", "SHA-256"), files)


def versions() -> dict[str, str]:
    """Versions of jaxphoto and of what its numbers depend on."""
    return {name: version(name) for name in _PACKAGES}


def option_word(value: Any) -> str:
    """An option as a person says it."""
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    if isinstance(value, list | tuple):
        return " ".join(map(str, value))
    return str(value)
