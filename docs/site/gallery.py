"""docs/gallery.md and its pictures: of each notebook what it is about, a picture of it, and what it concludes.

python docs/site/gallery.py [--executed FOLDER]

Runs all notebooks, which takes some twenty minutes; with --executed keeps them there with their outputs, and takes
those that are there already. The picture is that of the cell with the tag `gallery`, or else the last.
"""

import argparse
import base64
import io
import re
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
PAGE, IMAGES = ROOT / "docs" / "gallery.md", ROOT / "docs" / "images" / "gallery"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# A picture is as wide as a page of the site, and some 30 kB.
_WIDTH, _QUALITY = 900, 70
_HEAD = """# Gallery

What the notebooks show, one picture each and their own last words. They lie in `notebooks/` without outputs, so that
none is out of date; `JAXPHOTO_RUN_NOTEBOOKS=true mkdocs build` makes this site with all of them. This page was written
by `python docs/site/gallery.py`, which runs them.
"""


def main() -> None:
    """Write the page and its pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--executed", type=Path, help="folder of notebooks with their outputs")
    with tempfile.TemporaryDirectory() as folder:
        executed = parser.parse_args().executed or Path(folder)
        executed.mkdir(parents=True, exist_ok=True)
        IMAGES.mkdir(exist_ok=True)
        entries = [entry(path, run(path, executed / path.name)) for path in NOTEBOOKS]
    PAGE.write_text("\n".join([_HEAD, *entries]), "utf-8")


def run(path: Path, kept: Path) -> nbformat.NotebookNode:
    """A notebook with its outputs."""
    if not kept.exists():
        print(path.name, flush=True)
        notebook = nbformat.read(path, as_version=4)
        place = {"metadata": {"path": path.parent}}
        NotebookClient(notebook, timeout=1200, kernel_name="python3", resources=place).execute()
        nbformat.write(notebook, kept)
    return nbformat.read(kept, as_version=4)


def entry(path: Path, notebook: nbformat.NotebookNode) -> str:
    """The notebook's part of the page; its picture is written."""
    title, _, text = notebook.cells[0].source.partition("\n")
    about = _on_page(" ".join(text.strip().split("\n\n")[0].split()))
    title = title.lstrip("# ").strip()
    parts = [f"## [{title}](../notebooks/{path.name})", about]
    if shown := picture(notebook):
        name = f"{path.stem}.webp"
        shown.thumbnail((_WIDTH, 4 * _WIDTH))
        shown.save(IMAGES / name, quality=_QUALITY, method=6)
        parts.append(f"![{title}](images/gallery/{name})")
    if words := conclusion(notebook):
        parts.append(words)
    return "\n\n".join(parts) + "\n"


def picture(notebook: nbformat.NotebookNode) -> Image.Image | None:
    """That of the cell with the tag, or the last."""
    tagged = [cell for cell in notebook.cells if "gallery" in cell.metadata.get("tags", ())]
    found = [
        output.data["image/png"]
        for cell in tagged or notebook.cells
        for output in cell.get("outputs", ())
        if "image/png" in output.get("data", {})
    ]
    return Image.open(io.BytesIO(base64.b64decode(found[-1]))).convert("RGB") if found else None


def conclusion(notebook: nbformat.NotebookNode) -> str:
    """The last words that a cell worked out, or that stand in the last cell of text."""
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
