"""Outputs of the notebooks, kept small beside them: docs/site/outputs/NAME.json, pictures in docs/images/gallery.

Notebooks lie in the repository without outputs, so that their changes can be read. What a run showed is kept by cell,
with the code that it is of; a notebook whose code has changed since has no outputs, and says so.
"""

import base64
import hashlib
import io
import json
from pathlib import Path

import nbformat
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
OUTPUTS, PICTURES = ROOT / "docs" / "site" / "outputs", ROOT / "docs" / "images" / "gallery"
# A picture is as wide as a page of the site, and some 15 kB.
_WIDTH, _QUALITY = 900, 60
# Of one output the first of these that it has.
_KINDS = ("text/html", "image/png", "text/markdown", "text/latex", "text/plain")


def code_of(notebook: nbformat.NotebookNode) -> str:
    """Hash the code of a notebook."""
    code = "\0".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    return hashlib.sha256(code.encode()).hexdigest()


def keep(path: Path, executed: nbformat.NotebookNode, made: str) -> None:
    """Write what a run of the notebook showed, instead of what was kept; `made` says when and with what."""
    for old in PICTURES.glob(f"{path.stem}_*.webp"):
        old.unlink()
    cells = [cell for cell in executed.cells if cell.get("outputs")]
    shown = {cell.id: [_small(path.stem, cell.id, output) for output in cell.outputs] for cell in cells}
    kept = {"made": made, "code": code_of(executed), "cells": shown}
    OUTPUTS.mkdir(exist_ok=True)
    (OUTPUTS / f"{path.stem}.json").write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", "utf-8")


def _small(stem: str, cell: str, output: nbformat.NotebookNode) -> dict:
    """Return a stream unchanged, other outputs in their richest form, pictures as files."""
    if output.output_type == "stream":
        return {"output_type": "stream", "name": output.name, "text": output.text}
    kind = next(kind for kind in _KINDS if kind in output.data)
    value = output.data[kind]
    if kind == "image/png":
        picture = Image.open(io.BytesIO(base64.b64decode(value))).convert("RGB")
        picture.thumbnail((_WIDTH, 4 * _WIDTH))
        number = len(list(PICTURES.glob(f"{stem}_{cell}*.webp")))
        name = f"{stem}_{cell}{f'_{number}' if number else ''}.webp"
        picture.save(PICTURES / name, quality=_QUALITY, method=6)
        kind, value = "text/html", f'<img src="../images/gallery/{name}" alt="What the cell above draws">'
    return {"output_type": "display_data", "metadata": {}, "data": {kind: value}}


def kept(path: Path) -> dict | None:
    """Return the stored outputs of this code."""
    file = OUTPUTS / f"{path.stem}.json"
    found = json.loads(file.read_text("utf-8")) if file.is_file() else None
    return found if found and found["code"] == code_of(nbformat.read(path, as_version=4)) else None


def with_outputs(path: Path) -> nbformat.NotebookNode:
    """Return the notebook with its stored outputs."""
    notebook, shown = nbformat.read(path, as_version=4), kept(path)
    for cell in notebook.cells:
        if shown and cell.cell_type == "code":
            cell.outputs = [nbformat.from_dict(output) for output in shown["cells"].get(cell.id, ())]
    return notebook
