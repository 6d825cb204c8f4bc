"""`jaxphoto models`: a block in, a comparison of distortion models out."""

import time
from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.made import made_by
from jaxphoto.cli.output import Output, command
from jaxphoto.io import read_block
from jaxphoto.procedures.model_choice import FOLDS, model_choice
from jaxphoto.report.model_choice import print_model_choice, write_model_choice
from jaxphoto.writing import check_folder

_MODELS = "brown:none,brown:k1,brown:k1+k2,brown:k1+k2+k3,brown,brown:all"


@command("models")
def models_command(
    output: Output,
    context: typer.Context,
    block: Annotated[Path, typer.Argument(help="Block folder (see docs/block_folder.md).")],
    out: Annotated[Path, typer.Option(help="Folder for the results; earlier results in it are replaced.")],
    models: Annotated[
        str,
        typer.Option(
            help="Comma-separated: brown (usual coefficients), brown:all, brown:none, brown:k1+k2, smac.",
            show_default="six of brown, from none to all",
        ),
    ] = _MODELS,
    folds: Annotated[int, typer.Option(min=0, help="Parts of the cross-validation; 0 for none.")] = FOLDS,
    seed: Annotated[int, typer.Option(min=0, help="Of the draw of what is left out.")] = 0,
) -> None:
    """Compare distortion models by cross-validation, information criteria and significance."""
    check_folder(out, block)
    began = time.perf_counter()
    with output.progress.status("reading the block") as status:
        read, made = read_block(block), made_by(context, block)
        seconds = {"read": time.perf_counter() - began}
        named = [name for name in models.split(",") if name.strip()]
        choice = model_choice(read, named, k=folds, seed=seed, report=status.update)
        seconds["adjust"] = time.perf_counter() - began - seconds["read"]
        status.update(f"writing {out}")
        write_model_choice(choice, read, out, seconds, made)
    print_model_choice(choice, output.screen)
    output.wrote(out, f"results in {out} (open report.html)")
    if not choice.by_bic:
        raise typer.Exit(1)
