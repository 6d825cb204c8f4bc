"""Ours beside what the papers print: `published.csv` joined with the means of a run."""

from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.errors import InputError
from jaxphoto.experiment.runner import Run, summary

MEAN_DIFFERENCE = "mean_abs_difference"
"""The column whose cell is the mean of |ours - published| over its table."""
_KEY = ["table", "row", "column"]
PUBLISHED = [*_KEY, "published", "unit", "tolerance", "note"]
COLUMNS = [
    "paper", *_KEY, "published", "ours", "unit", "tolerance", "within", "note", "spread", "n_layouts",
]  # fmt: skip


def read_published(folder: Path) -> pd.DataFrame:
    """The cells a paper prints, empty where `folder` has no published.csv. Raises InputError for one that is none."""
    path = folder / "published.csv"
    if not path.is_file():
        return pd.DataFrame(columns=PUBLISHED)
    table = pd.read_csv(path, dtype={"row": str, "column": str, "note": str}, keep_default_na=False, na_values=[""])
    if missing := [name for name in PUBLISHED if name not in table.columns]:
        raise InputError(f"{path}: the column {missing[0]} is missing; add it ({', '.join(PUBLISHED)} are needed)")
    if table.duplicated(_KEY).any():
        first = table[table.duplicated(_KEY)].iloc[0]
        raise InputError(f"{path}: {first['table']}, {first['row']}, {first['column']} is printed twice; keep one row")
    return table


def compare(run: Run, folder: Path) -> pd.DataFrame:
    """tables.csv: every cell that is printed or ours; `within` is yes or no where there is a tolerance, else empty.

    `ours` is the mean over `n_layouts` layouts, `spread` its standard deviation from layout to layout.
    """
    published = read_published(folder)
    table = published.merge(summary(run.cells), on=_KEY, how="left")
    ours = summary(run.cells).merge(published[_KEY], on=_KEY, how="left", indicator=True)
    table = pd.concat([table, ours[ours["_merge"] == "left_only"].drop(columns="_merge")], ignore_index=True)
    table = _with_mean_differences(table)
    judged = table["published"].notna() & table["ours"].notna() & table["tolerance"].notna()
    inside = (table["ours"] - table["published"]).abs() <= table["tolerance"]
    table["within"] = np.where(judged, np.where(inside, "yes", "no"), "")
    table["paper"] = run.experiment.paper
    table["note"] = table["note"].fillna("")
    places = pd.factorize(table["table"])[0]
    return table[COLUMNS].iloc[np.argsort(places, kind="stable")].reset_index(drop=True)


def side_by_side(comparison: pd.DataFrame, table: str) -> pd.DataFrame:
    """One table of `compare` as it is printed: rows and columns as there, `published` and `ours` beside each other.

    What is neither printed nor ours is left out. Raises ValueError for a table that is none.
    """
    cells = comparison[comparison["table"] == table]
    if cells.empty:
        known = ", ".join(dict.fromkeys(comparison["table"]))
        raise ValueError(f"{table!r} is no table of this experiment; its tables are {known}")
    of = cells.set_index(["row", "column"])
    columns = pd.MultiIndex.from_product([dict.fromkeys(cells["column"]), ["published", "ours"]])
    wide = pd.DataFrame(index=pd.Index(list(dict.fromkeys(cells["row"])), name="row"), columns=columns, dtype=float)
    for row, column in of.index:
        wide.loc[row, column] = of.loc[(row, column), ["published", "ours"]].to_numpy()
    return wide.dropna(axis="columns", how="all")


def _with_mean_differences(table: pd.DataFrame) -> pd.DataFrame:
    """Cells of MEAN_DIFFERENCE filled in."""
    table = table.copy()
    for k in table.index[table["column"] == MEAN_DIFFERENCE]:
        cells = table[(table["table"] == table.loc[k, "table"]) & (table.index != k)]
        table.loc[k, "ours"] = (cells["ours"] - cells["published"]).abs().mean()
    return table
