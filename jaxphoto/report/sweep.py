"""A sweep of designs as a tidy table and as plots."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.errors import InputError
from jaxphoto.observations import AXES
from jaxphoto.report.formatting import without_unit
from jaxphoto.report.plots import axes_or_new, label, log_ticks, new_figure
from jaxphoto.sensitivity.sweep import Sweep

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMNS = ("design", "converged", "determined", "quantity", "of", "value", "unit")
_DEG = 180 / np.pi
# Ratio of largest to smallest value from which on an axis is logarithmic.
_FAR_APART = 20.0


class _Column(NamedTuple):
    """One quantity of every design."""

    quantity: str
    of: str
    values: np.ndarray
    unit: str


def sweep_table(sweep: Sweep) -> pd.DataFrame:
    """One row per number: the design's parameters, design, converged, determined, quantity, of, value, unit.

    | quantity | of |
    | --- | --- |
    | `sigma` | an unknown shared by images, such as `c_mm`, `lever_arm_up_m` |
    | `rms_sigma` | `X_m` ... `kappa_deg`: root mean square over the images |
    | `rho` | two shared unknowns, `c_mm:lever_arm_up_m` |
    | `mean_abs_rho`, `max_abs_rho` | exterior orientation and shared unknown, `omega:yp_mm`; over the images |
    | `check_sigma`, `check_rmse` | `X_m`, `Y_m`, `Z_m` of check points: predicted, and of the simulated observations |
    | `sigma0` | `block` |

    Standard deviations are a priori; times `sigma0` they are a posteriori. Unknowns go by their last name, `c_mm`, and
    by their whole path, `interior[kodak].c_mm`, where two have the same. Rows of a design that did not converge, or
    cannot tell its unknowns apart, have NaN as value. Raises InputError for a parameter with the name of a column.
    """
    names = list(sweep.parameters[0])
    taken = [name for name in names if name in _COLUMNS]
    if taken:
        raise InputError(f"a parameter of the designs is called {taken[0]}, like a column of the table: rename it")
    columns = list(_columns(sweep))
    design = np.repeat(np.arange(len(sweep)), len(columns))
    n = len(sweep)
    table = pd.DataFrame([dict(p) for p in sweep.parameters], columns=names).iloc[design].reset_index(drop=True)
    table["design"] = design + 1
    table["converged"], table["determined"] = sweep.converged[design], sweep.determined[design]
    table["quantity"], table["of"] = [c.quantity for c in columns] * n, [c.of for c in columns] * n
    table["value"] = np.stack([c.values for c in columns], axis=1).ravel()
    table["unit"] = [c.unit for c in columns] * n
    # NaN of a determined design means that it lacks the quantity.
    usable = table["value"].notna() | ~(table["converged"] & table["determined"])
    return table[usable].reset_index(drop=True)


def _columns(sweep: Sweep) -> Iterator[_Column]:
    shared, factors = _shared_names(sweep.labels)
    exterior = [f"{name}_m" if k < 3 else f"{name}_deg" for k, name in enumerate(sweep.eop_names)]
    for k, (name, factor) in enumerate(zip(shared, factors, strict=True)):
        yield _Column("sigma", name, factor * sweep.sigma[:, k], _unit(name))
    for k, name in enumerate(exterior):
        yield _Column("rms_sigma", name, (1.0 if k < 3 else _DEG) * sweep.exterior_sigma[:, k], _unit(name))
    for a, b in zip(*np.triu_indices(len(shared), 1), strict=True):
        yield _Column("rho", f"{shared[a]}:{shared[b]}", sweep.correlation[:, a, b], "")
    for quantity, values in (("mean_abs_rho", sweep.mean_abs), ("max_abs_rho", sweep.max_abs)):
        for e, k in np.ndindex(values.shape[1:]):
            yield _Column(quantity, f"{sweep.eop_names[e]}:{shared[k]}", values[:, e, k], "")
    for quantity, values in (("check_sigma", sweep.check_sigma), ("check_rmse", sweep.check_rmse)):
        for k, axis in enumerate(AXES):
            yield _Column(quantity, f"{axis}_m", values[:, k], "m")
    yield _Column("sigma0", "block", sweep.sigma0, "")


def _shared_names(labels: Sequence[str]) -> tuple[list[str], list[float]]:
    """Names of the shared unknowns, with angles in degrees, and the factors that this takes."""
    last = [label.rpartition("].")[2] for label in labels]
    chosen = last if len(set(last)) == len(last) else labels
    factors = [_DEG if label.endswith("_rad") else 1.0 for label in labels]
    return [name.removesuffix("_rad") + "_deg" if name.endswith("_rad") else name for name in chosen], factors


def _unit(name: str) -> str:
    """The unit at the end of a name; none of a coefficient (docs/models.md)."""
    return without_unit(name)[1]


def sweep_figure(table: pd.DataFrame, x: str, shown: Sequence[tuple[str, str]], by: Sequence[str] = ()) -> Figure:
    """One panel for each (quantity, of) of `shown`: its value against the parameter `x`, one line for each `by`.

    `table` is that of `sweep_table`, or a part of it in which `x` and `by` identify each design. Raises InputError
    where they do not, where there is no such column, or where nothing of `shown` is in the table.
    """
    figure = new_figure(3.4 * min(len(shown), 3), 2.9 * -(-len(shown) // 3))
    panels = figure.subplots(-(-len(shown) // 3), min(len(shown), 3), squeeze=False).ravel()
    for axes, (quantity, of) in zip(panels, shown, strict=False):
        _lines(axes, _chosen(table, x, quantity, of, by), x, by)
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    if by:
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    return figure


def plot_sweep(
    table: pd.DataFrame, x: str, quantity: str, of: str, ax: Axes | None = None, *, by: Sequence[str] = ()
) -> Axes:
    """One panel of `sweep_figure`: a quantity of something against the parameter `x`, one line for each `by`.

    Raises InputError where that does.
    """
    rows = _chosen(table, x, quantity, of, by)
    ax = axes_or_new(ax)
    _lines(ax, rows, x, by)
    if by:
        ax.legend(fontsize=8)
    return ax


def _chosen(table: pd.DataFrame, x: str, quantity: str, of: str, by: Sequence[str]) -> pd.DataFrame:
    """The rows to be drawn."""
    for column in (x, *by):
        if column not in table:
            raise InputError(f"the table has no column {column}: choose among {', '.join(map(str, table.columns))}")
    rows = table[(table["quantity"] == quantity) & (table["of"] == of)]
    if rows.empty:
        raise InputError(f"the table has no {quantity} of {of}: look at table[['quantity', 'of']].drop_duplicates()")
    if rows.duplicated([x, *by]).any():
        raise InputError(
            f"several designs have the same {', '.join([x, *by])}: take a part of the table in which these "
            "identify each design, or name more parameters in by"
        )
    return rows


def _lines(axes: Axes, rows: pd.DataFrame, x: str, by: Sequence[str]) -> None:
    places = rows[x].drop_duplicates()
    numbers = pd.api.types.is_numeric_dtype(places) and not pd.api.types.is_bool_dtype(places)
    for name, line in rows.groupby(list(by), sort=False) if by else [((), rows)]:
        name_of_line = label(", ".join(f"{p} {v}" for p, v in zip(by, name, strict=True)))
        at = line.sort_values(x) if numbers else line
        axes.plot(at[x] if numbers else at[x].astype(str).map(label), at["value"], "o-", ms=3, lw=1, label=name_of_line)
    if numbers and _far_apart(places):
        log_ticks(axes)
    if rows["quantity"].iloc[0].endswith("abs_rho"):
        axes.set_ylim(0, 1.02)
    elif _far_apart(rows["value"]):
        axes.set_yscale("log")
    quantity, of, unit = rows[["quantity", "of", "unit"]].iloc[0]
    axes.set_title(label(f"{quantity} {of}" + f" [{unit}]" * bool(unit)), fontsize=9)
    axes.set_xlabel(label(x), fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(lw=0.3)


def _far_apart(values: pd.Series) -> bool:
    return bool(values.min() > 0 and values.max() / values.min() >= _FAR_APART)
