"""What the site has beside the pages of docs/: the notebooks, the reference of the public names, links to other files.

A hook of MkDocs: its functions are called by their names.
"""

import importlib
import inspect
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
_LINK = re.compile(r"\[([^\]]*)\]\(\.\./([^)#]+)(#[^)]*)?\)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Name every notebook and every page of the reference in the contents."""
    added = {
        "notebooks/": [f"notebooks/{path.name}" for path in _notebooks()],
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
    for path in _notebooks():
        files.append(File(f"notebooks/{path.name}", str(ROOT), config.site_dir, config.use_directory_urls))
    for room, names in _public().items():
        entries = "\n\n".join(f"::: {name}" for name in names)
        files.append(
            File.generated(
                config, f"reference/{room}.md", content=f"# {room.replace('_', ' ').capitalize()}\n\n{entries}\n"
            )
        )
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links out of docs/: to a notebook on the site; of another file of the repository its place."""

    def linked(match: re.Match[str]) -> str:
        text, target, place = match.group(1), match.group(2), match.group(3) or ""
        if not (ROOT / target).exists():
            raise ValueError(f"{page.file.src_uri} links to ../{target}, which is not there")
        return f"[{text}]({target}{place})" if target.startswith("notebooks/") else f"{text} (`{target}`)"

    return _LINK.sub(linked, markdown)


def _notebooks() -> list[Path]:
    return sorted((ROOT / "notebooks").glob("*.ipynb"))


def _public() -> dict[str, list[str]]:
    """The names of `import jaxphoto` by room, each where it is defined."""
    jaxphoto = importlib.import_module("jaxphoto")
    found: dict[str, list[str]] = {}
    for name in jaxphoto.__all__:
        value = getattr(jaxphoto, name)
        if inspect.isclass(value) or inspect.isroutine(value):
            room = value.__module__.split(".")[1]
            found.setdefault(room, []).append(f"{value.__module__}.{value.__qualname__}")
    return {room: sorted(names) for room, names in sorted(found.items())}
