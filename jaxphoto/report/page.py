"""Self-contained HTML pages of headings, paragraphs, tables (DataFrames) and figures.

All pages share one template, style sheet and script (templates/). Figures are inline SVG, drawn by matplotlib.
"""

from __future__ import annotations

import base64
import datetime
import io
import math
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from jaxphoto.errors import InputError
from jaxphoto.report.findings import Verdict, as_sentence
from jaxphoto.report.formatting import head_of, numeric_columns, readable
from jaxphoto.writing import InputFile

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TEMPLATES = Environment(loader=PackageLoader("jaxphoto.report"), autoescape=True, trim_blocks=True)
_PACKAGES = ("jaxphoto", "jax", "optimistix", "equinox", "lineax", "numpy", "pandas")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge")
# Pattern of cells that are right-aligned: a value, with its unit or standard deviation.
_NUMBER = re.compile(r"(< ?)?[-+]?(\d|-$)")
_DECIMAL = re.compile(r"[-+]?\d+(\.\d+)?")
# Settings of SVG: text stays text; a constant hash salt and no date, so that equal inputs give equal bytes.
_SVG: dict[Any, Any] = {
    "svg.fonttype": "none", "svg.hashsalt": "jaxphoto", "font.size": 8.0, "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5, "lines.linewidth": 1.2,
}  # fmt: skip
# Margins of a panel (inches): left, right, bottom, top; right of a second axis or colour bar.
_MARGINS, _RIGHT = (0.6, 0.1, 0.45, 0.3), 0.5
# Maximum number of intervals between the ticks of an axis.
_TICKS = 5
# Minimum length of a cell that is a text, and wraps.
_LONG = 40
# Absolute correlation beyond which text is white.
_DARK = 0.6
# Width of a panel (inches): three fit side by side.
_WIDTH = 3.2
_NO_METADATA: dict[str, Any] = dict.fromkeys(("Creator", "Date", "Format", "Type"))


class Heading(NamedTuple):
    """Heading of a section."""

    text: str


class Paragraph(NamedTuple):
    """Text; `kind` is "" or a class of the style sheet, such as a severity."""

    text: str
    kind: str = ""


class Plot(NamedTuple):
    """A figure, a function that draws one panel on axes, or a PNG file."""

    figure: Figure | Callable[[Axes], object] | Path
    alt: str
    """Description for screen readers."""
    height: float = 2.6
    """Height of a panel (inches); its width is 3.2 inches."""


class Matrix(NamedTuple):
    """Correlations, in columns of floats, shown as coloured cells; other columns name the rows."""

    table: pd.DataFrame
    caption: str


class Folded(NamedTuple):
    """Parts under a heading that are shown on demand, and not printed."""

    text: str
    parts: Sequence[Part]


class Link(NamedTuple):
    """Link to a page in a folder next to this one."""

    text: str
    page: str


class PictureFile(NamedTuple):
    """Picture in a folder next to the page."""

    alt: str
    file: str


Part = (
    Heading | Paragraph | pd.DataFrame | Matrix | dict[str, str] | Plot | list[Plot] | list[Matrix] | Link
    | PictureFile | Folded | Markup
)  # fmt: skip
"""A part of a page. A dict is a list of names and values, a list is side by side, Markup is unchanged."""


class CommandRecord(NamedTuple):
    """Origin of results: the command line without its output path, and the input files."""

    command: str
    inputs: Sequence[InputFile] = ()


def page(
    title: str, parts: Iterable[Part], verdict: tuple[str, str] = ("", ""), style: str = "", foot: str = ""
) -> str:
    """Return the page as HTML. `verdict` is its first sentence and its colour (green, amber, red or none).

    Paragraphs before the first heading precede the contents. `style` contains additional CSS rules.
    """
    parts = list(parts)
    first = next((k for k, part in enumerate(parts) if isinstance(part, Heading)), 0)
    headings = [part.text for part in parts if isinstance(part, Heading)]
    return _TEMPLATES.get_template("page.html").render(
        title=title, verdict=as_sentence(verdict[0]) if verdict[0] else "", colour=verdict[1], style=Markup(style),
        summary=map(html, parts[:first]), parts=map(html, parts[first:]), foot=foot,
        contents=[(anchor(text), text) for text in headings] if len(headings) > 1 else [],
    )  # fmt: skip


def html(part: Part) -> Markup:
    """Render one part of a page as HTML."""
    if isinstance(part, Markup):
        return part
    if isinstance(part, Heading):
        return Markup('<h2 id="{}">{}</h2>').format(anchor(part.text), part.text)
    if isinstance(part, Paragraph):
        return Markup('<p class="{}">{}</p>' if part.kind else "<p{}>{}</p>").format(part.kind, part.text)
    if isinstance(part, Link):
        return Markup('<p><a href="{}">{}</a></p>').format(quote(part.page), part.text)
    if isinstance(part, PictureFile):
        return Markup('<div class="wide"><img loading="lazy" alt="{}" src="{}"></div>').format(
            part.alt, quote(part.file)
        )
    if isinstance(part, Plot):
        return Markup('<div class="wide">{}</div>').format(_svg(part))
    if isinstance(part, list):
        return Markup('<div class="beside">{}</div>').format(
            Markup("").join(_svg(one) if isinstance(one, Plot) else html(one) for one in part)
        )
    if isinstance(part, dict):
        return Markup(_TEMPLATES.get_template("table.html").render(names=part))
    if isinstance(part, Folded):
        inside = Markup("").join(map(html, part.parts))
        return Markup("<details><summary>{}</summary>{}</details>").format(part.text, inside)
    table, caption, matrix = (part.table, part.caption, True) if isinstance(part, Matrix) else (part, "", False)
    shown, numeric = (_two_places(table) if matrix else readable(table)), numeric_columns(table)
    numbers = [number or _mostly_numbers(shown.iloc[:, k]) for k, number in enumerate(numeric)]
    columns = [_aligned(shown.iloc[:, k]) if number else list(shown.iloc[:, k]) for k, number in enumerate(numbers)]
    styles = [
        _backgrounds(table.iloc[:, k]) if matrix and number else [""] * len(table) for k, number in enumerate(numeric)
    ]
    cells = [zip(*column, strict=True) for column in zip(columns, styles, strict=True)]
    return Markup(
        _TEMPLATES.get_template("table.html").render(
            heads=[head_of(str(name)) for name in table.columns], rows=list(zip(*cells, strict=True)),
            caption=caption,
            style="matrix" if matrix else "texts" if any(len(c) > _LONG for column in columns for c in column) else "",
            kinds=["number" if number else "text" for number in numbers],
        )
    )  # fmt: skip


def _two_places(table: pd.DataFrame) -> pd.DataFrame:
    """Format correlations as text; adding zero removes the sign of zeros."""
    return table.apply(lambda c: (c.round(2) + 0.0).map("{:.2f}".format) if c.dtype == float else c.astype(str))


def _backgrounds(correlation: pd.Series) -> list[str]:
    """Return the styles of correlations: red above zero, blue below, paler towards zero."""
    colours = ("178, 24, 43", "33, 102, 172")
    return [
        f"background: rgba({colours[v < 0]}, {abs(v):.2f}){'; color: #fff' if abs(v) > _DARK else ''}"
        if math.isfinite(v) else "" for v in correlation
    ]  # fmt: skip


def _aligned(column: pd.Series) -> list[str]:
    """Pad right-aligned numbers with figure spaces, so that their decimal points are below each other."""
    places = [len(cell.partition(".")[2]) if _DECIMAL.fullmatch(cell) else None for cell in column]
    most = max((p for p in places if p is not None), default=0)
    if not most:
        return list(column)
    return [
        cell if p is None else cell + ("" if p else "\u2008") + "\u2007" * (most - p)
        for cell, p in zip(column, places, strict=True)
    ]


def _mostly_numbers(column: pd.Series) -> bool:
    cells = [str(cell) for cell in column if cell]
    return sum(bool(_NUMBER.match(cell)) and len(cell) < _LONG for cell in cells) > len(cells) / 2


def _svg(plot: Plot) -> Markup:
    """Return a figure as inline SVG that scales with the width of the page."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    figure = plot.figure
    if isinstance(figure, Path):
        content = base64.b64encode(figure.read_bytes()).decode()
        return Markup('<img alt="{}" src="data:image/png;base64,{}">').format(plot.alt, content)
    drawing = io.StringIO()
    with rc_context(_SVG):
        if callable(figure):
            draw, figure = figure, Figure(figsize=(_WIDTH, plot.height))
            draw(figure.subplots())
            _arrange(figure)
        figure.savefig(drawing, format="svg", metadata=_NO_METADATA)
    svg = drawing.getvalue()
    return Markup('<figure role="img" aria-label="{}">{}</figure>').format(plot.alt, Markup(svg[svg.index("<svg") :]))


def _arrange(figure: Figure) -> None:
    """Set the margins of a panel: fixed, unless names of any length are along an axis.

    Fitting the margins takes as long as drawing.
    """
    from matplotlib.ticker import AutoLocator, FixedLocator

    first, *others = figure.axes
    for axis in (first.xaxis, first.yaxis):
        locator = axis.get_major_locator()
        if isinstance(locator, FixedLocator):
            figure.set_layout_engine("tight")
            return
        if isinstance(locator, AutoLocator):
            locator.set_params(nbins=_TICKS)
    (width, height), (left, right, bottom, top) = figure.get_size_inches(), _MARGINS
    right = _RIGHT if others else right
    figure.subplots_adjust(left / width, bottom / height, 1 - right / width, 1 - top / height)


def anchor(heading: str) -> str:
    """Return the link target of a section."""
    return re.sub(r"\W+", "-", heading.lower()).strip("-")


def verdict_parts(verdict: Verdict) -> list[Part]:
    """Return the findings as paragraphs, each with its severity."""
    return [Paragraph(as_sentence(f.text), f.severity) for f in verdict.findings]


def provenance(record: CommandRecord) -> list[Part]:
    """Return the section of date, command, versions and hashes of the input files."""
    about = {
        "computed": datetime.date.today().isoformat(),
        "command": record.command,
        "versions": ", ".join(f"{name} {number}" for name, number in versions().items()),
    }
    hashes = [Folded("SHA-256 of the input files", [hash_table(record.inputs)])] if record.inputs else []
    return [Heading("Provenance"), about, *hashes]


def hash_table(files: Iterable[InputFile]) -> pd.DataFrame:
    """Tabulate files with their sizes and SHA-256."""
    rows = [(f.file, str(f.n_bytes) if f.n_bytes else "", f.sha256) for f in files]
    return pd.DataFrame(rows, columns=["file", "bytes", "SHA-256"])


def versions() -> dict[str, str]:
    """Return the versions of jaxphoto and of the packages that affect its results."""
    return {name: version(name) for name in _PACKAGES}


def write_pdf(text: str, path: Path) -> None:
    """Print a page to PDF by a Chromium-based browser. Raises InputError if none is installed."""
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None:
        raise InputError("no Chromium, Chrome or Edge found to print a PDF: write HTML and print it in a browser")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        source = Path(folder, "page.html")
        source.write_text(text, encoding="utf-8")
        options = ("--headless", "--no-sandbox", "--disable-gpu", "--no-pdf-header-footer", f"--user-data-dir={folder}")
        command = [browser, *options, f"--print-to-pdf={path.resolve()}", source.as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=120)


def option_word(value: Any) -> str:
    """Format the value of an option."""
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
