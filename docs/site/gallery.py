"""Run the notebooks, keep their outputs for the site, and write docs/gallery.md.

python docs/site/gallery.py [NAME ...] [--executed FOLDER]

Runs the notebooks whose names begin with one of NAME, all if none is given, which takes some twenty minutes; with
--executed it takes those that lie in FOLDER with their outputs, and leaves there what it runs. Of each the site then
shows every output (outputs.py), and the page what it is about, a picture, and what it concludes. The picture is that of
the cell with the tag `gallery`, or else the last.
"""

import argparse
import datetime
import re
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from outputs import NOTEBOOKS, ROOT, keep, with_outputs

import jaxphoto

PAGE = ROOT / "docs" / "gallery.md"
_HEAD = """# Gallery

One figure and the conclusion of every notebook. `python docs/site/gallery.py` runs the notebooks and writes this page.
"""
_PICTURE = re.compile(r'<img src="\.\./(images/gallery/[^"]+)"')


def main() -> None:
    """Run, keep, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="beginnings of the names of notebooks; all if none is given")
    parser.add_argument("--executed", type=Path, help="folder of notebooks with their outputs")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        executed = given.executed or Path(folder)
        executed.mkdir(parents=True, exist_ok=True)
        for path in NOTEBOOKS:
            if not given.names or path.name.startswith(tuple(given.names)):
                run(path, executed / path.name)
    PAGE.write_text("\n".join([_HEAD, *map(entry, NOTEBOOKS)]), "utf-8")


def run(path: Path, executed: Path) -> None:
    """Run a notebook, unless it lies there with its outputs, and keep what it shows."""
    if not executed.exists():
        print(path.name, flush=True)
        notebook = nbformat.read(path, as_version=4)
        place = {"metadata": {"path": path.parent}}
        NotebookClient(notebook, timeout=1200, kernel_name="python3", resources=place).execute()
        nbformat.write(notebook, executed)
    on = datetime.date.fromtimestamp(executed.stat().st_mtime)
    keep(path, nbformat.read(executed, as_version=4), f"{on}, jaxphoto {jaxphoto.__version__}")


def entry(path: Path) -> str:
    """Write the notebook's part of the page."""
    notebook = with_outputs(path)
    title, _, text = notebook.cells[0].source.partition("\n")
    about = _on_page(" ".join(text.strip().split("\n\n")[0].split()))
    title = title.lstrip("# ").strip()
    parts = [f"## [{title}](../notebooks/{path.name})", about]
    if shown := picture(notebook):
        parts.append(f"![{title}]({shown})")
    if words := conclusion(notebook):
        parts.append(words)
    return "\n\n".join(parts) + "\n"


def picture(notebook: nbformat.NotebookNode) -> str:
    """Return the picture of the tagged cell, or of the last."""
    tagged = [cell for cell in notebook.cells if "gallery" in cell.metadata.get("tags", ())]
    found = [
        shown[1]
        for cell in tagged or notebook.cells
        for output in cell.get("outputs", ())
        if (shown := _PICTURE.match(output.get("data", {}).get("text/html", "")))
    ]
    return found[-1] if found else ""


def conclusion(notebook: nbformat.NotebookNode) -> str:
    """Return the last text that a cell computed, or the last text cell."""
    for cell in reversed(notebook.cells):
        for output in cell.get("outputs", ()):
            if "text/markdown" in output.get("data", {}):
                return _on_page(output.data["text/markdown"].strip())
    words = [cell.source for cell in notebook.cells if cell.cell_type == "markdown"][-1]
    paragraphs = re.sub(r"^#+ .*\n+", "", words).strip().split("\n\n")
    # What announces the cell below it concludes nothing.
    return _on_page("\n\n".join(text for text in paragraphs if not text.endswith(":")))


def _on_page(text: str) -> str:
    """Text with links to pages of docs/ as they are from this page."""
    return text.replace("](../docs/", "](")


if __name__ == "__main__":
    main()
