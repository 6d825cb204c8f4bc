"""A document as one file of HTML that opens offline, on a screen of any width and in print."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

from jinja2 import Environment
from markupsafe import Markup

from jaxphoto.report.block_plot import block_words, layout_figure
from jaxphoto.report.document import (
    BlockInSpace,
    Document,
    DocumentPicture,
    Element,
    Heading,
    Paragraph,
    Pictures,
    Rows,
)
from jaxphoto.report.interactive import library, live_block, live_figure
from jaxphoto.report.maps import png_of
from jaxphoto.report.page_head import page_head
from jaxphoto.report.plots import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH_INCHES = 4.8
# Pictures are drawn finer than screens show them: for print, and for screens of many pixels.
_DPI = 200
_PAGE = """{{ head(title) }}<body>
<h1>{{ title }}</h1>
{% for e in elements %}{{ e }}
{% endfor %}<p><small>{{ foot }}</small></p>
{{ library }}
</body></html>
"""
_HTML = Environment(autoescape=True)
# Numbers, with a unit, with what they are good to, several beside one another: all of a cell, which is short.
_ONE = r"((< )?[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?(\([\d.]+\))?|-)"
_UNIT = r"( ?[^\W\d_]{1,7}| ?%)"
_NUMBER = re.compile(rf"{_ONE}{_UNIT}?(( (\+-|/|x|to|=) |, ?|/){_ONE}{_UNIT}?)*( or more)?")
_LONGEST = 40
_HASH = re.compile("[0-9a-f]{64}")
# Rows of a table that scrolls in a box of its own.
_LONG = 30
_ROWS = _HTML.from_string(
    '<div class="wide{% if rows|length > long %} long" tabindex="0{% endif %}"><table{% if not head %} class="names"'
    "{% endif %}>{% if head %}<thead><tr>{% for c in columns %}"
    "<th{{ kinds[loop.index0] }}>{{ c }}</th>{% endfor %}</tr></thead>{% endif %}<tbody>{% for row in rows %}<tr>"
    "{% for cell in row %}{% if loop.first and not head %}<th>{{ cell }}</th>{% else %}"
    "<td{{ kinds[loop.index0] }}>{{ cell }}</td>{% endif %}{% endfor %}</tr>"
    "{% endfor %}</tbody></table></div>"
)


def html_page(document: Document) -> str:
    """The document with its pictures inside."""
    elements = [html_of(element) for element in document.elements]
    return _HTML.from_string(_PAGE).render(
        title=document.title, head=page_head, elements=elements, foot=document.foot, library=library(elements)
    )


def html_of(element: Element) -> Markup:
    """One element."""
    if isinstance(element, Heading):
        return Markup('<h2 id="{}">{}</h2>').format(anchor(element.text), element.text)
    if isinstance(element, Paragraph):
        return Markup('<p class="{}">{}</p>' if element.kind else "<p{}>{}</p>").format(element.kind, element.text)
    if isinstance(element, Rows):
        head = any(element.columns)
        kinds = [Markup(' class="{}"').format(_kind(c)) if head else "" for c in zip(*element.rows, strict=True)]
        kinds += [""] * (len(element.columns) - len(kinds))
        return Markup(_ROWS.render(columns=element.columns, rows=element.rows, head=head, kinds=kinds, long=_LONG))
    if isinstance(element, BlockInSpace):
        tables = element.tables
        still, alt = png_of(layout_figure(tables))[1], block_words(tables.adjusted.block)
        return live_block(tables.adjusted, tables.covariance, still, alt)
    return _stills(element, map(_figure, element.panels))


def live_pictures(pictures: Pictures) -> Markup:
    """Panels that answer, for a page that ends with their `library`."""
    figures = [_figure(panel) for panel in pictures.panels]
    return live_figure(_stills(pictures, figures), figures)


def _kind(column: tuple[str, ...]) -> str:
    """Class of a column: text where most cells are more than a number, read from the left and broken into lines.

    Of sentences the lines are not to be of a word each on a narrow screen: prose.
    """
    told = [cell for cell in column if cell]
    if told and all(_HASH.fullmatch(cell) for cell in told):
        return "text hash"
    if sum(len(cell) > _LONGEST or _NUMBER.fullmatch(cell) is None for cell in told) <= len(told) / 2:
        return "number"
    return "text prose" if any(len(cell) > _LONGEST and " " in cell for cell in told) else "text"


def contents(headings: list[str]) -> Markup:
    """Links to sections."""
    links = [Markup('<a href="#{}">{}</a>').format(anchor(text), text) for text in headings]
    return Markup("<nav>{}</nav>").format(Markup(" ").join(links))


def anchor(heading: str) -> str:
    """What a link calls a section."""
    return re.sub(r"\W+", "-", heading.lower()).strip("-")


def _figure(picture: DocumentPicture) -> Figure:
    figure = new_figure(WIDTH_INCHES, picture.height)
    picture.draw(figure.subplots())
    return figure


def _stills(pictures: Pictures, figures: Iterable[Figure]) -> Markup:
    images = [_image(figure, panel.alt) for panel, figure in zip(pictures.panels, figures, strict=True)]
    return Markup('<div class="pictures">{}</div>').format(Markup("").join(images))


def _image(figure: Figure, alt: str) -> Markup:
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=_DPI)
    content = base64.b64encode(drawn.getvalue()).decode()
    return Markup('<img alt="{}" src="data:image/png;base64,{}">').format(alt, content)
