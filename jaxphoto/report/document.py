"""A document of headings, sentences, tables and pictures, for a page of HTML or sheets of paper alike."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import pandas as pd

from jaxphoto.report.findings import Verdict, as_sentence
from jaxphoto.report.table_files import head_of, readable
from jaxphoto.report.tables import Tables

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Heading(NamedTuple):
    """Of a section."""

    text: str


class Paragraph(NamedTuple):
    """A sentence or several; `kind` is "", or a class of the style sheet."""

    text: str
    kind: str = ""


class Rows(NamedTuple):
    """A table of texts; columns without a heading are a list of names and what they are."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def finding_paragraphs(verdict: Verdict) -> list[Paragraph]:
    """The findings, each as what it is: alarm, warning, information."""
    return [Paragraph(as_sentence(f.text), f.level.name.lower()) for f in verdict.findings]


def verdict_paragraphs(verdict: Verdict) -> list[Paragraph]:
    """The verdict in its colour, and what it follows from."""
    return [Paragraph(as_sentence(verdict.headline), f"verdict {verdict.colour}"), *finding_paragraphs(verdict)]


def rows_of(table: pd.DataFrame) -> Rows:
    """A table as it is to be read: units in the heads, digits that follow sigmas."""
    heads = tuple(head_of(str(name)) for name in table.columns)
    return Rows(heads, tuple(readable(table).itertuples(index=False, name=None)))


def without_empty(table: pd.DataFrame) -> pd.DataFrame:
    """The same without columns that no row has anything in, such as problems where there are none."""
    return table.loc[:, ~(table.isna() | (table == "")).all()] if len(table) else table


class DocumentPicture(NamedTuple):
    """One panel."""

    draw: Callable[[Axes], object]
    alt: str
    """What it shows, for those who do not see it."""
    height: float = 3.0
    """Inches, of a width of 4.8."""


class Pictures(NamedTuple):
    """Panels beside one another, as far as there is room."""

    panels: tuple[DocumentPicture, ...]


class BlockInSpace(NamedTuple):
    """An adjusted block that turns on a screen, once a document; on paper its plan."""

    tables: Tables


Element = Heading | Paragraph | Rows | Pictures | BlockInSpace


class Document(NamedTuple):
    """What is written."""

    title: str
    foot: str
    """At the bottom of each sheet."""
    elements: tuple[Element, ...]
