"""One screen of text: outcome, sigma naught, warnings first, then the interior orientation."""

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxphoto.report.tables import Tables
from jaxphoto.statistics import residual_spread

_WARNINGS = 12
_PARAMETERS = 18


def print_adjustment(tables: Tables, warnings: list[str], console: Console) -> None:
    """Print the outcome of an adjustment, what to worry about, and the interior orientation with its sigmas."""
    adjusted = tables.adjusted
    colour = "green" if bool(adjusted.converged) else "red"
    n, u = sum(adjusted.n_observations.values()), sum(adjusted.n_unknowns.values())
    console.print(f"[bold]{escape(adjusted.block.title)}[/bold]" if adjusted.block.title else "[bold]block[/bold]")
    console.print(f"[{colour}]{adjusted.outcome.value}[/{colour}] ({int(adjusted.steps)} iterations)")
    console.print(
        f"sigma0 [bold]{float(adjusted.sigma0):.6g}[/bold]   redundancy {adjusted.redundancy} = {n} observations"
        + (f" + {adjusted.n_constraints} constraints" if adjusted.n_constraints else "")
        + f" - {u} unknowns"
    )
    for warning in warnings[:_WARNINGS]:
        console.print(f"[yellow]![/yellow] {escape(warning)}", highlight=False)
    if len(warnings) > _WARNINGS:
        console.print(f"[yellow]![/yellow] and {len(warnings) - _WARNINGS} more in report.html")
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
