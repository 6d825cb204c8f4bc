"""What is said of an adjustment, by how much it matters: alarm, warning, information."""

import enum
import re
from collections.abc import Iterable
from html import escape
from typing import NamedTuple

from jaxphoto.errors import camera_words
from jaxphoto.report.digits import of_p, without_powers


class Level(enum.IntEnum):
    """How much a finding matters; the worst gives the verdict its colour."""

    INFORMATION = 0
    """To be known; nothing need be done."""
    WARNING = 1
    """Results hold with a reservation."""
    ALARM = 2
    """Results are not to be used before this is mended."""


MARKS = {Level.INFORMATION: "-", Level.WARNING: "!", Level.ALARM: "!!"}
_SYMBOLS = {"c_mm": "c", "xp_mm": "x_p", "yp_mm": "y_p"}
COLOURS = {Level.INFORMATION: "green", Level.WARNING: "amber", Level.ALARM: "red"}


class Finding(NamedTuple):
    """One sentence, with its mend."""

    level: Level
    text: str


class Verdict(NamedTuple):
    """All findings, the worst first; within a level in the order in which they were found."""

    findings: tuple[Finding, ...]

    def __repr__(self) -> str:
        return "\n".join([self.headline, *(f"{MARKS[f.level]} {f.text}" for f in self.findings)])

    def _repr_html_(self) -> str:
        """The headline, and below it the findings with their marks."""
        rows = "".join(f"<tr><td>{MARKS[f.level]}</td><td>{escape(f.text)}</td></tr>" for f in self.findings)
        return f"<b>{escape(self.headline)}</b><table>{rows}</table>"

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> "Verdict":
        """The findings in order, parameters called as sentences call them, large numbers written out."""
        told = (Finding(f.level, without_powers(in_symbols(f.text))) for f in findings)
        return cls(tuple(sorted(told, key=lambda f: -f.level)))

    @property
    def level(self) -> Level:
        """The worst of all."""
        return max((f.level for f in self.findings), default=Level.INFORMATION)

    @property
    def colour(self) -> str:
        """green, amber or red."""
        return COLOURS[self.level]

    @property
    def headline(self) -> str:
        """The verdict in one line."""
        n = sum(f.level == self.level for f in self.findings)
        if self.level == Level.ALARM:
            return f"red: not to be used before {'this is' if n == 1 else f'these {n} are'} mended"
        if self.level == Level.WARNING:
            return f"amber: {'one reservation' if n == 1 else f'{n} reservations'}"
        return "green: the observations agree with one another and with their standard deviations"

    @property
    def summary(self) -> dict:
        """What a summary.json says of it."""
        told = [{"level": f.level.name.lower(), "text": f.text} for f in self.findings]
        return {"verdict": self.colour, "findings": told}

    @property
    def texts(self) -> list[str]:
        """The sentences alone."""
        return [f.text for f in self.findings]


def as_sentence(text: str) -> str:
    """A finding as it stands among others on a page: with a capital, but for symbols (c, k2), and a full stop."""
    first = text.split(maxsplit=1)[0] if text.strip() else ""
    begun = text if len(first) == 1 or re.search(r"[_\d]", first) else f"{text[:1].upper()}{text[1:]}"
    return begun if begun.endswith((".", "!", "?")) else f"{begun}."


def symbol(parameter: str) -> str:
    """A parameter as papers and sentences call it: c, which tables name with its unit, c_mm."""
    return _SYMBOLS.get(parameter, parameter)


def parameter_words(path: str) -> str:
    """The parameter at a path, as a sentence calls it: k1 of camera kodak."""
    of_camera = re.fullmatch(r"interior\[(.*)\]\.(\w+)", path)
    return f"{symbol(of_camera[2])} of {camera_words(of_camera[1])}" if of_camera else path


def in_symbols(text: str) -> str:
    """A sentence with paths of cameras' parameters as sentences call them."""
    return re.sub(r"interior\[[^\]]*\]\.\w+", lambda path: parameter_words(path[0]), text)


def p_words(p_value: float, digits: int = 1) -> str:
    """The p-value of a test, as a sentence tells it."""
    said = of_p(p_value, digits)
    return f"p {said}" if said.startswith("<") else f"p = {said}"
