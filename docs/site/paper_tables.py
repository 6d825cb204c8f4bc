"""The tables of docs/papers.md: printed values with a tolerance, and ours above them.

jaxphoto experiment all --layouts 4 --out RUNS && python docs/site/paper_tables.py RUNS

RUNS/tables.csv is kept as docs/papers/tables.csv; without RUNS the page is written from that.
"""

import argparse
import re
from pathlib import Path

import pandas as pd

from jaxphoto.experiment.page import table_texts

PAGE = Path(__file__).resolve().parents[1] / "papers.md"
KEPT = PAGE.parent / "papers" / "tables.csv"
_PLACE = re.compile(r"(<!-- tables (\d+) -->\n).*?(?=<!-- end of tables -->)", re.DOTALL)


def main() -> None:
    """Write the tables into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="?", help="folder of results of `jaxphoto experiment all`")
    if runs := parser.parse_args().runs:
        cells = pd.read_csv(runs / "tables.csv", dtype={"paper": str, "note": str})
        # Six digits: what a page shows, without rounding noise of the last one.
        cells[cells["paper"].notna()].to_csv(KEPT, index=False, float_format="%.6g", lineterminator="\n")
    PAGE.write_text(with_tables(PAGE.read_text("utf-8")), "utf-8", newline="\n")


def with_tables(text: str) -> str:
    """Return the page with the stored tables of all papers."""
    cells = pd.read_csv(KEPT, dtype={"paper": str, "row": str, "unit": str, "note": str}, keep_default_na=False)
    for column in ("published", "ours", "tolerance", "spread", "n_layouts"):
        cells[column] = pd.to_numeric(cells[column])
    return _PLACE.sub(lambda place: place[1] + tables(cells[cells["paper"] == place[2]], place[2]), text)


def tables(cells: pd.DataFrame, paper: str) -> str:
    """All cells of a paper with a tolerance, as Markdown tables."""
    layouts, cells = int(cells["n_layouts"].max()), cells[cells["within"] != ""]
    parts = [
        f"\nOf {len(cells)} printed values with a [tolerance](../experiments/{paper}/published.csv) "
        f"{(cells['within'] == 'yes').sum()} are within it (layouts: {layouts}).\n"
    ]
    parts += [_table(str(name), of) for name, of in cells.groupby("table", sort=False)]
    return "\n".join([*parts, ""])


def _table(name: str, cells: pd.DataFrame) -> str:
    texts = table_texts(name, cells)
    rows = [["", *(column["heading"] for column in texts["columns"])], ["---"] * (len(texts["columns"]) + 1)]
    rows += [[row["name"], *map(_cell, row["cells"])] for row in texts["rows"]]
    lines = [f"**{texts['title']}**\n", *(f"| {' | '.join(row)} |" for row in rows), ""]
    if difference := texts["difference"]:
        lines += [f"Mean of |ours - printed|: {difference['words']}\n"]
    return "\n".join(lines)


def _cell(cell: dict) -> str:
    printed = cell["published"].split(" (±")[0]
    return f"**{cell['ours']}**<br>{printed}{' ✗' * (cell['within'] == 'no')}" if printed else ""


if __name__ == "__main__":
    main()
