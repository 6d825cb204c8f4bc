"""Sweep of designs as a tidy table and as plots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from jaxphoto.camera import table_name
from jaxphoto.errors import InputError
from jaxphoto.observations import AXES
from jaxphoto.report.formatting import head_of, path_words, without_unit
from jaxphoto.report.plots import axes_or_new, label, log_ticks, new_figure
from jaxphoto.sensitivity.sweep import Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = ("design", "converged", "determined", "weak", "quantity", "of", "value", "unit")
_QUANTITIES = {
    "sigma": "sigma of {}", "rms_sigma": "RMS sigma of {}", "rho": "rho of {}", "mean_abs_rho": "mean |rho| of {}",
    "max_abs_rho": "largest |rho| of {}", "check_sigma": "predicted sigma of {} at check points",
    "check_rmse": "RMSE of {} at check points", "sigma0": "sigma naught",
}  # fmt: skip
_WITH_UNIT = ("sigma", "rms_sigma", "check_sigma", "check_rmse")
_DEG = 180 / np.pi
# Ratio of largest to smallest value above which an axis is logarithmic.
_FAR_APART = 20.0


def sweep_table(sweep: Sweep) -> pd.DataFrame:
    """Tabulate the sweep, one row per value.

    Columns: design parameters, design, converged, determined, weak, quantity, of, value, unit.

    | quantity | of |
    | --- | --- |
    | `sigma` | an unknown shared by images, such as `c_mm`, `lever_arm_up_m` |
    | `rms_sigma` | `X_m` ... `kappa_deg`: root mean square over the images |
    | `rho` | two shared unknowns, `c_mm:lever_arm_up_m` |
    | `mean_abs_rho`, `max_abs_rho` | exterior orientation and shared unknown, `omega:yp_mm`; over the images |
    | `check_sigma`, `check_rmse` | `X_m`, `Y_m`, `Z_m` of check points: predicted, and of the simulated observations |
    | `sigma0` | `block` |

    Standard deviations are a priori; multiply by `sigma0` for a posteriori values. Unknowns are named by the last part
    of their path, `c_mm`, or by the full path, `interior[kodak].c_mm`, if the short names are not unique. Values are
    NaN for a design without convergence or with a rank defect. A design with weakly determined unknowns has values, but
    `determined` is False and `weak` names the unknowns (`statistics.determinability`). Raises InputError for a
    parameter named like a column.
    """
    names = list(sweep.parameters[0])
    if taken := [name for name in names if name in _COLUMNS]:
        raise InputError(f"design parameter {taken[0]} has the name of a table column; rename it")
    columns = pd.DataFrame({"|".join(key): values for key, values in _columns(sweep)})
    short = dict(zip(sweep.labels, _short(sweep.labels), strict=True))
    designs = pd.DataFrame([dict(p) for p in sweep.parameters], columns=names)
    designs = designs.assign(
        design=np.arange(len(sweep)) + 1,
        converged=sweep.converged,
        determined=sweep.determined,
        weak=[", ".join(short.get(label, label) for label in weak) for weak in sweep.weak],
    )
    keys = designs.columns.tolist()
    wide = designs.join(columns)
    table = wide.melt(keys, var_name="key", value_name="value").sort_values("design", kind="stable")
    table[["quantity", "of"]] = table.pop("key").str.split("|", expand=True)
    table["unit"] = table["of"].map(lambda of: without_unit(of)[1]).where(table["quantity"].isin(_WITH_UNIT), "")
    # NaN in a valid design: the design lacks the quantity.
    usable = table["value"].notna() | table["design"].isin(np.flatnonzero(np.isnan(sweep.sigma0)) + 1)
    return table.loc[usable, [*keys, "quantity", "of", "value", "unit"]].reset_index(drop=True)


def _columns(sweep: Sweep) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
    """Yield (quantity, of) and the values of all designs."""
    labels = _short(sweep.labels)
    shared = [label.removesuffix("_rad") + "_deg" if label.endswith("_rad") else label for label in labels]
    for k, name in enumerate(shared):
        yield ("sigma", name), (_DEG if labels[k].endswith("_rad") else 1.0) * sweep.sigma[:, k]
    for k, name in enumerate(sweep.eop_names):
        unit, factor = ("m", 1.0) if k < 3 else ("deg", _DEG)
        yield ("rms_sigma", f"{name}_{unit}"), factor * sweep.exterior_sigma[:, k]
    for a, b in zip(*np.triu_indices(len(shared), 1), strict=True):
        yield ("rho", f"{shared[a]}:{shared[b]}"), sweep.correlation[:, a, b]
    for quantity, values in (("mean_abs_rho", sweep.mean_abs), ("max_abs_rho", sweep.max_abs)):
        for e, k in np.ndindex(values.shape[1:]):
            yield (quantity, f"{sweep.eop_names[e]}:{shared[k]}"), values[:, e, k]
    for quantity, values in (("check_sigma", sweep.check_sigma), ("check_rmse", sweep.check_rmse)):
        for k, axis in enumerate(AXES):
            yield (quantity, f"{axis}_m"), values[:, k]
    yield ("sigma0", "block"), sweep.sigma0


def _quantity_words(quantity: str, of: str, unit: str) -> str:
    """Return a quantity of `sweep_table` in words: "mean |rho| of omega and y_p", "sigma of c [mm]"."""
    names = (path_words(name) if "]." in name else head_of(name) for name in of.split(":"))
    text = _QUANTITIES[quantity].format(" and ".join(name.partition(" [")[0] for name in names))
    return text + f" [{unit}]" * bool(unit)


def _value_words(parameter: str, value: object) -> str:
    """Return a design parameter with its value and unit: "station 0.05 m"."""
    name, unit = without_unit(parameter)
    return f"{name.replace('_', ' ')} {value} {unit}".rstrip()


def _short(labels: Sequence[str]) -> list[str]:
    """Return the last parts of the labels, or the labels if these are not unique."""
    last = [label.rpartition("].")[2] for label in labels]
    return last if len(set(last)) == len(last) else list(labels)


def sweep_figure(table: pd.DataFrame, x: str, shown: Sequence[tuple[str, str]], by: Sequence[str] = ()) -> Figure:
    """Draw one `plot_sweep` per (quantity, of) of `shown`."""
    down, across = -(-len(shown) // 3), min(len(shown), 3)
    figure = new_figure(3.4 * across, 2.9 * down)
    for k, (quantity, of) in enumerate(shown):
        panel = plot_sweep(table, x, quantity, of, figure.add_subplot(down, across, k + 1), by=by)
        if by and (legend := panel.get_legend()):
            legend.remove()
    if by:
        figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    return figure


def plot_sweep(
    table: pd.DataFrame, x: str, quantity: str, of: str, ax: Axes | None = None, *, by: Sequence[str] = ()
) -> Axes:
    """Draw a quantity against the parameter `x`, one line per value of `by`; open circles: weakly determined unknowns.

    `table` is the table of `sweep_table`, or a subset in which `x` and `by` identify each design. Raises InputError if
    they do not, or for missing columns or quantities.
    """
    if missing := [column for column in (x, *by) if column not in table]:
        raise InputError(f"the table has no column {missing[0]}: choose among {', '.join(map(str, table.columns))}")
    of = ":".join(map(table_name, of.split(":")))
    rows = table[(table["quantity"] == quantity) & (table["of"] == of)]
    if rows.empty:
        raise InputError(f"the table has no {quantity} of {of}: look at table[['quantity', 'of']].drop_duplicates()")
    if rows.duplicated([x, *by]).any():
        raise InputError(
            f"several designs have the same {', '.join([x, *by])}: select rows in which these identify "
            "each design, or add parameters to by"
        )
    ax, places = axes_or_new(ax), rows[x].drop_duplicates()
    numbers = pd.api.types.is_numeric_dtype(places) and not pd.api.types.is_bool_dtype(places)
    for name, line in rows.groupby(list(by), sort=False) if by else [((), rows)]:
        words = label(", ".join(_value_words(p, v) for p, v in zip(by, name, strict=True)))
        at = line.sort_values(x) if numbers else line
        places_of = at[x] if numbers else at[x].astype(str).map(label)
        ax.plot(places_of, at["value"], "o-", ms=3, lw=1, label=words)
        weak = at["weak"] != ""
        ax.scatter(places_of[weak], at["value"][weak], 22, "white", edgecolors="black", linewidths=0.8, zorder=3)
    far_apart = lambda v: v.min() > 0 and v.max() / v.min() >= _FAR_APART  # noqa: E731
    if numbers and far_apart(places):
        log_ticks(ax)
    if quantity.endswith("abs_rho"):
        ax.set_ylim(0, 1.02)
    elif far_apart(rows["value"]):
        ax.set_yscale("log")
    ax.set_title(label(_quantity_words(quantity, of, rows["unit"].iloc[0])), fontsize=9)
    ax.set_xlabel(label(head_of(x)), fontsize=8)
    ax.tick_params(labelsize=7)
    ax.grid(lw=0.3)
    if by:
        ax.legend(fontsize=8)
    return ax
