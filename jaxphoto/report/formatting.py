"""Formatting of values and tables: significant digits, units, text, HTML, terminal, Markdown, LaTeX.

CSV and Parquet contain full precision under the column names of docs/block_folder.md. All other formats show units in
the column heads and round values to the second digit of their standard deviation.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.table import Table
from rich.text import Text

from jaxphoto.camera import InteriorOrientation, parameter_names, parameter_unit
from jaxphoto.errors import InputError, printable

# Numbers ---------------------------------------------------------------------------------------------------------

# Smallest absolute value written without exponent, as in Python's "g".
_LEAST = 1e-4
# Maximum number of significant digits: more are rounding errors.
_MOST = 12
# Values of up to ten digits written with an exponent.
_LARGE = re.compile(r"(?<![\w.])([+-]?)(\d(?:\.\d*)?e\+0\d)(?!\w)")


def with_sigma(value: float, sigma: float) -> str:
    """Round a value to the second digit of its standard deviation."""
    if not sigma > 0 or not value or not math.isfinite(value):
        return f"{value:.8g}"
    power = math.floor(math.log10(max(abs(value), sigma)))
    places = min(1 - math.floor(math.log10(sigma)), _MOST - 1 - power)
    if max(abs(value), sigma) >= _LEAST:
        text = f"{value:.{max(places, 0)}f}"
    elif abs(value) >= sigma:
        text = f"{value:.{places + power}e}"
    else:
        text = f"{value / 10.0**power:.{places + power}f}e{power:03d}"
    if float(text) == 0:
        return text.removeprefix("-") if "e" not in text else "0"
    return text


def of_sigma(sigma: float) -> str:
    """Format a standard deviation with two significant digits; "" for zero."""
    return in_figures(sigma, 2) if sigma > 0 else ""


def plus_minus(value: float, sigma: float) -> str:
    """Format a value with its standard deviation: 12.3 +- 1.2."""
    return f"{with_sigma(value, sigma)} +- {of_sigma(sigma)}"


def of_p(p_value: float, digits: int = 2) -> str:
    """Format a p-value; "< 1e-300" if it underflows to zero."""
    return f"{p_value:.{digits}g}" if p_value > 0 else "< 1e-300"


def in_figures(value: float, figures: int) -> str:
    """Format a value with `figures` significant digits, trailing zeros included: 0.00350; zero is 0."""
    return without_powers(f"{value:#.{figures}g}").replace(".e", "e").rstrip(".") if value else "0"


def without_powers(text: str) -> str:
    """Replace exponents of large values in a text: 400 m, not 4e+02 m."""
    return _LARGE.sub(lambda number: f"{number[1]}{float(number[2]):.0f}", text)


def in_equal_figures(values: Iterable[float], most: int) -> list[str]:
    """Format the values of a column with an equal number of significant digits, at most `most`."""
    texts = [f"{v:.{most}g}" for v in values]
    digits = (len(text.partition("e")[0].lstrip("-").replace(".", "").lstrip("0")) for text in texts)
    figures = max(digits, default=most)
    return [in_figures(float(text), figures) for text in texts]


# Units -----------------------------------------------------------------------------------------------------------

# Units by name suffix, longest first.
_UNITS = {
    "m_per_s": "m/s", "deg_per_s": "deg/s", "rad_per_s": "rad/s", "mm_per_s": "mm/s", "mm_per_h": "mm/h",
    "per_h": "1/h", "mm_per_K": "mm/K", "per_K": "1/K", "deg": "deg", "rad": "rad", "mm": "mm", "ms": "ms",
    "m": "m", "s": "s", "px": "px", "cm": "cm", "ppm": "ppm",
}  # fmt: skip
# The principal point, of which names leave out the underscore.
_PRINCIPAL_POINT = re.compile(r"\b([xy]) ?p\b")
_UNIT = re.compile(r"_(" + "|".join(_UNITS) + r")$")


def without_unit(name: str) -> tuple[str, str]:
    """Split a name and its unit: sigma_X_m gives ("sigma_X", "m"). The unit is "" if there is none."""
    unit = _UNIT.search(name)
    return (name[: unit.start()], _UNITS[unit[1]]) if unit else (name, "")


def symbol(parameter: str) -> str:
    """Return the symbol of a parameter without its unit: c for c_mm, x_p for xp_mm."""
    return head_of(without_unit(parameter)[0])


# Owners of parameters, by the first part of a path.
_OWNERS = {"interior": "", "mounts": "mount ", "strips": "strip ", "points": "point ", "trajectory_knots": "strip "}


def path_words(path: str) -> str:
    """Return a parameter path in words: "kodak c [mm]" for interior[kodak].c_mm or kodak.c_mm."""
    owner, _, name = path.rpartition(".")
    kind, _, of = owner.partition("[" if "[" in owner else ".")
    return f"{_OWNERS.get(kind, kind.replace('_', ' ') + ' ')}{of.removesuffix(']')} {head_of(name)}".replace(
        "  ", " "
    ).strip()


def head_of(name: str) -> str:
    """Return a column's name with its unit in brackets: "sigma X [m]" for sigma_X_m, "x_p [mm]" for xp_mm."""
    words, unit = without_unit(name)
    words = _PRINCIPAL_POINT.sub(r"\1_p", words.replace("_", " "))
    return words + (f" [{unit}]" if unit else "")


def label_unit(label: str, cameras: Mapping[str, InteriorOrientation]) -> str:
    """Return the unit of a parameter path such as `interior[kodak].k1`; "" if unknown."""
    owner, _, parameter = label.rpartition("].")
    kind, _, name = owner.partition("[")
    if kind == "points" and not without_unit(parameter)[1]:
        return "m"
    return _unit_of(name if kind == "interior" else "", parameter, cameras)


def column_unit(column: str, cameras: Mapping[str, InteriorOrientation]) -> str:
    """Return the unit of a column of Monte Carlo draws: `kodak.k1`, `bias.kodak.k1` or `strips.E1.shift_X_m`."""
    camera, _, parameter = column.removeprefix("bias.").rpartition(".")
    return _unit_of(camera, parameter, cameras)


def _unit_of(camera: str, parameter: str, cameras: Mapping[str, InteriorOrientation]) -> str:
    if camera in cameras and parameter in parameter_names(cameras[camera]):
        return parameter_unit(cameras[camera], parameter)
    return without_unit(parameter)[1]


def in_file_unit(unit: str) -> tuple[float, str]:
    """Return the factor to the displayed unit and its name: degrees for rad."""
    return (180 / np.pi, "deg") if unit == "rad" else (1.0, unit)


# Tables as text --------------------------------------------------------------------------------------------------

# Columns whose standard deviation is in the column `sigma`, or `sd` for Monte Carlo draws.
_BY_SIGMA = (
    "value", "estimate", "truth", "error", "first", "second", "difference", "residual", "amount",
    "before", "after", "moved", "initial", "A", "B", "B - A",
)  # fmt: skip
_BY_SD = ("nominal", "mean", "q025", "q50", "q975")
# Columns whose standard deviation has a different name; of several columns the largest value is used.
_BY_OTHERS = {
    **dict.fromkeys(("column_px", "row_px", "d_column_px", "d_row_px"), ("sigma_px",)),
    **{f"d{a}_m": (f"sigma_survey_{a}_m", f"sigma_adjusted_{a}_m", f"sigma_{a}_m") for a in "XYZ"},
    "gap_m": ("sigma_m",),
}
_SIGMAS = ("sd", "predicted_sigma", "worst_px")
# A number as text.
_NUMBER = re.compile(r"[-+]?\d[\d.]*(e[-+]?\d+)?")
# Columns of parameters and their paths; columns of a table that replace the units of parameters.
_PATHS, _PATH = (
    ("parameter", "interior", "estimate", "parameter_a", "parameter_b", "with"),
    re.compile(r".+\]\.\w+$|[a-z_]+\.\w+$"),
)
_HAS_UNIT = {"unit", "rho", "estimate_unit", "mean_abs_rho", "max_abs_rho"}
# Number of significant digits of values without a standard deviation, by name without unit.
_DIGITS = {
    "w": 3, "w_X": 3, "w_Y": 3, "w_Z": 3, "detectable": 3, "share": 2, "ratio": 3, "rmse": 3, "rms": 3, "fit": 3,
    "survey": 3, "max_abs": 3, "factor": 3, "time": 10,
}  # fmt: skip
# Number of decimal places: fractions, multiples of a standard deviation, coordinates and angles without a standard
# deviation.
_PLACES = {
    "redundancy_number": 2, "largest_share": 3, "inside": 3, "effect_over_sigma": 2, "over_sigma": 2, "c_moves": 2,
    "xp_moves": 2, "yp_moves": 2, "most_moves": 1, "rho": 3, "mean_abs_rho": 3, "max_abs_rho": 3,
    **dict.fromkeys(("X_m", "Y_m", "Z_m", "E_m", "N_m", "H_m", "height_m", "distance_m"), 4),
    **dict.fromkeys(("omega_deg", "phi_deg", "kappa_deg", "roll_deg", "pitch_deg", "yaw_deg"), 4),
    "longitude_deg": 9, "latitude_deg": 9, "column_px": 2, "row_px": 2,
}  # fmt: skip


def readable(table: pd.DataFrame) -> pd.DataFrame:
    """Format a table as text: digits by standard deviation, "yes" and "no", empty cells for missing values."""
    # Objects: a column of text would lose markup.
    texts = {name: pd.Series(_texts(table, name), table.index, object) for name in table.columns}
    return pd.DataFrame(texts, columns=table.columns)


def _texts(table: pd.DataFrame, name: str) -> list[str]:
    column = table[name]
    if name in _PATHS and not pd.api.types.is_numeric_dtype(column):
        words = [path_words(v) if _PATH.match(v) else head_of(v) for v in column.astype(str)]
        # Correlations have no unit; a table may have a column of units instead.
        return [word.partition(" [")[0] for word in words] if _HAS_UNIT & set(table.columns) else words
    if name == "significant" and "parameter" in table:
        # A test against zero means nothing for c.
        shown = column.astype(object).where(table["parameter"] != "c_mm", None)
        return ["" if pd.isna(v) else _word(v) for v in shown]
    if name == "group":
        return [str(v).replace("_", " ") for v in column]
    if not pd.api.types.is_float_dtype(column):
        return ["" if pd.isna(v) else _word(v) for v in column.astype(object)]
    if (name.startswith("sigma") and not name.startswith("sigma0")) or name in _SIGMAS:
        return ["" if np.isnan(v) else of_sigma(v) for v in column]
    if name == "p_value":
        return ["" if np.isnan(v) else of_p(v) for v in column]
    sigmas, form = _sigmas_of(table, name), f".{_PLACES[name]}f" if name in _PLACES else ".8g"
    if sigmas is not None:
        cells = zip(column, sigmas, strict=True)
        return ["" if np.isnan(v) else with_sigma(v, s) if s > 0 else f"{v:{form}}" for v, s in cells]
    if name in _PLACES:
        return ["" if np.isnan(v) else f"{v:{form}}" for v in column]
    texts = iter(in_equal_figures(column.dropna(), _DIGITS.get(without_unit(name)[0], 4)))
    return ["" if np.isnan(v) else next(texts) for v in column]


def _sigmas_of(table: pd.DataFrame, name: str) -> pd.Series | None:
    """Return the standard deviations of a column, if the table has them; NaN or zero for fixed parameters."""
    if name == "mean" and {"rmse", "n"} <= set(table.columns):
        return table["rmse"] / np.sqrt(table["n"])
    if others := [other for other in _BY_OTHERS.get(name, ()) if other in table]:
        return table[others].max(axis=1)
    candidates = (f"sigma_{name}", "sigma" if name in _BY_SIGMA else "", "sd" if name in _BY_SD else "")
    return next((table[sigma] for sigma in candidates if sigma in table), None)


def _word(value: object) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    # Markup, a kind of str, stays unescaped.
    return value if isinstance(value, str) else str(value)


def without_empty(table: pd.DataFrame) -> pd.DataFrame:
    """Drop columns that are empty in all rows."""
    return table.loc[:, ~(table.isna() | (table == "")).all()] if len(table) else table


def numeric_columns(table: pd.DataFrame) -> list[bool]:
    """Return a mask of the numeric columns, which are right-aligned."""
    return [bool(pd.api.types.is_numeric_dtype(table[c]) and table[c].dtype != bool) for c in table.columns]


def to_rich(table: pd.DataFrame, title: str = "") -> Table:
    """Convert a table for the terminal, numeric columns right-aligned."""
    shown, texts = Table(title=title or None), readable(table)
    for name, number in zip(table.columns, numeric_columns(table), strict=True):
        number |= all(map(_NUMBER.fullmatch, texts[name]))
        shown.add_column(head_of(str(name)), justify="right" if number else "left")
    for row in texts.itertuples(index=False, name=None):
        shown.add_row(*(Text(printable(cell)) for cell in row))
    return shown


def to_markdown(table: pd.DataFrame, name: str = "") -> str:
    """Convert a table to Markdown, numeric columns right-aligned."""
    shown = readable(table)
    cells = [[head_of(str(c)) for c in shown.columns], *shown.to_numpy(object).tolist()]
    lines = ["| " + " | ".join(str(cell).replace("|", r"\|") for cell in row) + " |" for row in cells]
    lines.insert(1, "| " + " | ".join("---:" if right else "---" for right in numeric_columns(table)) + " |")
    return "\n".join(([f"## {head_of(name)}", ""] if name else []) + lines) + "\n"


def to_latex(table: pd.DataFrame, name: str = "") -> str:
    """Convert a table to LaTeX with booktabs rules (\\usepackage{booktabs})."""
    columns = "".join("r" if right else "l" for right in numeric_columns(table))
    names: dict[str, Any] = {"caption": head_of(name), "label": f"tab:{name}"} if name else {}
    return readable(table).rename(columns=head_of).to_latex(index=False, escape=True, column_format=columns, **names)


# Files -----------------------------------------------------------------------------------------------------------

_WRITERS: dict[str, tuple[str, Callable[[pd.DataFrame, str, Path], object]]] = {
    "csv": (".csv", lambda table, name, path: table.to_csv(path, index=False)),
    "parquet": (".parquet", lambda table, name, path: table.to_parquet(path, index=False)),
    "markdown": (".md", lambda table, name, path: path.write_text(to_markdown(table, name), encoding="utf-8")),
    "latex": (".tex", lambda table, name, path: path.write_text(to_latex(table, name), encoding="utf-8")),
}
TABLE_FORMATS = tuple(_WRITERS)


def check_table_format(kind: str) -> None:
    """Raise InputError for an unknown table format."""
    if kind not in _WRITERS:
        raise InputError(f"unknown table format {kind}; use one of {', '.join(TABLE_FORMATS)}")


def write_table(table: pd.DataFrame, name: str, folder: Path, kind: str) -> Path:
    """Write a table to the file `name` plus the suffix of its format in a folder. Return the path."""
    check_table_format(kind)
    suffix, write = _WRITERS[kind]
    path = folder / f"{name}{suffix}"
    write(table, name, path)
    return path
