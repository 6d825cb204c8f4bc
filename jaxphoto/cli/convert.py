"""`jaxphoto convert`: another program's files in, a block folder out; or what was adjusted, in files of others."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

import jaxphoto
from jaxphoto.block import Block
from jaxphoto.cli.app import app
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.console import plain_console
from jaxphoto.errors import InputError
from jaxphoto.io import FORMATS, convert, read_source, write_block
from jaxphoto.io.block_folder import check_block_target
from jaxphoto.io.exports import (
    EXPORTS,
    AdjustedPhotographs,
    Exported,
    adjusted_block,
    check_export_target,
    export,
    is_result,
    photograph_files,
)
from jaxphoto.procedures.adjust import start_of
from jaxphoto.report.terminal import plain
from jaxphoto.unknowns import Unknowns

_TARGETS = ("block", *EXPORTS)


def _about(formats: Mapping[str, Any]) -> str:
    """What each format of a registry is."""
    return "; ".join(f"{name}: {known.about}" for name, known in formats.items())


@app.command("convert")
def convert_command(
    source: Annotated[
        Path, typer.Argument(help="Results of adjust or fly; a block folder; file or folder of another program.")
    ],
    out: Annotated[Path, typer.Argument(help="Folder to write.")],
    source_format: Annotated[
        str | None,
        one_of(FORMATS, "--format", help=f"Format of SOURCE; recognised when not given. {_about(FORMATS)}."),
    ] = None,
    to: Annotated[
        str,
        one_of(_TARGETS, help=f"What OUT becomes. block: a block folder; {_about(EXPORTS)}."),
    ] = "block",
    block: Annotated[Path | None, typer.Option(help="Block of which SOURCE is the result, where it moved.")] = None,
    part: Annotated[int, typer.Option(min=1, help="Of a flight, which part; the largest is 1.")] = 1,
    photographs: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of the photographs, for the names of their files."),
    ] = None,
    adjust: Annotated[bool, typer.Option("--adjust", help="Adjust the block in SOURCE first.")] = False,
) -> None:
    """Turn another program's files into a block folder, or what was adjusted into files of others."""
    result = is_result(source) if source_format is None else False
    if adjust and (result or to == "block"):
        why = "SOURCE is a result already" if result else "a block folder has start values"
        raise InputError(f"--adjust: {why}; leave it out")
    if not result and (block is not None or part != 1):
        raise InputError(f"--block and --part are of results, and {source} is none; leave them out")
    if to == "block":
        check_block_target(out, source)
        if result:
            write_block(adjusted_block(source, block, part), out)
        else:
            convert(source, out, source_format)
    else:
        check_export_target(out, source)
        given = adjusted_block(source, block, part) if result else read_source(source, source_format)
        values, said = (given.start.unknowns, "adjusted values") if result else _values(given, adjust)
        files = photograph_files(given.images, photographs or (), source if result else None)
        _say(export(AdjustedPhotographs.of_block(given, values, files), out, to), said)
    plain_console().print(plain(f"wrote {out}"), soft_wrap=True)


def _values(block: Block, adjust: bool) -> tuple[Unknowns, str]:
    """The values of a block that is no result, and what they are."""
    if not adjust:
        said = "start values of the block: --adjust adjusts it first, or give the results of jaxphoto adjust"
        return start_of(block), said
    adjusted = jaxphoto.adjust(block)
    if not bool(adjusted.converged):
        raise InputError(f"the block cannot be exported: {adjusted.outcome.value}")
    return adjusted.unknowns, f"adjusted values, sigma naught {float(adjusted.sigma0):.3g}"


def _say(done: Exported, values: str) -> None:
    """What was written, and what was lost."""
    console = plain_console()
    console.print(values, soft_wrap=True)
    for name, conversion in done.cameras.items():
        fit = f"fitted, rms {conversion.rms_px:.3g} px, largest {conversion.max_px:.3g} px"
        console.print(plain(f"camera {name}: {'exact' if conversion.max_px == 0 else fit}"), soft_wrap=True)
    if done.moved is not None:
        told = f"rms {done.moved.rms_px:.3g} px, largest {done.moved.max_px:.3g} px"
        why = f", and were moved by {told}, to where the written cameras see their rays" if done.moved.max_px else ""
        console.print(f"image points count from the principal point{why}", soft_wrap=True)
    if done.map_misfit is not None:
        told = f"rms {done.map_misfit.rms_px:.3g} px, largest {done.map_misfit.max_px:.3g} px"
        console.print(f"a map is not Cartesian: in its coordinates image points miss by {told}", soft_wrap=True)
