"""A document as a PDF of A4 sheets, the same bytes each time: no time of day is in it."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from textwrap import wrap
from typing import TYPE_CHECKING, NamedTuple

from jaxphoto.errors import printable
from jaxphoto.report.block_plot import block_words, plot_block
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

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Inches, and points of type.
_WIDTH, _HEIGHT, _MARGIN = 8.27, 11.69, 0.75
_INNER = _WIDTH - 2 * _MARGIN
_TEXT, _CELL, _SMALLEST = 8.5, 7.5, 4.5
# Long cells go on in the next line before type is smaller than this.
_READABLE = 7.0
# Of a character of DejaVu Sans, in parts of the size of type: of text on average, of a table at most.
_LETTER, _FIGURE = 0.56, 0.64
_LABELS = {"left": 0.6, "right": 0.15, "bottom": 0.45, "top": 0.35}
_BLANK = 3
"""Characters between two columns."""


class _Box(NamedTuple):
    """A part of a sheet over its whole width."""

    height: float
    draw: Callable[[Figure, float], None]
    """On a sheet, from a height above its lower edge downwards (inches)."""
    with_next: bool = False
    """Whether no sheet ends with it."""


def pdf_of(document: Document) -> bytes:
    """The document as the content of a PDF."""
    # Here, because importing matplotlib takes a third of a second.
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

    boxes = [box for element in (Paragraph(document.title, "title"), *document.elements) for box in _boxes(element)]
    sheets, written = _sheets(boxes), io.BytesIO()
    about = {"Title": document.title, "Creator": "jaxphoto", "Producer": None, "CreationDate": None}
    with warnings.catch_warnings():
        # Of letters that the font has not: a square stands in their place.
        warnings.simplefilter("ignore")
        with PdfPages(written, metadata=about) as pdf:
            for number, sheet in enumerate(sheets, 1):
                page = Figure(figsize=(_WIDTH, _HEIGHT))
                top = _HEIGHT - _MARGIN
                for box in sheet:
                    box.draw(page, top)
                    top -= box.height
                _write(page, _MARGIN, 0.6 * _MARGIN, f"{document.foot}   page {number} of {len(sheets)}", 6.5, "0.35")
                pdf.savefig(page)
    return written.getvalue()


def _sheets(boxes: list[_Box]) -> list[list[_Box]]:
    sheets: list[list[_Box]] = [[]]
    left = _HEIGHT - 2 * _MARGIN
    for k, box in enumerate(boxes):
        # A heading goes with what follows it.
        needed = box.height + (boxes[k + 1].height if box.with_next and k + 1 < len(boxes) else 0.0)
        if needed > left and sheets[-1]:
            sheets.append([])
            left = _HEIGHT - 2 * _MARGIN
        sheets[-1].append(box)
        left -= box.height
    return sheets


def _boxes(element: Element) -> Iterator[_Box]:
    if isinstance(element, Heading):
        yield _line(element.text, 11.0, bold=True, above=0.16, with_next=True)
    elif isinstance(element, Paragraph):
        size = 16.0 if element.kind == "title" else _TEXT
        bold = element.kind == "title" or element.kind.startswith("verdict")
        lines = wrap(printable(element.text), int(_INNER * 72 / (_LETTER * (1.08 if bold else 1.0) * size)))
        for k, line in enumerate(lines):
            yield _line(line, size, bold=bold, with_next=k < len(lines) - 1)
        yield _Box(0.05, lambda page, top: None)
    elif isinstance(element, Rows):
        yield from _table(element)
    elif isinstance(element, BlockInSpace):
        adjusted = element.tables.adjusted
        plan = DocumentPicture(partial(plot_block, adjusted), block_words(adjusted.block), 4.2)
        yield from _pictures(Pictures((plan,)))
    else:
        yield from _pictures(element)


def _line(text: str, size: float, bold: bool = False, above: float = 0.0, with_next: bool = False) -> _Box:
    height = above + 1.4 * size / 72

    def draw(page: Figure, top: float) -> None:
        _write(page, _MARGIN, top - above - 1.05 * size / 72, text, size, "black", bold)

    return _Box(height, draw, with_next)


def _table(table: Rows) -> Iterator[_Box]:
    head = any(table.columns)
    lines = [*([table.columns] if head else []), *table.rows]
    wide = _widths([[printable(line[k]) for line in lines] for k in range(len(table.columns))])
    size = max(_SMALLEST, min(_CELL, _INNER * 72 / (_FIGURE * sum(wide))))
    place = [_MARGIN + sum(wide[:k]) * _FIGURE * size / 72 for k in range(len(wide))]
    right = int(max(8, (_WIDTH - _MARGIN - place[-1]) * 72 / (_FIGURE * size)))
    most = [*(w - _BLANK for w in wide[:-1]), right]
    for number, line in enumerate(lines):
        # What is wider than the sheet goes on in the next line.
        cells = [wrap(printable(cell), most[k]) or [""] for k, cell in enumerate(line)]
        for part in range(max(map(len, cells))):
            row = [cell[part] if part < len(cell) else "" for cell in cells]
            yield _row(row, place, size, bold=head and number == 0, with_next=number == 0)
    yield _Box(0.08, lambda page, top: None)


def _widths(columns: list[list[str]]) -> list[int]:
    """Characters for each column and the blank behind it: its longest cell, or in wide tables its longest word."""
    wide = [max(map(len, cells)) + _BLANK for cells in columns]
    least = [max(len(word) for cell in cells for word in [*cell.split(), ""]) + _BLANK for cells in columns]
    too_much = sum(wide) - int(_INNER * 72 / (_FIGURE * _READABLE))
    for _ in range(too_much):
        # One after another, so that columns that are alike stay so.
        k = max(range(len(wide)), key=lambda k: (wide[k] > least[k], wide[k]))
        wide[k] = max(least[k], wide[k] - 1)
    return wide


def _row(cells: list[str], place: list[float], size: float, bold: bool, with_next: bool) -> _Box:
    def draw(page: Figure, top: float) -> None:
        for x, cell in zip(place, cells, strict=True):
            _write(page, x, top - 1.1 * size / 72, cell, size, "black", bold)

    return _Box(1.5 * size / 72, draw, with_next)


def _pictures(pictures: Pictures) -> Iterator[_Box]:
    for first in range(0, len(pictures.panels), 2):
        pair = pictures.panels[first : first + 2]
        wide = _INNER / 2 if len(pictures.panels) > 1 else 0.75 * _INNER
        height = max(panel.height for panel in pair) * wide / 4.8

        def draw(page: Figure, top: float, pair=pair, wide=wide, height=height) -> None:
            for k, panel in enumerate(pair):
                left = _MARGIN + k * wide + _LABELS["left"]
                bottom = top - height + _LABELS["bottom"]
                size = wide - _LABELS["left"] - _LABELS["right"], height - _LABELS["top"] - _LABELS["bottom"]
                box = (left / _WIDTH, bottom / _HEIGHT, size[0] / _WIDTH, size[1] / _HEIGHT)
                axes = page.add_axes(box)
                panel.draw(axes)
            _small(page)

        yield _Box(height, draw)


def _small(page: Figure) -> None:
    """Type that suits half a sheet, of panels and of the colours beside them."""
    from matplotlib.text import Text

    for axes in page.axes:
        for text in axes.findobj(Text):
            text.set_fontsize(min(text.get_fontsize(), 7.0))


def _write(page: Figure, x: float, y: float, text: str, size: float, colour: str, bold: bool = False) -> None:
    page.text(
        x / _WIDTH, y / _HEIGHT, printable(text), fontsize=size, color=colour, parse_math=False,
        fontweight="bold" if bold else "normal",
    )  # fmt: skip
