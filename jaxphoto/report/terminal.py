"""Terminal output: verdict, sigma naught, interior orientation, residuals."""

import numpy as np
import pandas as pd
from rich.console import Console
from rich.text import Text

from jaxphoto.errors import counted, printable
from jaxphoto.report.findings import MARKS, Verdict
from jaxphoto.report.formatting import to_rich
from jaxphoto.report.residual_findings import component_tables
from jaxphoto.report.tables import Tables, check_spread, recovery_spread
from jaxphoto.statistics import VarianceComponents

_FINDINGS, _PARAMETERS = 12, 18
_COLOURS = {"note": "green", "warning": "yellow", "error": "red"}


def plain(text: str) -> Text:
    """Return text without rich markup."""
    return Text(printable(text))


def print_lines(lines, console: Console) -> None:
    """Print sentences unchanged, one per line."""
    for line in lines:
        console.print(plain(line), soft_wrap=True)


def print_verdict(verdict: Verdict, console: Console) -> None:
    """Print a verdict with its first findings."""
    console.print(Text(verdict.headline, f"bold {_COLOURS[verdict.severity]}"))
    for finding in verdict.findings[:_FINDINGS]:
        console.print(Text(f"{MARKS[finding.severity]} ", _COLOURS[finding.severity]) + plain(finding.text))
    if (more := len(verdict.findings) - _FINDINGS) > 0:
        console.print(f"and {more} more in report.html")


def print_adjustment(tables: Tables, verdict: Verdict, console: Console) -> None:
    """Print the verdict on an adjustment, sigma naught, interior orientation, residuals and check points."""
    adjusted = tables.adjusted
    n, u = sum(adjusted.n_observations.values()), sum(adjusted.n_unknowns.values())
    console.print(plain(adjusted.block.title or "block"), style="bold")
    print_verdict(verdict, console)
    console.print(f"{adjusted.outcome.value} ({int(adjusted.steps)} iterations)")
    console.print(
        f"sigma0 {float(adjusted.sigma0):.6g}   redundancy {adjusted.redundancy} = {n} observations"
        + (f" + {adjusted.n_constraints} constraints" if adjusted.n_constraints else "")
        + f" - {u} unknowns"
    )
    if tables.significance:
        rows = [(s.camera, s.parameter, s.value, s.sigma, s.unit, s.ratio, s.p_value) for s in tables.significance]
        table = pd.DataFrame(
            rows, columns=["camera", "parameter", "value", "sigma", "unit", "value / sigma", "p_value"]
        )
        console.print(to_rich(table, "interior orientation (a posteriori)"))
    if len(tables.georeferencing):
        console.print(to_rich(tables.georeferencing.head(_PARAMETERS), "mounts and strips (a posteriori)"))
    console.print(to_rich(tables.residual_spread.drop(columns="mean"), "residuals"))
    if len(points := tables.check_points):
        spread = check_spread(points)
        spread = spread[spread["n"] > 0].drop(columns="unit").rename(columns=lambda c: f"{c}_m" if c[0] in "mr" else c)
        spreads = [(points[f"d{a}_m"], points[f"sigma_d{a}_m"]) for a in spread["axis"]]
        spread["largest at"] = [str(points["point"].iloc[int(np.nanargmax(np.abs(d)))]) for d, _ in spreads]
        spread["RMS / sigma"] = [f"{np.sqrt(np.nanmean((d / s) ** 2)):.2f}" for d, s in spreads]
        console.print(to_rich(spread, "check points"))
    if tables.truth:
        recovery = recovery_spread(tables.recovery)
        recovery["beyond_2_sigma"] = recovery["beyond_2_sigma"].map("{:.1%}".format)
        console.print(to_rich(recovery, "(estimate - truth) / sigma"))


def print_components(components: VarianceComponents, console: Console) -> None:
    """Print the variance component of each group."""
    table = component_tables(components)["variance_components"].drop(columns="degrees_of_freedom")
    console.print(to_rich(table, f"variance components ({counted(components.iterations, 'iteration')})"))


def print_warning(warning: str, console: Console, **options) -> None:
    """Print a warning with a yellow mark."""
    console.print(Text.assemble(("!", "yellow"), " ", plain(warning)), **options)
