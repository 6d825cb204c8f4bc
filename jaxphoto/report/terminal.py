"""One screen of text: outcome, sigma naught, warnings first, then the interior orientation."""

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from jaxphoto.errors import printable
from jaxphoto.report.check_points import check_spread
from jaxphoto.report.digits import in_figures, of_p, of_sigma, with_sigma
from jaxphoto.report.findings import MARKS, Level, Verdict
from jaxphoto.report.recovery import recovery_spread
from jaxphoto.report.tables import Tables
from jaxphoto.statistics import residual_spread

_FINDINGS = 12
_COLOURS = {Level.INFORMATION: "green", Level.WARNING: "yellow", Level.ALARM: "red"}
_PARAMETERS = 18
# Of more standard deviations nobody reads tenths.
_MANY = 100


def plain(text: str) -> Text:
    """Names of files as they are: what is markup of rich's in them stays text."""
    return Text(printable(text))


def print_verdict(verdict: Verdict, console: Console) -> None:
    """Print a verdict with its first reasons."""
    console.print(Text(verdict.headline, f"bold {_COLOURS[verdict.level]}"))
    for finding in verdict.findings[:_FINDINGS]:
        mark = Text(f"{MARKS[finding.level]} ", _COLOURS[finding.level])
        console.print(mark + plain(finding.text))
    if len(verdict.findings) > _FINDINGS:
        console.print(f"and {len(verdict.findings) - _FINDINGS} more in report.html")


def print_adjustment(tables: Tables, verdict: Verdict, console: Console) -> None:
    """Print the verdict on an adjustment with its reasons, and the interior orientation with its sigmas."""
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
        table = Table(
            "camera", "parameter", "value", "sigma", "unit", "|value| / sigma", "p",
            title="interior orientation (a posteriori)",
        )  # fmt: skip
        for s in tables.significance:
            table.add_row(
                plain(s.camera),
                plain(s.parameter),
                with_sigma(s.value, s.sigma),
                of_sigma(s.sigma),
                s.unit,
                f"{s.ratio:.0f}" if s.ratio > _MANY else f"{s.ratio:.1f}",
                of_p(s.p_value),
            )
        console.print(table)
    if len(tables.georeferencing):
        table = Table("parameter", "value", "sigma", title="mounts and strips (a posteriori)")
        for parameter, value, sigma in tables.georeferencing.head(_PARAMETERS).itertuples(index=False):
            table.add_row(plain(parameter), with_sigma(value, sigma), of_sigma(sigma))
        console.print(table)
    spread = Table("group", "axis", "n", "RMSE", "maximum", "unit", title="residuals")
    for v in residual_spread(adjusted):
        spread.add_row(
            v.group.replace("_", " "), v.axis, str(v.n), in_figures(v.rmse, 3), in_figures(v.max_abs, 3), v.unit
        )
    console.print(spread)
    if len(tables.check_points):
        console.print(_check_points(tables))
    if tables.truth:
        found = Table("group", "n", "rms ratio", "beyond 2 sigma", title="(estimate - truth) / sigma")
        for group, n, ratio, beyond in recovery_spread(tables.recovery).itertuples(index=False):
            found.add_row(plain(group), str(n), in_figures(ratio, 3), f"{beyond:.1%}")
        console.print(found)


def _check_points(tables: Tables) -> Table:
    """By how much check points are off, and that over what their standard deviations allow."""
    points = tables.check_points
    shown = Table("axis", "n", "mean m", "RMSE m", "maximum m", "of point", "rms / sigma", title="check points")
    for axis, n, mean, rmse, most, _ in check_spread(points).itertuples(index=False):
        if n:
            off, sigma = points[f"d{axis}_m"].to_numpy(), points[f"sigma_d{axis}_m"].to_numpy()
            farthest = plain(str(points["point"].iloc[np.nanargmax(np.abs(off))]))
            ratio = np.sqrt(np.nanmean((off / sigma) ** 2))
            shown.add_row(axis, str(n), *(in_figures(v, 3) for v in (mean, rmse, most)), farthest, f"{ratio:.2f}")
    return shown


def print_warning(warning: str, console: Console, **options) -> None:
    """Print a warning behind a yellow mark."""
    console.print(Text.assemble(("!", "yellow"), " ", plain(warning)), **options)
