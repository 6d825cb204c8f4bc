"""`jaxphoto adjust`: a block in, tables and a report out."""

import os
import time
from pathlib import Path
from threading import Thread
from typing import Annotated

import typer

import jaxphoto
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.provenance import Provenance
from jaxphoto.errors import JaxphotoError
from jaxphoto.io import read_block, read_truth, write_block
from jaxphoto.io.cameras import CAMERAS_READ
from jaxphoto.losses import LOSSES
from jaxphoto.procedures import adjust_for_tables
from jaxphoto.procedures.weights import MadeByBlunders, made_by_blunders
from jaxphoto.report import (
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


@command("adjust", f"An earlier calibration of a camera, which block.toml may name, is read from {CAMERAS_READ}.")
def adjust_command(
    output: Output,
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
) -> None:
    """Adjust a block and write tables, statistics and a report. Exit code 1: written, but the verdict is red."""
    splits = None if weights is None else _splits_of(weights)
    check_folder(out, block)
    Thread(target=prepare_pictures, daemon=True).start()
    began = time.perf_counter()
    with output.progress.status("reading the block") as status:
        read = read_block(block)
        options = {"rotations": rotations, "snoop": snoop, "robust": robust, "max_steps": max_steps, "weights": weights}
        signed, made = Provenance.of_block("adjust", block, options), made_by(context, block)
        seconds = {"read": time.perf_counter() - began}
        status.update("looking for approximate values")
        snooped = None
        if snoop or robust:
            loss = LOSSES[robust]() if robust else None
            snooped = jaxphoto.snoop(read, loss=loss, max_steps=max_steps, report=status.update)
        adjusted = snooped.adjusted if snooped else adjust_for_tables(read, max_steps, status.update)
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
        order = [name for name in ("read", "start", "compile", "solve", "covariance") if name in times]
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
    print_adjustment(tables, verdict, output.screen)
    if components:
        print_components(components, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
    if verdict.severity == "error":
        raise typer.Exit(1)


def _splits_of(words: str) -> tuple[str, ...]:
    """The splits that `--weights` names; none for "group", one component a group."""
    splits = tuple(dict.fromkeys(word.strip() for word in words.split(",")))
    if unknown := [word for word in splits if word not in (*SPLITS, "group")]:
        raise JaxphotoError(f"--weights {unknown[0]}: there are group, {_SPLITS}, with commas between")
    return tuple(word for word in splits if word != "group")
