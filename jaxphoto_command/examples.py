"""Commands that write examples, simulate blocks and run experiments."""

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option

from jaxphoto_command import options as opt
from jaxphoto_command.application import command
from jaxphoto_command.output import Output

PANEL = "Examples and simulation"
_SIMULATED, _RENDERED = ("lidar", "strips"), ("photographs", "board")
NEXT = {
    "cross_block": "jaxphoto adjust OUT --out results",
    "recipe": "jaxphoto simulate OUT --out block",
    "boresight": "jaxphoto simulate OUT --out flight",
    "lidar": "jaxphoto simultaneous OUT OUT/cloud.laz --trajectory OUT/trajectory.csv --out both",
    "strips": "jaxphoto strips OUT/cloud.laz --trajectory OUT/trajectory.csv --block OUT "
    "--adjust boresight,range-offset,angle-scale --cell-m 8 --knots-s 5 --out joint",
    "photographs": "jaxphoto fly OUT --features 1000 --out flight",
    "board": "jaxphoto calibrate OUT/*.jpg --board chessboard:8x6:square_mm=30 --out camera",
    "experiments": "jaxphoto experiment 000 --experiments OUT --layouts 4 --out runs",
}
"""Next command for each example. OUT is replaced by the path of the example."""


@command("example", PANEL, "jaxphoto example cross_block")
def example(
    output: Output,
    name: Annotated[
        str | None, Argument(metavar="NAME", help=f"Example: {', '.join(NEXT)} (default: list them).")
    ] = None,
    out: Annotated[Path | None, Option(help="Path to write (default: NAME or NAME.toml).")] = None,
) -> None:
    """Write an example block, recipe, experiment or set of photographs."""
    import shutil

    from jaxphoto.io import read_recipe, write_simulation
    from jaxphoto.io.shipped import EXAMPLES, shipped
    from jaxphoto.optional import extra
    from jaxphoto.simulation import simulate
    from jaxphoto.writing import check_file, check_folder, whole_file, whole_folder

    if name is None:
        output.say(*(f"{key:12} {text}" for key, text in EXAMPLES.items()))
        output.add(examples=dict(EXAMPLES))
        return
    source = shipped(name)
    made = name in _SIMULATED or name in _RENDERED
    target = out if out is not None else Path(name if source.is_dir() or made else source.name)
    if name in _SIMULATED:
        check_folder(target, source)
        with output.progress("simulating"):
            write_simulation(simulate(read_recipe(source)), target)
    elif name in _RENDERED:
        with extra():
            from jaxphoto.extras.photos.rendered_photographs import write_board, write_flight
        with output.progress("rendering"), whole_folder(target) as work:
            {"photographs": write_flight, "board": write_board}[name](work)
    elif source.is_dir():
        check_folder(target)
        with whole_folder(target) as work:
            shutil.copytree(source, work, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        check_file(target)
        with whole_file(target) as work:
            shutil.copyfile(source, work)
    following = NEXT[name].replace("OUT", str(target))
    output.wrote(target, f"wrote {target}; next: {following}")
    output.add(next=following)


@command("simulate", PANEL, "jaxphoto example recipe && jaxphoto simulate recipe.toml --out block --seed 1")
def simulate(
    output: Output,
    recipe: Annotated[Path, Argument(help="Recipe in TOML (docs/simulation.md).")],
    out: opt.BlockOut,
    seed: opt.Seed = 0,
    repeat: Annotated[
        int | None, Option(min=1, help="Simulate and adjust this number of flights; write errors and sigmas instead.")
    ] = None,
    workers: opt.Workers = None,
    scheduler: opt.Scheduler = None,
) -> None:
    """Simulate a block with known true parameters."""
    from jaxphoto.io import read_recipe, write_simulation
    from jaxphoto.io.recipe.truth import CLOUD, TRAJECTORY
    from jaxphoto.simulation import simulate
    from jaxphoto.writing import check_folder

    if repeat is not None:
        return _repeat(output, recipe, out, seed, repeat, workers, scheduler)
    if workers is not None or scheduler is not None:
        raise typer.BadParameter("--workers and --scheduler need --repeat.")
    check_folder(out, recipe)
    with output.progress("simulating") as progress:
        simulation = simulate(read_recipe(recipe), seed)
        progress.update(f"writing {out}")
        write_simulation(simulation, out)
    block, cloud = simulation.block, simulation.cloud
    counts = {
        "n_images": len(block.images),
        "n_points": len(block.points),
        "n_image_points": len(block.image_points.image),
        "n_laser_points": 0 if cloud is None else len(cloud),
    }
    scan = "" if cloud is None else f", {len(cloud)} laser points in {CLOUD}, their trajectory in {TRAJECTORY}"
    output.wrote(
        out,
        f"wrote {out}: {counts['n_images']} images, {counts['n_points']} points, {counts['n_image_points']} image "
        f"points{scan} (seed {seed}); the truth is in {out / 'truth'}",
    )
    output.add(**counts, seed=seed)
    return None


def _repeat(
    output: Output, recipe: Path, out: Path, seed: int, repeat: int, workers: int | None, scheduler: str | None
) -> None:
    """Simulate and adjust many flights."""
    from jaxphoto.experiment.simulated_flights import flights_verdict, simulate_flights, write_flights_page
    from jaxphoto.io import read_recipe
    from jaxphoto.io.draws_folder import check_place
    from jaxphoto.report.formatting import path_words, to_rich
    from jaxphoto.workers import connected

    check_place(out)
    read, record = read_recipe(recipe), output.command_record(recipe)
    with output.progress("simulating") as progress:
        told = lambda done: progress.steps("flights", done, repeat)  # noqa: E731
        with connected(workers, scheduler) as client:
            summary, table = simulate_flights(read, repeat, seed, out, told, client)
        write_flights_page(summary, table, out, record)
    output.say(flights_verdict(summary, table))
    shown = table.assign(parameter=[path_words(name).partition(" [")[0] for name in table["parameter"]])
    columns = ["parameter", "mean_error", "rms_error", "rms_sigma", "inside_percent", "unit"]
    output.screen.print(to_rich(shown[columns], "errors of the estimates"))
    output.wrote(out, f"results in {out} (open report.html)")


@command("experiment", PANEL, "jaxphoto example experiments && jaxphoto experiment 000 --layouts 4 --out runs")
def experiment(
    output: Output,
    name: Annotated[str, Argument(help="Folder of the experiment, like 000, or all.")],
    out: Annotated[Path, Option(help="Output folder; an earlier run in it is replaced.")] = Path("results"),
    experiments: Annotated[Path, Option(help="Folder of the experiments.")] = Path("experiments"),
    layouts: Annotated[
        int | None, Option(min=1, help="Number of simulated layouts (default: as in the experiment).")
    ] = None,
    workers: opt.Workers = None,
    scheduler: opt.Scheduler = None,
) -> None:
    """Run experiments; write tables.csv and report.html with the published values."""
    from jaxphoto.experiment import find_experiments, load_experiment, run_experiment, write_runs
    from jaxphoto.workers import connected
    from jaxphoto.writing import check_folder

    folders = find_experiments(experiments, name)
    check_folder(out, *folders)
    declared = {folder: load_experiment(folder) for folder in folders}
    runs, record = {}, {folder: output.command_record(folder) for folder in folders}
    with connected(workers, scheduler) as client:
        for folder, declaration in declared.items():
            with output.progress(folder.name) as progress:
                runs[folder] = run_experiment(declaration, folder, layouts, progress.update, client)
            # Write after each experiment, so that results remain if a later one fails.
            write_runs(runs, out, record)
            _print_run(output, runs[folder], folder)
    output.wrote(out, f"results in {out} (open report.html)")


def _print_run(output: Output, run: Any, folder: Path) -> None:
    """Print the agreement of an experiment with the published values."""
    from jaxphoto.experiment import compare
    from jaxphoto.experiment.page import agreement, far_apart, not_judged

    comparison = compare(run, folder)
    output.say(run.experiment.title, agreement(comparison))
    rows, counts = list[tuple[str, ...]](), dict[str, tuple[int, int]]()
    for of_table, cells in comparison.groupby("table", sort=False):
        within, of = int((cells["within"] == "yes").sum()), int((cells["within"] != "").sum())
        counts |= {str(of_table): (within, of)} if of else {}
        unjudged, far = int(not_judged(cells)["values"].sum()), far_apart(cells)
        outside = [f"{r.row} {r.column} ({r.ours:.4g}, {r.published:.4g})"
                   for r in cells[cells["within"] == "no"].itertuples()]  # fmt: skip
        ratios = [
            f"{r['row']} {r['column']} ({r['ours']:.3g}, {r['published']:.3g}: x {r['ratio']:.2g}"
            + ("" if math.isnan(r["expected"]) else f", expected {r['expected']:.3g}") + ")"
            for r in far.to_dict("records")
        ]  # fmt: skip
        rows.append((str(of_table), str(within), str(of), str(unjudged), "; ".join([*outside, *ratios])))
    headings = "table", "within", "judged", "not judged", "outside; twice or half without tolerance (ours, printed)"
    output.table("values within tolerance", headings, iter(rows))
    within_of, total = ({table: pair[k] for table, pair in counts.items()} for k in (0, 1))
    output.add(**{folder.name: {"within": within_of, "of": total}})
    for failure in run.failures:
        output.warn(f"skipped: {failure}")
