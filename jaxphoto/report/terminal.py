"""One screen of text: outcome, sigma naught, warnings first, then the interior orientation."""

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxphoto.report.findings import Level, Verdict
from jaxphoto.report.tables import Tables
from jaxphoto.statistics import residual_spread

_FINDINGS = 12
_COLOURS = {Level.INFORMATION: "green", Level.WARNING: "yellow", Level.ALARM: "red"}
_MARKS = {Level.INFORMATION: "-", Level.WARNING: "!", Level.ALARM: "!!"}
_PARAMETERS = 18


def print_adjustment(tables: Tables, verdict: Verdict, console: Console) -> None:
    """Print the verdict on an adjustment with its reasons, and the interior orientation with its sigmas."""
    adjusted = tables.adjusted
    n, u = sum(adjusted.n_observations.values()), sum(adjusted.n_unknowns.values())
    console.print(f"[bold]{escape(adjusted.block.title)}[/bold]" if adjusted.block.title else "[bold]block[/bold]")
    colour = _COLOURS[verdict.level]
    console.print(f"[bold {colour}]{verdict.headline}[/bold {colour}]", highlight=False)
    for finding in verdict.findings[:_FINDINGS]:
        mark = _COLOURS[finding.level]
        console.print(f"[{mark}]{_MARKS[finding.level]}[/{mark}] {escape(finding.text)}", highlight=False)
    if len(verdict.findings) > _FINDINGS:
        console.print(f"and {len(verdict.findings) - _FINDINGS} more in report.html")
    console.print(f"{adjusted.outcome.value} ({int(adjusted.steps)} iterations)", highlight=False)
    console.print(
        f"sigma0 [bold]{float(adjusted.sigma0):.6g}[/bold]   redundancy {adjusted.redundancy} = {n} observations"
        + (f" + {adjusted.n_constraints} constraints" if adjusted.n_constraints else "")
        + f" - {u} unknowns"
    )
    if tables.significance:
        table = Table(
            "camera", "parameter", "value", "sigma", "|value| / sigma", "p", title="interior orientation (a posteriori)"
        )
        for s in tables.significance:
            table.add_row(
                s.camera, s.parameter, f"{s.value:.8g}", f"{s.sigma:.3g}", f"{s.ratio:.4g}", f"{s.p_value:.2g}"
            )
        console.print(table)
    if len(tables.georeferencing):
        table = Table("parameter", "value", "sigma", title="mounts and strips (a posteriori)")
        for parameter, value, sigma in tables.georeferencing.head(_PARAMETERS).itertuples(index=False):
            table.add_row(parameter, f"{value:.6g}", f"{sigma:.3g}")
        console.print(table)
    spread = Table("group", "axis", "n", "RMSE", "maximum", "unit", title="residuals")
    for v in residual_spread(adjusted):
        spread.add_row(v.group, v.axis, str(v.n), f"{v.rmse:.4g}", f"{v.max_abs:.4g}", v.unit)
    console.print(spread)
