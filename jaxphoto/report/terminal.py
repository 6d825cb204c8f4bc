"""Terminal output: verdict, sigma naught, interior orientation, residuals."""

import pandas as pd
from rich.console import Console
from rich.text import Text

from jaxphoto.adjustment import Adjustment
from jaxphoto.errors import counted, printable
from jaxphoto.report.findings import COLOURS, MARKS, Verdict
from jaxphoto.report.formatting import to_rich
from jaxphoto.report.residual_findings import component_tables
from jaxphoto.report.tables import Tables, check_spread, recovery_spread
from jaxphoto.statistics import VarianceComponents

# Maximum numbers of findings, of notes, and of parameters of mounts and strips.
_FINDINGS, _NOTES, _PARAMETERS = 12, 3, 18
# Terminal colour of a verdict.
_TERMINAL = {"green": "green", "amber": "yellow", "red": "red"}


def headline(text: str, colour: str) -> Text:
    """Return a verdict in bold and in its colour: green, amber or red."""
    return Text(printable(text), f"bold {_TERMINAL[colour]}")


def plain(text: str) -> Text:
    """Return text without rich markup."""
    return Text(printable(text))


def print_lines(lines, console: Console) -> None:
    """Print sentences unchanged, one per line."""
    for line in lines:
        console.print(plain(line), soft_wrap=True)


def print_verdict(verdict: Verdict, console: Console) -> None:
    """Print a verdict with its errors and warnings, or its first notes."""
    console.print(headline(verdict.headline, verdict.colour))
    serious = sum(finding.severity != "note" for finding in verdict.findings)
    shown = verdict.findings[: min(max(serious, _NOTES), _FINDINGS)]
    for finding in shown:
        console.print(Text(f"{MARKS[finding.severity]} ", _TERMINAL[COLOURS[finding.severity]]) + plain(finding.text))
    if more := len(verdict.findings) - len(shown):
        console.print(f"and {more} more in report.html")


def print_adjustment(tables: Tables, verdict: Verdict, console: Console) -> None:
    """Print the verdict on an adjustment, sigma naught, interior orientation, residuals and check points."""
    adjusted = tables.adjusted
    console.print(plain(adjusted.block.title or "block"), style="bold")
    print_verdict(verdict, console)
    console.print(f"{adjusted.outcome.value} ({counted(int(adjusted.steps), 'iteration')})")
    print_sigma0(adjusted, console)
    shown = {
        "interior orientation (a posteriori)": tables.interior[tables.interior["sigma"].notna()],
        "mounts and strips (a posteriori)": tables.georeferencing.head(_PARAMETERS),
        "residuals": tables.residual_spread.drop(columns="mean"),
        "check points": check_spread(tables.check_points) if len(tables.check_points) else tables.check_points,
        "(estimate - truth) / sigma": recovery_spread(tables.recovery) if tables.truth else pd.DataFrame(),
    }
    for name, table in shown.items():
        if len(table):
            console.print(to_rich(table, name))


def print_sigma0(adjusted: Adjustment, console: Console) -> None:
    """Print sigma naught and the redundancy."""
    n, u = sum(adjusted.n_observations.values()), sum(adjusted.n_unknowns.values())
    constraints = f" + {adjusted.n_constraints} constraints" if adjusted.n_constraints else ""
    console.print(
        f"sigma0 {float(adjusted.sigma0):.6g}   redundancy {adjusted.redundancy} = {n} observations{constraints} - {u} "
        "unknowns"
    )


def print_components(components: VarianceComponents, console: Console) -> None:
    """Print the variance component of each group."""
    table = component_tables(components)["variance_components"].drop(columns="degrees_of_freedom")
    console.print(to_rich(table, f"variance components ({counted(components.iterations, 'iteration')})"))


def print_warning(warning: str, console: Console, **options) -> None:
    """Print a warning with a yellow mark."""
    console.print(Text.assemble(("!", _TERMINAL["amber"]), " ", plain(warning)), **options)
