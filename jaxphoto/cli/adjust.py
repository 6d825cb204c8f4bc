"""`jaxphoto adjust`: a block in, tables and a report out."""

import os
import time
from pathlib import Path
from threading import Thread
from typing import Annotated

import typer

import jaxphoto
from jaxphoto.cli.app import app
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.console import plain_console
from jaxphoto.cli.made import made_by
from jaxphoto.cli.provenance import Provenance
from jaxphoto.errors import JaxphotoError
from jaxphoto.io import read_block, read_truth, write_block
from jaxphoto.losses import LOSSES
from jaxphoto.procedures import adjust_for_tables
from jaxphoto.procedures.weights import MadeByBlunders, made_by_blunders
from jaxphoto.report import (
    Level,
    Tables,
    Verdict,
    component_findings,
    component_tables,
    left_out_table,
    prepare_pictures,
    print_adjustment,
    print_components,
    snooped_findings,
    verdict_of,
    write_results,
)
from jaxphoto.statistics import EOP_NAMES, SPLITS
from jaxphoto.writing import check_folder, whole_folder

_SPLITS = ", ".join(SPLITS)


@app.command("adjust")
def adjust_command(
    context: typer.Context,
    block: Annotated[Path, typer.Argument(help="Block folder (see docs/block_folder.md).")],
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    rotations: Annotated[str, one_of(EOP_NAMES, help="Rotations that the correlations mean.")] = "omega_phi_kappa",
    snoop: Annotated[
        bool,
        typer.Option(
            "--snoop", help="Leave out what contradicts the other observations, and write what went and the block left."
        ),
    ] = False,
    robust: Annotated[str | None, one_of(LOSSES, help="As --snoop, from a robust adjustment with this loss.")] = None,
    max_steps: Annotated[int, typer.Option(min=1, help="Most iterations.")] = jaxphoto.MAX_STEPS,
    weights: Annotated[
        str | None, typer.Option(help=f"Estimate variance components, adjust with them: group, or by {_SPLITS}.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print summary.json in place of tables, for other programs.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but warnings and errors.")] = False,
) -> None:
    """Adjust a block and write tables, statistics and a report. Exit code 1: written, but the verdict is red."""
    splits = None if weights is None else _splits_of(weights)
    check_folder(out, block)
    Thread(target=prepare_pictures, daemon=True).start()
    console, errors = plain_console(quiet=quiet or as_json), plain_console(stderr=True, quiet=quiet)
    began = time.perf_counter()
    with errors.status("reading the block") as status:
        read = read_block(block)
        options = {"rotations": rotations, "snoop": snoop, "robust": robust, "max_steps": max_steps, "weights": weights}
        signed, made = Provenance.of_block("adjust", block, options), made_by(context, block)
        seconds = {"read": time.perf_counter() - began}
        status.update(
            f"adjusting {len(read.images)} images, {len(read.points)} points, "
            f"{len(read.image_points.image)} image points"
        )
        snooped = None
        if snoop or robust:
            loss = LOSSES[robust]() if robust else None
            snooped = jaxphoto.snoop(read, loss=loss, max_steps=max_steps, report=status.update)
        adjusted = snooped.adjusted if snooped else adjust_for_tables(read, max_steps)
        components, masked = None, list[MadeByBlunders]()
        if splits is not None and bool(adjusted.converged):
            status.update("estimating variance components")
            components = jaxphoto.variance_components(adjusted, splits, max_steps=max_steps)
            masked += made_by_blunders(adjusted, components, splits, max_steps=max_steps, report=status.update)
            adjusted = components.adjusted
        status.update("computing statistics")
        tables = Tables(adjusted, rotations, read_truth(block))  # type: ignore[arg-type]
        verdict = verdict_of(tables)
        found = snooped_findings(snooped, read) if snooped else []
        found += component_findings(components, masked) if components else []
        verdict = Verdict.of([*found, *verdict.findings])
        status.update(f"writing {out}")
        times = adjusted.seconds | seconds
        order = ("read", "compile", "solve", "covariance")
        with whole_folder(out) as work:
            of = "block" if snooped else os.path.relpath(block.resolve(), out.resolve())
            told = {"block": of, **signed.told}
            write_results(tables, verdict, work, {name: times[name] for name in order}, told, made)
            signed.write(read.images, work)
            for name, table in (component_tables(components) if components else {}).items():
                table.to_csv(work / f"{name}.csv", index=False)
            if snooped:
                left_out_table(snooped, read).to_csv(work / "left_out.csv", index=False)
                write_block(adjusted.block, work / "block")
    print_adjustment(tables, verdict, console)
    if components:
        print_components(components, console)
    console.print(f"results in {out} (open report.html)")
    if as_json:
        typer.echo((out / "summary.json").read_text(encoding="utf-8"), nl=False)
    if verdict.level == Level.ALARM:
        raise typer.Exit(1)


def _splits_of(words: str) -> tuple[str, ...]:
    """The splits that `--weights` names; none for "group", one component a group."""
    splits = tuple(dict.fromkeys(word.strip() for word in words.split(",")))
    if unknown := [word for word in splits if word not in (*SPLITS, "group")]:
        raise JaxphotoError(f"--weights {unknown[0]}: there are group, {_SPLITS}, with commas between")
    return tuple(word for word in splits if word != "group")
