"""Findings about a result (code, severity, subject, value, limit, hint) and the verdict derived from them.

The text of a finding is its template (templates/findings.toml, by code) filled with its values.
"""

import dataclasses
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from importlib.resources import files
from typing import Any, Literal

import pandas as pd

from jaxphoto.errors import camera_words
from jaxphoto.report.formatting import of_p, symbol, without_powers

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""Severities in decreasing order: an error makes results unusable, a warning is a reservation, a note needs no action.
"""
COLOURS: dict[Severity, str] = {"error": "red", "warning": "amber", "note": "green"}
MARKS: dict[Severity, str] = {"error": "!!", "warning": "!", "note": "-"}
# Findings before others of their severity.
_FIRST = ("weights", "rounded", "small_sigma", "common_bias", "external_reliability")
_DECLARED: dict[str, dict[str, str]] = tomllib.loads(
    (files("jaxphoto.report") / "templates" / "findings.toml").read_text(encoding="utf-8")
)


@dataclasses.dataclass(frozen=True)
class Finding:
    """One finding. `numbers` contains additional values and texts for its template."""

    code: str
    severity: Severity
    subject: str = ""
    value: float = math.nan
    limit: float = math.nan
    hint: str = ""
    """Cure; by default that of the code."""
    numbers: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "hint", self.hint or _DECLARED["hint"].get(self.code, ""))

    @property
    def text(self) -> str:
        """Text of the finding, followed by its hint."""
        fields = {"subject": self.subject, "value": self.value, "limit": self.limit}
        fact = _DECLARED["text"][self.code].format_map(fields | dict(self.numbers))
        return without_powers(in_symbols(f"{fact}. {self.hint}" if self.hint else fact))

    @property
    def row(self) -> dict[str, Any]:
        """The finding as a row of `Verdict.table`; missing values are None."""
        numbers = {name: v if math.isfinite(v := float(getattr(self, name))) else None for name in ("value", "limit")}
        words = {name: getattr(self, name) for name in ("code", "severity", "subject")}
        return words | numbers | {"hint": self.hint, "text": self.text}


@dataclasses.dataclass(frozen=True, repr=False)
class Verdict:
    """All findings by decreasing severity; within a severity by importance and in the order of the tests."""

    findings: tuple[Finding, ...]

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> "Verdict":
        """Sort findings by severity; first those that say how far errors may move the camera."""
        return cls(tuple(sorted(findings, key=lambda f: (SEVERITIES.index(f.severity), f.code not in _FIRST))))

    def __repr__(self) -> str:
        return "\n".join([self.headline, *(f"{MARKS[f.severity]} {f.text}" for f in self.findings)])

    def _repr_html_(self) -> str:
        return f"<b>{self.headline}</b>{self.table[['severity', 'text']].to_html(index=False, header=False, border=0)}"

    @property
    def table(self) -> pd.DataFrame:
        """Table with one row per finding: code, severity, subject, value, limit, hint, text."""
        columns = ["code", "severity", "subject", "value", "limit", "hint", "text"]
        return pd.DataFrame([f.row for f in self.findings], columns=columns)

    @property
    def severity(self) -> Severity:
        """Highest severity of all findings."""
        return self.findings[0].severity if self.findings else "note"

    @property
    def colour(self) -> str:
        """Colour of the verdict: green, amber or red."""
        return COLOURS[self.severity]

    @property
    def headline(self) -> str:
        """One-line verdict."""
        n = sum(f.severity == self.severity for f in self.findings)
        several = f"{n} {self.severity}{'s' * (n > 1)}"
        if self.severity == "error":
            return f"red: do not use this result; {several}"
        if self.severity == "warning":
            return f"amber: usable with reservations; {several}"
        estimated = "estimated " * any(f.code == "weights" for f in self.findings)
        return f"green: the observations agree with each other and with their {estimated}standard deviations"

    @property
    def summary(self) -> dict:
        """Content of summary.json: verdict and findings."""
        return {"verdict": self.colour, "findings": [f.row for f in self.findings]}

    @property
    def texts(self) -> list[str]:
        """Texts of all findings."""
        return [f.text for f in self.findings]


def as_sentence(text: str) -> str:
    """Capitalise a text (except for symbols such as c and k2) and end it with a full stop."""
    first = text.split(maxsplit=1)[0] if text.strip() else ""
    start = text if len(first) == 1 or re.search(r"[_\d]", first) else f"{text[:1].upper()}{text[1:]}"
    return start if start.endswith((".", "!", "?")) else f"{start}."


def in_symbols(text: str) -> str:
    """Replace parameter paths by symbols, such as "k1 of camera kodak"."""

    def words(path: re.Match) -> str:
        return f"{symbol(path[2])} of {camera_words(path[1])}"

    return re.sub(r"interior\[([^\]]*)\]\.(\w+)", words, text)


def p_words(p_value: float, digits: int = 1) -> str:
    """Format a p-value for a sentence, such as "p = 0.02"."""
    text = of_p(p_value, digits)
    return f"p {text}" if text.startswith("<") else f"p = {text}"
