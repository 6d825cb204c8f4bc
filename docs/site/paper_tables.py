"""The tables of docs/papers/*.md: what the papers print and ours beside it.

jaxphoto experiment all --layouts 4 --out RUNS && python docs/site/paper_tables.py RUNS

RUNS/tables.csv is kept as docs/papers/tables.csv; without RUNS the pages are written from that.
"""

import argparse
import re
from pathlib import Path

import pandas as pd

from jaxphoto.experiment.page import table_texts

PAGES = Path(__file__).resolve().parents[1] / "papers"
KEPT = PAGES / "tables.csv"
_PLACE = re.compile(r"(?<=<!-- tables -->\n).*(?=<!-- end of tables -->)", re.DOTALL)
_MARKS = {"yes": " ✓", "no": " ✗", "": ""}


def main() -> None:
    """Write the tables into the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="?", help="folder of results of `jaxphoto experiment all`")
    if runs := parser.parse_args().runs:
        cells = pd.read_csv(runs / "tables.csv", dtype={"paper": str, "note": str})
        # Six digits: what a page shows, and no noise of the last one when it is made anew.
        cells[cells["paper"].notna()].to_csv(KEPT, index=False, float_format="%.6g", lineterminator="\n")
    for page in sorted(PAGES.glob("*.md")):
        text = page.read_text("utf-8")
        page.write_text(with_tables(text, page.stem), "utf-8", newline="\n")


def with_tables(text: str, paper: str) -> str:
    """Return the page with the stored tables."""
    cells = pd.read_csv(KEPT, dtype={"paper": str, "row": str, "unit": str, "note": str}, keep_default_na=False)
    for column in ("published", "ours", "tolerance", "spread", "n_layouts"):
        cells[column] = pd.to_numeric(cells[column])
    cells = cells[cells["paper"] == paper]
    return _PLACE.sub(lambda _: tables(cells, paper), text)


def tables(cells: pd.DataFrame, paper: str) -> str:
    """All tables of a paper as Markdown."""
    good, judged = (cells["within"] == "yes").sum(), (cells["within"] != "").sum()
    layouts = int(cells["n_layouts"].max())
    mean = f"the mean over {layouts} simulated blocks" if layouts > 1 else "of one simulated block"
    parts = [
        f"In each cell above **ours**, {mean}, below what is printed. For {judged} printed values a tolerance is "
        f"promised, in [published.csv](../../experiments/{paper}/published.csv); {good} are within it (✓), and "
        "✗ stands where not. All cells, with their spread: [tables.csv](tables.csv).\n"
    ]
    shown = cells.groupby("table", sort=False).filter(lambda of: of["published"].notna().any())
    return "\n" + "\n".join([*parts, *(_table(str(name), of) for name, of in shown.groupby("table", sort=False))])


def _table(name: str, cells: pd.DataFrame) -> str:
    texts = table_texts(name, cells)
    columns = texts["columns"]
    shown = [k for k in range(len(columns)) if any(row["cells"][k]["published"] for row in texts["rows"])]
    head = ["", *(columns[k]["heading"] + _notes(columns[k]["notes"]) for k in shown)]
    rows = [[row["name"], *(_cell(row["cells"][k]) for k in shown)] for row in texts["rows"]]
    lines = [f"**{texts['title']}**\n", *map(_row, [head, ["---"] * len(head), *rows]), ""]
    if difference := texts["difference"]:
        lines += [f"Mean of |ours - printed|: {difference['words']}{_MARKS[difference['within']]}\n"]
    if notes := texts["notes"]:
        lines += ["; ".join(f"{k}: {note}" for k, note in enumerate(notes, 1)) + ".\n"]
    return "\n".join(lines)


def _cell(cell: dict) -> str:
    printed = cell["published"].split(" (±")[0]
    ours = f"**{cell['ours']}**{_MARKS[cell['within']]}" if cell["ours"] else "-"
    return f"{ours}<br>{printed}{_notes([cell['note']] if cell['note'] else [])}" if printed or cell["ours"] else ""


def _notes(numbers: list[int]) -> str:
    return "".join(f" <sup>{number}</sup>" for number in numbers)


def _row(texts: list[str]) -> str:
    return "| " + " | ".join(texts) + " |"


if __name__ == "__main__":
    main()
