"""What the site has beside the pages of docs/: the notebooks, the reference of the public names, links to other files.

Names of functions lead to the reference, names of pages read as their titles, formulas are MathML, which needs no
script, and search works where the site is opened from disk. A hook of MkDocs: its functions are called by their names.
"""

import functools
import importlib
import inspect
import json
import logging
import os
import re
import shutil
import tempfile
from pathlib import Path

import nbformat
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from outputs import NOTEBOOKS, ROOT, is_current

_LOG = logging.getLogger("mkdocs.hooks.pages")
# Where MkDocs finds the notebooks with their outputs while it builds.
_WITH_OUTPUTS = Path(tempfile.gettempdir()) / f"jaxphoto_notebooks_{os.getpid()}"
_WORKER = "worker_from_disk.js"
# Names and options are not broken, wide tables and code have room, and where a table scrolls its cells are not tall.
_STYLE = """.md-typeset td code { word-break: normal; overflow-wrap: normal }
.md-typeset td:first-child code { white-space: nowrap }
.md-grid { max-width: 68rem }
.jupyter-wrapper .celltoolbar { display: none !important }
@media (max-width: 60em) { .md-typeset td:nth-child(n+4):has(a) { min-width: 9rem } }"""
_LINK = re.compile(r"\[([^\]]*)\]\((?:\.\./)+([^)#]+)(#[^)]*)?\)")
_TO_NOTEBOOK = re.compile(r"\]\((\w+)\.ipynb\)")
_TO_PAGE = re.compile(r"\[[\w/]+\.md\]\(([\w./]+\.md)(#[^)]*)?\)")
_NAME = re.compile(r"(?<!\[)`jaxphoto\.([\w.]+)`(?!\])")
_FORMULA = re.compile(r"\$\$(.+?)\$\$|\$(?=\S)([^$\n]+?)(?<=\S)\$", re.DOTALL)
# A listing, or words in it: what is written there is meant as it stands.
_LISTING = re.compile(r"(^```.*?^```|`[^`\n]+`)", re.DOTALL | re.MULTILINE)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Name every notebook and every page of the reference in the contents."""
    added = {
        "notebooks/": [{_notebook_title(path): f"notebooks/{path.name}"} for path in NOTEBOOKS],
        "reference/": [f"reference/{room}.md" for room in _public()],
    }
    config.nav = [
        {title: added.get(pages, pages) if isinstance(pages, str) else pages for title, pages in item.items()}
        if isinstance(item, dict)
        else item
        for item in config.nav or []
    ]
    return config


@event_priority(100)  # before the plugin that makes pages of notebooks
def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the notebooks, which lie beside docs/, and the reference, which is written here."""
    for path in NOTEBOOKS:
        notebook = nbformat.read(path, as_version=4)
        if not is_current(notebook):
            _LOG.warning("%s has outputs of other code: python docs/site/outputs.py %s", path.name, path.stem)
        shown = _WITH_OUTPUTS / "notebooks" / path.name
        shown.parent.mkdir(parents=True, exist_ok=True)
        nbformat.write(_as_on_site(notebook), shown)
        files.append(File(f"notebooks/{path.name}", str(_WITH_OUTPUTS), config.site_dir, config.use_directory_urls))
    for room, names in _public().items():
        entries = "\n\n".join(f"::: {name}" for name in names)
        files.append(
            File.generated(
                config, f"reference/{room}.md", content=f"# {room.replace('_', ' ').capitalize()}\n\n{entries}\n"
            )
        )
    files.append(File(_WORKER, str(ROOT / "docs" / "site"), config.site_dir, config.use_directory_urls))
    return files


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Add the date of the outputs to a notebook."""
    notebook = ROOT / "notebooks" / Path(page.file.src_uri).name
    if not page.file.src_uri.endswith(".ipynb"):
        return html
    made = json.loads(notebook.read_text("utf-8"))["metadata"]["jaxphoto"]["run"]
    words = f"<p><em>notebooks/{notebook.name}, run on {made}.</em></p>"
    heading, end, rest = html.partition("</h1>")
    return f"{heading}{end}{words}{rest}"


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Replace the script that the theme would fetch by a local one; add the style."""
    output = output.replace("</head>", f"<style>{_STYLE}</style></head>", 1)
    return output.replace("https://unpkg.com/iframe-worker/shim", "../" * page.url.count("/") + _WORKER)


def on_post_build(config: MkDocsConfig) -> None:
    """Add the notebooks with their outputs as pages."""
    shutil.rmtree(_WITH_OUTPUTS)


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links out of docs/: to a notebook on the site; of another file of the repository its place. Titles, formulas."""
    here = Path(page.file.src_uri).parent
    up = "../" * len(here.parts)

    def linked(match: re.Match[str]) -> str:
        text, target, place = match.group(1), match.group(2), match.group(3) or ""
        if (ROOT / "docs" / target).exists():
            return match.group(0)
        if not (ROOT / target).exists():
            raise ValueError(f"{page.file.src_uri} links to {target}, which is not there")
        if target.startswith("notebooks/"):
            return f"[{text}]({up}{target}{place})"
        return f"`{target}`" if text.rstrip("/") == target.rstrip("/") else f"{text} (`{target}`)"

    def titled(match: re.Match[str]) -> str:
        found = (ROOT / "docs" / here / match.group(1)).resolve()
        return f"[{_title(found)}]({match.group(1)}{match.group(2) or ''})" if found.is_file() else match.group(0)

    # A notebook comes as its JSON, which is not what is shown.
    if page.file.src_uri.startswith("notebooks/"):
        return markdown
    markdown = _TO_PAGE.sub(titled, _LINK.sub(linked, markdown))
    if page.file.src_uri.startswith("reference/"):
        return markdown
    parts = _LISTING.split(_formulas(markdown))
    known = _identifiers()
    for k, part in enumerate(parts):
        if (name := _NAME.fullmatch(part)) and name[1] in known and not parts[k - 1].endswith("["):
            parts[k] = f"[{part}][{known[name[1]]}]"
    return "".join(parts)


def _as_on_site(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Its text, and what its cells work out to say, with links to pages of the site and formulas as MathML."""
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            cell.source = _formulas(_LINK.sub(_from_notebook, _TO_NOTEBOOK.sub(r"](\1.html)", cell.source)))
        for output in cell.get("outputs", ()):
            if words := output.get("data", {}).get("text/markdown"):
                output.data["text/markdown"] = _formulas(_LINK.sub(_from_notebook, words))
    return notebook


def _from_notebook(match: re.Match[str]) -> str:
    """Rewrite a link out of notebooks/: to a page of docs/, or to a file of the repository."""
    text, target, place = match.group(1), match.group(2), match.group(3) or ""
    if not target.startswith("docs/"):
        return f"`{target}`" if text == target else f"{text} (`{target}`)"
    text = _title(ROOT / target) if text == target else text
    return f"[{text}](../{target.removeprefix('docs/').removesuffix('.md')}.html{place})"


def _formulas(markdown: str) -> str:
    """Formulas outside of listings as MathML."""
    parts = _LISTING.split(markdown)
    parts[::2] = [_FORMULA.sub(_mathml, part) for part in parts[::2]]
    return "".join(parts)


def _mathml(match: re.Match[str]) -> str:
    if inline := match[2]:
        return convert(inline)
    # Wider than a telephone some are.
    return f'<span style="display: block; overflow-x: auto">{convert(match[1], display="block")}</span>'


def _title(page: Path) -> str:
    """Of a page: its first heading, which its settings may stand before."""
    lines = page.read_text("utf-8").splitlines()
    return next(line for line in lines if line.startswith("# ")).lstrip("# ").strip()


def _notebook_title(path: Path) -> str:
    return "".join(json.loads(path.read_text("utf-8"))["cells"][0]["source"]).splitlines()[0].lstrip("# ")


def _public() -> dict[str, list[str]]:
    """List the public names, the plots, and the names on papers.md, by package."""
    found: dict[str, set[str]] = {}
    for identifier in _identifiers().values():
        found.setdefault(identifier.split(".")[1], set()).add(identifier)
    return {room: sorted(names) for room, names in sorted(found.items())}


@functools.cache
def _identifiers() -> dict[str, str]:
    """`project` or `variants.direct`, as a page says it after `jaxphoto.` -> where it is defined."""
    jaxphoto = importlib.import_module("jaxphoto")
    papers = (ROOT / "docs" / "papers.md").read_text("utf-8")
    report = importlib.import_module("jaxphoto.report")
    pictures = [f"report.{name}" for name in report.__all__ if name.startswith("plot_")]
    found = {}
    for name in [*jaxphoto.__all__, *pictures, *_NAME.findall(papers)]:
        *rooms, last = name.split(".")
        value = getattr(importlib.import_module(".".join(["jaxphoto", *rooms])), last)
        if inspect.isclass(value) or inspect.isroutine(value):
            found[name] = f"{value.__module__}.{value.__qualname__}"
    return found
