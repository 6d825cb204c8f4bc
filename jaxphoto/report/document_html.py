"""A document as one file of HTML that opens offline, on a screen of any width and in print."""

import base64
import io
import re

from jinja2 import Environment
from markupsafe import Markup

from jaxphoto.report.document import Document, DocumentPicture, Heading, Paragraph, Pictures, Rows
from jaxphoto.report.page import STYLE
from jaxphoto.report.plots import new_figure

WIDTH_INCHES = 4.8
# Pictures are drawn finer than screens show them: for print, and for screens of many pixels.
_DPI = 200
MORE_STYLE = """\
html { overflow-wrap: anywhere } table { overflow-wrap: normal } nav a { margin-right: 1rem; white-space: nowrap }
.pictures { display: flex; flex-wrap: wrap; gap: .8rem; margin: .5rem 0 1rem }
.pictures img { width: 29.5rem; height: auto }
.names th { background: none; font-weight: normal; color: #555; white-space: nowrap } .names td { text-align: left }
h2 { margin-top: 2rem; border-bottom: 1px solid #ccc } code { font-size: 12px }
@media (max-width: 32rem) { body { margin: .5rem auto; padding: 0 .6rem } th, td { padding: .15rem .35rem }
  h1 { font-size: 1.4rem } }
@media print { body { max-width: none; margin: 0; font-size: 10.5px } table { font-size: 9px } nav { display: none }
  h2, h3 { break-after: avoid } tr, img { break-inside: avoid } .pictures img { width: 48% }
  .wide { overflow: visible } }
"""
_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title><style>{{ style }}</style></head><body>
<h1>{{ title }}</h1>
{% for e in elements %}{{ e }}
{% endfor %}<p><small>{{ foot }}</small></p>
</body></html>
"""
_HTML = Environment(autoescape=True)
_ROWS = _HTML.from_string(
    '<div class="wide"><table{% if not head %} class="names"{% endif %}>{% if head %}<thead><tr>{% for c in columns %}'
    "<th>{{ c }}</th>{% endfor %}</tr></thead>{% endif %}<tbody>{% for row in rows %}<tr>{% for cell in row %}"
    "{% if loop.first and not head %}<th>{{ cell }}</th>{% else %}<td>{{ cell }}</td>{% endif %}{% endfor %}</tr>"
    "{% endfor %}</tbody></table></div>"
)


def html_page(document: Document) -> str:
    """The document with its pictures inside."""
    elements = [html_of(element) for element in document.elements]
    style = Markup(STYLE + MORE_STYLE)
    return _HTML.from_string(_PAGE).render(title=document.title, style=style, elements=elements, foot=document.foot)


def html_of(element: Heading | Paragraph | Rows | Pictures) -> Markup:
    """One element."""
    if isinstance(element, Heading):
        return Markup('<h2 id="{}">{}</h2>').format(anchor(element.text), element.text)
    if isinstance(element, Paragraph):
        return Markup('<p class="{}">{}</p>' if element.kind else "<p{}>{}</p>").format(element.kind, element.text)
    if isinstance(element, Rows):
        return Markup(_ROWS.render(columns=element.columns, rows=element.rows, head=any(element.columns)))
    return Markup('<div class="pictures">{}</div>').format(Markup("").join(map(_image, element.panels)))


def contents(headings: list[str]) -> Markup:
    """Links to sections."""
    links = [Markup('<a href="#{}">{}</a>').format(anchor(text), text) for text in headings]
    return Markup("<nav>{}</nav>").format(Markup(" ").join(links))


def anchor(heading: str) -> str:
    """What a link calls a section."""
    return re.sub(r"\W+", "-", heading.lower()).strip("-")


def _image(picture: DocumentPicture) -> Markup:
    figure = new_figure(WIDTH_INCHES, picture.height)
    picture.draw(figure.subplots())
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=_DPI)
    content = base64.b64encode(drawn.getvalue()).decode()
    return Markup('<img alt="{}" src="data:image/png;base64,{}">').format(picture.alt, content)
