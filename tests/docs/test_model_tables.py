"""The tables of models in the pages are what the classes declare; a new model fails here with the row that it wants."""

import re
from itertools import groupby
from pathlib import Path

from jaxphoto.camera import DISTORTIONS, PROJECTIONS

ROOT = Path(__file__).resolve().parents[2]


def listed(names):
    """k1, k2, k3, p1 -> k1 to k3, p1."""
    parts = [re.fullmatch(r"([a-z_]+?)(\d*)", name).groups() for name in names]
    runs = groupby(enumerate(parts), lambda item: (item[1][0], int(item[1][1]) - item[0] if item[1][1] else None))
    found = []
    for _, run in runs:
        run = ["".join(part) for _, part in run]
        found += [f"{run[0]} to {run[-1]}"] if len(run) > 2 else run
    return ", ".join(found)


def row(model):
    """The row of docs/block_folder.md for a distortion."""
    needed = model.needed()
    constants = [f"{name}, needed" if name in needed else f"{name}; 0 when not named" for name in model.constants]
    choices = [f"{key}: {' (default) or '.join(words)}" for key, words in model.choices.items()]
    return f"| `{model.name}` | {listed(model.coefficients)} | {'; '.join([*constants, *choices])} |"


def test_the_table_of_distortions_is_what_they_declare():
    text = (ROOT / "docs/block_folder.md").read_text(encoding="utf-8")
    table = re.search(
        r"^\| distortion \| coefficients \| constants and choices \|\n\|[ -|]*\n((?:\|.*\n)*)", text, re.M
    )
    assert table is not None
    assert table[1].splitlines() == [row(model) for model in DISTORTIONS.values()]


def test_the_pages_name_every_projection():
    models, folder = ((ROOT / "docs" / page).read_text(encoding="utf-8") for page in ("models.md", "block_folder.md"))
    for name, model in PROJECTIONS.items():
        assert f"| `{name}` | `{model.__name__}`" in models, name
    assert f'projection = "perspective"  # perspective (default) | {" | ".join(list(PROJECTIONS)[1:])}:' in folder
