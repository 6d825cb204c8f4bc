"""HTML pages: one self-contained file each, from headings, paragraphs, tables (DataFrames) and figures.

All pages share one template, style sheet and script (templates/). Figures are inline SVG, drawn by matplotlib.
"""

from __future__ import annotations

import base64
import datetime
import io
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
from jaxphoto.report.plots import new_figure
from jaxphoto.writing import InputFile

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TEMPLATES = Environment(loader=PackageLoader("jaxphoto.report"), autoescape=True, trim_blocks=True)
_PACKAGES = ("jaxphoto", "jax", "optimistix", "equinox", "lineax", "numpy", "pandas")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge")
# A cell that is read as a number, with its unit or standard deviation.
_NUMBER = re.compile(r"(< ?)?[-+]?(\d|-$)")
# Text without ids of its own, so that a page holds many drawings; no date, so that equal input gives equal bytes.
_SVG: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "jaxphoto"}
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
    """Description for readers who do not see it."""
    height: float = 3.4
    """Height of a panel (inches); its width is 4.8."""


class Link(NamedTuple):
    """Link to a page in a folder next to this one."""

    text: str
    page: str


class PictureFile(NamedTuple):
    """A picture in a folder next to the page."""

    alt: str
    file: str


Part = Heading | Paragraph | pd.DataFrame | dict[str, str] | Plot | list[Plot] | Link | PictureFile | Markup
"""A part of a page: a dict is a list of names and values, a list of plots stands side by side, Markup as it is."""


class CommandRecord(NamedTuple):
    """How results came about: the command line without its output path, and the files that were read."""

    command: str
    inputs: Sequence[InputFile] = ()


def page(
    title: str, parts: Iterable[Part], verdict: tuple[str, str] = ("", ""), style: str = "", foot: str = ""
) -> str:
    """The page as HTML; `verdict` is its first sentence and its colour (green, amber, red or none).

    Paragraphs before the first heading stand above the contents. `style` are additional rules.
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
    """One part of a page."""
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
        return Markup('<div class="plots">{}</div>').format(Markup("").join(map(_svg, part)))
    if isinstance(part, dict):
        return Markup(_TEMPLATES.get_template("table.html").render(names=part))
    shown = readable(part)
    kinds = [
        "number" if number or _mostly_numbers(shown.iloc[:, k]) else "text"
        for k, number in enumerate(numeric_columns(part))
    ]
    rows = list(shown.itertuples(index=False, name=None))
    return Markup(
        _TEMPLATES.get_template("table.html").render(
            heads=[head_of(str(name)) for name in part.columns], kinds=kinds, rows=rows
        )
    )


def _mostly_numbers(column: pd.Series) -> bool:
    cells = [str(cell) for cell in column if cell]
    return sum(bool(_NUMBER.match(cell)) and len(cell) < 40 for cell in cells) > len(cells) / 2


def _svg(plot: Plot) -> Markup:
    """A figure as inline SVG that scales to the width of the page."""
    from matplotlib import rc_context

    figure = plot.figure
    if isinstance(figure, Path):
        content = base64.b64encode(figure.read_bytes()).decode()
        return Markup('<img alt="{}" src="data:image/png;base64,{}">').format(plot.alt, content)
    if callable(figure):
        draw, figure = figure, new_figure(4.8, plot.height)
        draw(figure.subplots())
    drawing = io.StringIO()
    with rc_context(_SVG):
        figure.savefig(drawing, format="svg", metadata=_NO_METADATA)
    svg = drawing.getvalue()
    return Markup('<figure role="img" aria-label="{}">{}</figure>').format(plot.alt, Markup(svg[svg.index("<svg") :]))


def anchor(heading: str) -> str:
    """The link target of a section."""
    return re.sub(r"\W+", "-", heading.lower()).strip("-")


def verdict_parts(verdict: Verdict) -> list[Part]:
    """The findings, each with its severity."""
    return [Paragraph(as_sentence(f.text), f.severity) for f in verdict.findings]


def provenance(record: CommandRecord) -> list[Part]:
    """Section of date, command, versions and hashes of the input files."""
    about = {
        "computed": datetime.date.today().isoformat(),
        "command": record.command,
        "versions": ", ".join(f"{name} {number}" for name, number in versions().items()),
    }
    return [Heading("Provenance"), about, *([hash_table(record.inputs)] if record.inputs else [])]


def hash_table(files: Iterable[InputFile]) -> pd.DataFrame:
    """Files with their sizes and SHA-256."""
    rows = [(f.file, str(f.n_bytes) if f.n_bytes else "", f.sha256) for f in files]
    return pd.DataFrame(rows, columns=["file", "bytes", "SHA-256"])


def versions() -> dict[str, str]:
    """Versions of jaxphoto and of the packages its numbers depend on."""
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
