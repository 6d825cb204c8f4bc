"""`jaxphoto sensitivity`: a block in, what its estimates hang on out."""

import time
from pathlib import Path
from typing import Annotated, get_args

import numpy as np
import typer
from rich.table import Column, Table

import jaxphoto
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.judged_block import print_judgement
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.errors import InputError
from jaxphoto.io import read_block
from jaxphoto.procedures import adjust_for_tables
from jaxphoto.report.formatting import in_figures
from jaxphoto.report.sensitivity import SensitivityTables, write_sensitivity
from jaxphoto.report.terminal import plain
from jaxphoto.sensitivity.influence import DELTA0, Per
from jaxphoto.writing import check_folder

_SHOWN = 12


@command("sensitivity")
def sensitivity_command(
    output: Output,
    context: typer.Context,
    block: Annotated[Path, typer.Argument(help="Block folder (see docs/block_folder.md).")],
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    per: Annotated[Per, one_of(get_args(Per), help="Whose stations have a bias.")] = "strip",
    bias_m: Annotated[float, typer.Option(help="Size of the station bias.")] = 0.10,
    delta0: Annotated[float, typer.Option(help="Non-centrality of the test of normalised residuals.")] = DELTA0,
    max_steps: Annotated[int, typer.Option(min=1, help="Most iterations.")] = jaxphoto.MAX_STEPS,
) -> None:
    """Exact sensitivity of the interior orientation and the check points to stations, and to undetected errors."""
    if bias_m == 0 or not np.isfinite(bias_m):
        raise InputError(f"--bias-m {bias_m:g} is no bias: give its size in metres")
    check_folder(out, block)
    began = time.perf_counter()
    with output.progress.status("reading the block") as status:
        read, made = read_block(block), made_by(context, block)
        seconds = {"read": time.perf_counter() - began}
        status.update("looking for approximate values")
        adjusted = adjust_for_tables(read, max_steps, status.update)
        status.update("differentiating")
        tables = SensitivityTables(adjusted, per, bias_m, delta0)
        largest = tables.largest
        status.update(f"writing {out}")
        order = ("compile", "solve", "covariance", "sensitivity")
        write_sensitivity(tables, out, seconds | {name: adjusted.seconds[name] for name in order}, made)
    print_judgement(adjusted, output)
    heads = Column("estimate", overflow="fold"), "exact", "in sigmas", "first-order", "by stations of"
    shown = Table(*heads, title=f"largest changes by a station bias of {bias_m:g} m per {per}")
    columns = ["estimate", "estimate_unit", "exact", "over_sigma", "first_order", "unit", "axis"]
    for name, unit, exact, over, first, per_unit, axis in largest[columns].head(_SHOWN).itertuples(index=False):
        of = "" if unit == "1" else f" {unit}"
        moved = [f"{in_figures(float(v), 3)}{of}" for v in (exact, first)]
        shown.add_row(plain(str(name)), moved[0], f"{over:.2f}", moved[1], plain(f"{per_unit} in {axis}"))
    output.screen.print(shown)
    output.wrote(out, f"results in {out} (open report.html)")
