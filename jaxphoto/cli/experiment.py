"""`jaxphoto experiment`: published experiments, or your own, run again and printed beside what was published."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.experiment import (
    compare,
    find_experiments,
    load_experiment,
    run_experiment,
    write_runs,
)
from jaxphoto.writing import check_folder


@command("experiment")
def experiment_command(
    output: Output,
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Folder of the experiment, such as 000, or all.")],
    out: Annotated[Path, typer.Option(help="Folder for the results; an earlier run in it is replaced.")] = Path(
        "results"
    ),
    experiments: Annotated[Path, typer.Option(help="Folder that holds the experiments.")] = Path("experiments"),
    layouts: Annotated[
        int | None, typer.Option(min=1, help="Simulated layouts; the experiment's own number if not given.")
    ] = None,
) -> None:
    """Run experiments; write tables.csv and report.html, ours beside what the paper prints."""
    chosen = find_experiments(experiments, name)
    check_folder(out, *chosen)
    declared = {folder: load_experiment(folder) for folder in chosen}
    runs, made = {}, {folder: made_by(context, folder) for folder in chosen}
    for folder, experiment in declared.items():
        with output.progress.status(folder.name) as status:
            runs[folder] = run_experiment(experiment, folder, layouts, status.update)
        # After each, so that an experiment that fails loses none before it.
        write_runs(runs, out, made)
        table = compare(runs[folder], folder)
        output.screen.print(_judgement(experiment.title, table))
        judged = table[table["within"] != ""]
        within = {str(of): (cells == "yes").sum() for of, cells in judged.groupby("table", sort=False)["within"]}
        output.tell(**{folder.name: {"within": within, "of": judged.groupby("table", sort=False).size().to_dict()}})
        for failure in runs[folder].failures:
            output.warn(f"left out: {failure}")
    output.wrote(out, f"results in {out} (open report.html)")


def _judgement(title: str, table) -> Table:
    """How many cells of each table are within their tolerance, and which are not."""
    shown = Table(title=title)
    for heading in ("table", "within", "of", "not within (ours, published)"):
        shown.add_column(heading)
    for name, cells in table.groupby("table", sort=False):
        judged, bad = cells[cells["within"] != ""], cells[cells["within"] == "no"]
        listed = "; ".join(f"{r.row} {r.column} ({r.ours:.4g}, {r.published:.4g})" for r in bad.itertuples())
        shown.add_row(str(name), str((judged["within"] == "yes").sum()), str(len(judged)), listed)
    return shown
