"""The page of a study: what it found in sentences, then tables and pictures, in one file that opens offline."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import quote

from jinja2 import Environment
from markupsafe import Markup

from jaxphoto.report.document import Element, Heading, Paragraph, Pictures
from jaxphoto.report.document_html import contents, html_of, live_pictures
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.interactive import library, live_figure
from jaxphoto.report.maps import png_of, png_uri
from jaxphoto.report.page_head import page_head

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PAGE = """{{ head }}<body>
<h1>{{ title }}</h1>
{% for sentence in said %}<p{{ kind }}>{{ sentence }}</p>
{% endfor %}{% for part in begun %}{{ part }}
{% endfor %}{{ contents }}
{% for part in parts %}{{ part }}
{% endfor %}{{ library }}</body></html>
"""


class WholePicture(NamedTuple):
    """A picture of several panels, as wide as it is; those of a `figure` answer on the page."""

    png: bytes
    uri: str
    alt: str
    figure: Figure | None = None

    @classmethod
    def of(cls, figure: Figure, alt: str) -> WholePicture:
        """A figure, for a page and a file beside it."""
        return cls(*png_of(figure), alt, figure)

    @classmethod
    def read(cls, file: Path, alt: str) -> WholePicture:
        """A PNG that was written before."""
        png = file.read_bytes()
        return cls(png, png_uri(png), alt)


class PageLink(NamedTuple):
    """To a page in a folder beside this one."""

    text: str
    page: str


class PictureFile(NamedTuple):
    """A picture in a folder beside the page."""

    alt: str
    file: str


StudyPart = Element | WholePicture | PageLink | PictureFile | Markup
"""Markup is of whoever makes the page: it stands there as it is."""


def study_page(title: str, said: Sequence[str], parts: Iterable[StudyPart], colour: str = "", style: str = "") -> str:
    """The page as HTML; `said` stands first, in `colour` (green, amber, red) where it is a verdict.

    `style` are rules of its own, below those of all pages.
    """
    shown = list(parts)
    # Sentences before the first heading, such as findings, belong to what stands first.
    begun = list(itertools.takewhile(lambda part: isinstance(part, Paragraph), shown))
    headings = [part.text for part in shown if isinstance(part, Heading)]
    body = [_shown(part) for part in shown[len(begun) :]]
    return (
        Environment(autoescape=True)
        .from_string(_PAGE)
        .render(
            head=page_head(title, style),
            title=title,
            said=map(as_sentence, said),
            kind=Markup(' class="verdict {}"').format(colour) if colour else "",
            contents=contents(headings) if len(headings) > 1 else "",
            begun=[_shown(part) for part in begun],
            parts=body,
            library=library(body),
        )
    )


def _shown(part: StudyPart) -> Markup:
    if isinstance(part, Markup):
        return part
    if isinstance(part, PageLink):
        return Markup('<p><a href="{}">{}</a></p>').format(quote(part.page), part.text)
    if isinstance(part, WholePicture):
        still = Markup('<div class="wide"><img alt="{}" src="{}"></div>').format(part.alt, part.uri)
        return still if part.figure is None else live_figure(still, [part.figure])
    if isinstance(part, Pictures):
        return live_pictures(part)
    if isinstance(part, PictureFile):
        return Markup('<div class="wide"><img loading="lazy" alt="{}" src="{}"></div>').format(
            part.alt, quote(part.file)
        )
    return html_of(part)
