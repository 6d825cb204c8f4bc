"""Run notebooks and keep their outputs in them, small.

python docs/site/outputs.py [NAME ...]

Runs the notebooks whose names begin with one of NAME, all if none is given (twenty minutes). A notebook records the
code that its outputs are of; tests/docs/test_site.py fails if the code has changed since.
"""

import base64
import datetime
import hashlib
import io
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

import jaxphoto

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# Width of a figure on the site, and colours that drawings and grey-scale photographs need.
_WIDTH, _COLOURS = 900, 64
# The first of these that an output has is kept.
_KINDS = ("text/html", "image/png", "text/markdown", "text/latex", "text/plain")


def code_of(notebook: nbformat.NotebookNode) -> str:
    """Hash the code of a notebook."""
    code = "\0".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    return hashlib.sha256(code.encode()).hexdigest()


def is_current(notebook: nbformat.NotebookNode) -> bool:
    """Return True if the outputs are of this code."""
    return notebook.metadata.get("jaxphoto", {}).get("code") == code_of(notebook)


def run(path: Path) -> None:
    """Run a notebook and keep its outputs."""
    notebook = nbformat.read(path, as_version=4)
    place = {"metadata": {"path": path.parent}}
    NotebookClient(notebook, timeout=1200, kernel_name="python3", resources=place).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", ()):
            if output.output_type != "stream":
                _reduce(output)
    made = f"{datetime.date.today()}, jaxphoto {jaxphoto.__version__}"
    notebook.metadata["jaxphoto"] = {"run": made, "code": code_of(notebook)}
    notebook.metadata.pop("language_info", None)
    nbformat.write(notebook, path)


def _reduce(output: nbformat.NotebookNode) -> None:
    """Keep the richest form of an output; reduce figures in size and colours."""
    kind = next(kind for kind in _KINDS if kind in output.data)
    value = output.data[kind]
    if kind == "image/png":
        picture = Image.open(io.BytesIO(base64.b64decode(value))).convert("RGB")
        picture.thumbnail((_WIDTH, 4 * _WIDTH))
        file = io.BytesIO()
        picture.quantize(_COLOURS, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
        value = base64.b64encode(file.getvalue()).decode()
    output.data = {kind: value}


if __name__ == "__main__":
    for path in NOTEBOOKS:
        if path.name.startswith(tuple(sys.argv[1:]) or ("",)):
            print(path.name, flush=True)
            run(path)
