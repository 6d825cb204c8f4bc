"""The tables of docs/papers.md: printed values with a tolerance, and ours above them.

jaxphoto experiment all --layouts 4 --out RUNS && python docs/site/paper_tables.py RUNS

RUNS/tables.csv is kept as docs/papers/tables.csv; without RUNS the page is written from that.
"""

import argparse
import re
from pathlib import Path

import pandas as pd

from jaxphoto.experiment.page import cell_words, heading, table_title

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
    rows: dict[str, dict[str, str]] = {row: {} for row in cells["row"]}
    for cell in cells.to_dict("records"):
        ours, printed = cell_words(cell)
        text = f"**{ours}**<br>{printed.split(' (')[0]}{' ✗' * (cell['within'] == 'no')}"
        rows[cell["row"]][heading(cell["column"], cell["unit"])] = text if printed else ""
    heads = list(dict.fromkeys(head for row in rows.values() for head in row))
    lines = [["", *heads], ["---"] * (len(heads) + 1)]
    lines += [[name, *(row.get(head, "") for head in heads)] for name, row in rows.items()]
    return "\n".join([f"**{table_title(name)}**\n", *(f"| {' | '.join(line)} |" for line in lines), ""])


if __name__ == "__main__":
    main()
