"""Result tables for papers and programs: CSV, Parquet, Markdown, and LaTeX with booktabs.

CSV and Parquet hold the numbers as they are, under the names of docs/block_folder.md. Markdown and LaTeX are to be
read: units stand in the heads, and a number that has a standard deviation ends at the second digit of that.
"""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.errors import InputError
from jaxphoto.report.digits import alike, of_p, of_sigma, with_sigma
from jaxphoto.report.units import without_unit

# Columns whose numbers are as sure as the column `sigma` of the same row says.
_BY_SIGMA = (
    "value", "estimate", "truth", "error", "first", "second", "difference", "residual", "amount",
    "before", "after", "moved",
)  # fmt: skip
# Those of draws, by their scatter.
_BY_SD = ("nominal", "mean", "q025", "q50", "q975")
# Those whose standard deviation, or the largest of several, has another name.
_BY_OTHERS = {
    **dict.fromkeys(("column_px", "row_px", "d_column_px", "d_row_px"), ("sigma_px",)),
    **{f"d{a}_m": (f"sigma_survey_{a}_m", f"sigma_adjusted_{a}_m") for a in "XYZ"},
    "gap_m": ("sigma_m",),
}
# Standard deviations by other names.
_SIGMAS = ("sd", "predicted_sigma", "worst_px")
# What is read to so many digits, without a standard deviation of its own; names without units.
_DIGITS = {
    "w": 3, "w_X": 3, "w_Y": 3, "w_Z": 3, "detectable": 3, "share": 2, "ratio": 3, "rmse": 3, "rms": 3, "fit": 3,
    "survey": 3, "max_abs": 3, "factor": 3, "time": 10,
}  # fmt: skip
# What is read to so many places after the point: parts of one, multiples of a standard deviation, coordinates and
# angles of which no standard deviation is told.
_PLACES = {
    "redundancy_number": 2, "largest_share": 3, "inside": 3, "effect_over_sigma": 2, "over_sigma": 2, "c_moves": 2,
    "xp_moves": 2, "yp_moves": 2, "most_moves": 1, "rho": 3, "mean_abs_rho": 3, "max_abs_rho": 3,
    **dict.fromkeys(("X_m", "Y_m", "Z_m", "E_m", "N_m", "H_m", "height_m", "distance_m"), 4),
    **dict.fromkeys(("omega_deg", "phi_deg", "kappa_deg", "roll_deg", "pitch_deg", "yaw_deg"), 4),
    "longitude_deg": 9, "latitude_deg": 9, "column_px": 2, "row_px": 2,
}  # fmt: skip
_SPECIAL = {letter: f"\\{letter}" for letter in "&%$#_{}"} | {
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}",
}  # fmt: skip
_POWER = re.compile(r"^(-?[\d.]+)e([+-]?\d+)$")
_PER_MM = re.compile(r"^1/mm(?:\^(\d+))?$")
_GREEK = ("omega", "phi", "kappa", "sigma")
# A LaTeX table of more rows goes over several pages.
_PAGE = 45


def readable(table: pd.DataFrame) -> pd.DataFrame:
    """The table as text: the digits that standard deviations allow, "yes" and "no", nothing where nothing is known."""
    return pd.DataFrame({name: _texts(table, name) for name in table.columns}, columns=table.columns)


def _texts(table: pd.DataFrame, name: str) -> list[str]:
    column = table[name]
    if name == "parameter":
        # Paths, as of mounts[default].boresight_x_deg and scanner.boresight_up_deg, stay what they are.
        words = [head_of(v) if not re.search(r"[\[.]", v) and without_unit(v)[1] else v for v in column.astype(str)]
        # Of correlations the unit says nothing; else it may have a column.
        return [word.partition(" [")[0] for word in words] if {"unit", "rho"} & set(table.columns) else words
    if name == "group":
        return [str(v).replace("_", " ") for v in column]
    if not pd.api.types.is_float_dtype(column):
        return ["" if pd.isna(v) else _word(v) for v in column.astype(object)]
    if (name.startswith("sigma") and not name.startswith("sigma0")) or name in _SIGMAS:
        return ["" if np.isnan(v) else of_sigma(v) for v in column]
    sigmas = _sigmas_of(table, name)
    # What is held is told whole; what nothing is told of, as far as anyone reads it.
    if name == "p_value":
        return ["" if np.isnan(v) else of_p(v) for v in column]
    form = f".{_PLACES[name]}f" if name in _PLACES else ".8g"
    if sigmas is not None:
        own = zip(column, sigmas, strict=True)
        return ["" if np.isnan(v) else with_sigma(v, s) if s > 0 else f"{v:{form}}" for v, s in own]
    if name in _PLACES:
        return ["" if np.isnan(v) else f"{v:{form}}" for v in column]
    told = iter(alike(column.dropna(), _DIGITS.get(without_unit(name)[0], 4)))
    return ["" if np.isnan(v) else next(told) for v in column]


def _sigmas_of(table: pd.DataFrame, name: str) -> pd.Series | None:
    """The standard deviations of a column, where they are told: NaN or zero of what is held."""
    if name == "mean" and {"rmse", "n"} <= set(table.columns):
        # Of n numbers that scatter by their root mean square.
        return table["rmse"] / np.sqrt(table["n"])
    if others := [of for of in _BY_OTHERS.get(name, ()) if of in table]:
        return table[others].max(axis=1)
    own = (
        f"sigma_{name}",
        "sigma" if name in _BY_SIGMA else "",
        "sd" if name in _BY_SD else "",
    )
    return next((table[of] for of in own if of in table), None)


def _word(value: object) -> str:
    # Not by a dictionary: the number 1 is equal to True.
    return {"True": "yes", "False": "no"}[str(value)] if isinstance(value, bool | np.bool_) else str(value)


def head_of(name: str) -> str:
    """A column's name with its unit in brackets: "sigma X [m]" of sigma_X_m."""
    said, unit = without_unit(name)
    return said.replace("_", " ") + (f" [{unit}]" if unit else "")


def to_markdown(table: pd.DataFrame, name: str = "") -> str:
    """A table of Markdown, numbers to the right."""
    shown, right = readable(table), _right(table)
    cells = [[head_of(str(c)) for c in shown.columns], *shown.to_numpy(object).tolist()]
    lines = ["| " + " | ".join(str(cell).replace("|", r"\|") for cell in row) + " |" for row in cells]
    lines.insert(1, "| " + " | ".join("---:" if r else "---" for r in right) + " |")
    return "\n".join(([f"## {head_of(name)}", ""] if name else []) + lines) + "\n"


def to_latex(table: pd.DataFrame, name: str = "") -> str:
    """A table of LaTeX with the rules of booktabs (\\usepackage{booktabs}, and longtable for long ones)."""
    shown = readable(table)
    shown = pd.DataFrame({_latex_head(str(c)): [_latex(v) for v in shown[c]] for c in shown.columns})
    return shown.to_latex(
        index=False,
        escape=False,
        column_format="".join("r" if r else "l" for r in _right(table)),
        longtable=len(table) > _PAGE,
        caption=_latex(head_of(name)) if name else None,
        label=f"tab:{name}" if name else None,
    )


def _right(table: pd.DataFrame) -> list[bool]:
    return [bool(pd.api.types.is_numeric_dtype(table[c]) and table[c].dtype != bool) for c in table.columns]


def _latex(text: str) -> str:
    if power := _POWER.match(text):
        return rf"${power[1]} \times 10^{{{int(power[2])}}}$"
    if per_mm := _PER_MM.match(text):
        return f"mm$^{{-{per_mm[1] or 1}}}$"
    escaped = "".join(_SPECIAL.get(letter, letter) for letter in text)
    if escaped.startswith(("[", "*")):
        # Behind the end of a row they would be its option.
        escaped = f"{{}}{escaped}"
    return rf"$-${escaped[1:]}" if re.fullmatch(r"-[\d.]+", text) else escaped


def _latex_head(name: str) -> str:
    """Sigma and angles as Greek letters: `$\\sigma_{\\omega}$ [deg]` of sigma_omega_deg."""
    said, _, unit = head_of(name).partition(" [")
    words = [rf"\{word}" if word in _GREEK else word for word in said.split()]
    if words[:1] == [r"\sigma"] and len(words) == 2:
        said = rf"$\sigma_{{{words[1]}}}$"
    else:
        said = " ".join(f"${word}$" if word.startswith("\\") else _latex(word) for word in words)
    return f"{said} [{unit}" if unit else said


_WRITERS: dict[str, tuple[str, Callable[[pd.DataFrame, str, Path], object]]] = {
    "csv": (".csv", lambda table, name, path: table.to_csv(path, index=False)),
    "parquet": (".parquet", lambda table, name, path: table.to_parquet(path, index=False)),
    "markdown": (".md", lambda table, name, path: path.write_text(to_markdown(table, name), encoding="utf-8")),
    "latex": (".tex", lambda table, name, path: path.write_text(to_latex(table, name), encoding="utf-8")),
}
TABLE_FORMATS = tuple(_WRITERS)


def check_table_format(kind: str) -> None:
    """Raise InputError for a format that there is not."""
    if kind not in _WRITERS:
        raise InputError(f"there is no table format {kind}: give {', '.join(TABLE_FORMATS)}")


def write_table(table: pd.DataFrame, name: str, folder: Path, kind: str) -> Path:
    """Write a table as `name` with the ending of its format into a folder, and return where."""
    check_table_format(kind)
    ending, write = _WRITERS[kind]
    path = folder / f"{name}{ending}"
    write(table, name, path)
    return path
