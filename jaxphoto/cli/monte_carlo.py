"""`jaxphoto monte-carlo`: a block in, re-adjustments with drawn errors out."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Column, Table

from jaxphoto.block import Block
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.judged_block import print_judgement
from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.progress import StepsLeft
from jaxphoto.errors import InputError
from jaxphoto.experiment import MonteCarlo
from jaxphoto.io import read_block
from jaxphoto.io.draws_folder import check_place
from jaxphoto.procedures import adjust
from jaxphoto.report.draws import LONG, write_draws_page
from jaxphoto.report.formatting import readable
from jaxphoto.sensitivity import PER, Bias, Readjustment, bias, check_draws, noise

_KINDS = (*PER, "noise")
_UNITS = {
    "station": "m", "trajectory": "m", "control": "m", "lever-arm": "m", "attitude": "deg",
    "trajectory-attitude": "deg", "boresight": "deg", "image-points": "mm", "interior": "own",
}  # fmt: skip
_LARGEST_SEED = 2**63 - 1
_KEPT = ("exterior", "points")


@command("monte-carlo")
def monte_carlo_command(
    output: Output,
    context: typer.Context,
    block: Annotated[Path, typer.Argument(help="Block folder (see docs/block_folder.md).")],
    out: Annotated[Path, typer.Option(help="Folder for the draws; a run in it with the same settings goes on.")],
    kind: Annotated[str, one_of(_KINDS, "--bias", help="What is wrong.")],
    per: Annotated[str | None, typer.Option(help="Whose own an error is: block, strip, image, point ...")] = None,
    sigma_m: Annotated[
        str | None, typer.Option(help="Standard deviation in m: one number, or three by commas.")
    ] = None,
    sigma_deg: Annotated[str | None, typer.Option(help="The same in degrees, for attitudes and boresight.")] = None,
    sigma_mm: Annotated[str | None, typer.Option(help="The same in mm, for image points.")] = None,
    sigma: Annotated[str | None, typer.Option(help="The same in the units of the interior parameter.")] = None,
    parameter: Annotated[str, typer.Option(help="The interior parameter (c_mm, k1 ...) for --bias interior.")] = "",
    on: Annotated[list[str] | None, typer.Option(help="Only these strips, images, points ... (repeatable).")] = None,
    draws: Annotated[int, typer.Option(help="Number of draws.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Another seed draws other errors.")] = 0,
    keep: Annotated[
        list[str] | None, typer.Option("--with", help="Keep these, too: exterior, points (with check points).")
    ] = None,
) -> None:
    """Re-adjust a block with drawn errors: draws.parquet, summary.csv, summary.json and pictures."""
    check_draws(draws)
    if seed > _LARGEST_SEED:
        raise InputError(f"--seed {seed}: give a number of at most {_LARGEST_SEED}")
    kept = tuple(keep or ())
    if unknown := [name for name in kept if name not in _KEPT]:
        raise InputError(f"--with {unknown[0]}: there are {', '.join(_KEPT)}")
    if kind == "noise" and (per is not None or on or parameter):
        raise InputError("--bias noise is of every observation: it takes no --per, --on or --parameter")
    check_place(out)
    sigmas = _sigma_of(kind, {"m": sigma_m, "deg": sigma_deg, "mm": sigma_mm, "own": sigma})
    with output.progress.status("reading the block") as status:
        read, made = read_block(block), made_by(context, block)
        drawn = _bias_of(read, kind, sigmas, per, on or [], parameter)
        status.update("adjusting the nominal block")
        adjusted = adjust(read)
        status.update("preparing the draws")
        run = Readjustment(
            adjusted,
            drawn.applied,
            np.broadcast_to(drawn.sigma, (draws, len(drawn.sigma))),
            exterior="exterior" in kept,
            points="points" in kept,
        )
    print_judgement(adjusted, output)
    study = MonteCarlo(read, run, drawn, draws, seed, out)
    with output.progress.status("compiling what draws") as status:
        left = StepsLeft(output.progress, status)
        study.draw(lambda done: left("draws", done, draws))
        status.update(f"writing {out}")
        summary, table = study.write()
        write_draws_page(summary, table, read.sensors, out, made)
    output.screen.print(
        f"{summary['draws']} draws, {summary['converged']} converged, {summary['fallbacks']} by a full adjustment; "
        f"{summary['draws_per_second']:.0f} draws a second",
    )
    heads = "quantity", "unit", "nominal", "mean", "sd", "predicted sigma", "ratio"
    # Where there is no room, numbers are broken, too, and not cut.
    shown = Table(*(Column(head, overflow="fold") for head in heads), title="estimates over the draws")
    few = table[~table["quantity"].astype(str).str.startswith(("bias.", *LONG))]
    columns = ["quantity", "unit", "nominal", "mean", "sd", "predicted_sigma", "ratio"]
    for row in readable(few[columns]).itertuples(index=False):
        shown.add_row(*row)
    output.screen.print(shown)
    output.wrote(out, f"results in {out} (open report.html)")


def _sigma_of(kind: str, given: dict[str, str | None]) -> list[float]:
    """The standard deviation in the units of the adjustment; raises InputError where it is in others."""
    option = {"m": "--sigma-m", "deg": "--sigma-deg", "mm": "--sigma-mm", "own": "--sigma"}
    named = [unit for unit, text in given.items() if text is not None]
    if kind == "noise":
        if named:
            raise InputError(f"--bias noise takes no {option[named[0]]}: errors have the observations' own sigmas")
        return []
    wanted = _UNITS[kind]
    if named != [wanted]:
        raise InputError(f"a bias of kind {kind} takes {option[wanted]}, and no other sigma")
    text = str(given[wanted])
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{option[wanted]} {text}: one number, or three with commas between") from None
    return [np.radians(v) for v in numbers] if wanted == "deg" else numbers


def _bias_of(block: Block, kind: str, sigmas: list[float], per: str | None, on: list[str], parameter: str) -> Bias:
    if kind == "noise":
        return noise(block)
    return bias(block, kind, sigmas, per, of=on, parameter=parameter)
