"""`jaxphoto convert`: another program's files in, a block folder out; or what was adjusted, in files of others."""

from pathlib import Path
from typing import Annotated

import typer

import jaxphoto
from jaxphoto.block import Block
from jaxphoto.cli.choices import Second, one_of, place
from jaxphoto.cli.output import Output, command
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import EXPORTS, FORMATS, Exported, Project, check_export_target, export, read_source
from jaxphoto.io import write_block
from jaxphoto.io.block_folder import check_block_target
from jaxphoto.io.camera_files import ASSUMED_PIXEL_MM
from jaxphoto.io.result_folder import adjusted_block, is_result, photograph_files
from jaxphoto.procedures.adjust import start_of
from jaxphoto.unknowns import Unknowns

_OF_FILES = {ending for known in EXPORTS.values() for ending in known.endings}
_TARGETS = {"block": "a block folder"} | {name: known.about for name, known in EXPORTS.items()}


@command("convert")
def convert_command(
    output: Output,
    source: Annotated[
        Path, typer.Argument(help="Results of adjust or fly; a block folder; file or folder of another program.")
    ],
    second: Second = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write (needed).")] = None,
    source_format: Annotated[
        str | None,
        one_of(
            FORMATS,
            "--format",
            help="Format of SOURCE; recognised when not given.",
            about={name: known.about for name, known in FORMATS.items()},
        ),
    ] = None,
    to: Annotated[
        str,
        one_of(_TARGETS, help="What --out becomes.", about=_TARGETS),
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
    out = place(out, second)
    result = is_result(source) if source_format is None else False
    if adjust and (result or to == "block"):
        why = "SOURCE is a result already" if result else "a block folder has start values"
        raise InputError(f"--adjust: {why}; leave it out")
    if not result and (block is not None or part != 1):
        raise InputError(f"--block and --part are of results, and {source} is none; leave them out")
    if out.suffix.lower() in _OF_FILES:
        raise InputError(
            f"--out {out}: {to} is a folder of files, and this is the name of a file; leave {out.suffix} out"
        )
    check = check_block_target if to == "block" else check_export_target
    check(out, source)
    with output.progress.status(f"reading {source}") as status:
        given = adjusted_block(source, block, part) if result else read_source(source, source_format)
        size = {
            "n_images": len(given.images),
            "n_points": len(given.points),
            "n_image_points": len(given.image_points.image),
        }
        if to == "block":
            status.update(f"writing {out}")
            write_block(given, out)
        else:
            if adjust:
                status.update("adjusting")
            values, said = (given.start.unknowns, "adjusted values") if result else _values(given, adjust)
            files = photograph_files(given.images, photographs or (), source if result else None)
            status.update(f"writing {out}")
            done = export(Project.of_block(given, values, files), out, to)
            _say(output, done, said, "cameras" not in EXPORTS[to].lacks)
    assumed = [name for name, sensor in given.sensors.items() if sensor.pixel_assumed]
    if to == "block" and not result and assumed:
        whose = f"camera {assumed[0]}" if len(assumed) == 1 else f"{len(assumed)} cameras"
        why = "as is assumed where files know pixels alone: c in um is f in px"
        output.say(f"{whose}: a pixel is {ASSUMED_PIXEL_MM:g} mm, {why}")
    images, *further = size.values()
    lacks = EXPORTS[to].lacks if to in EXPORTS else ()
    held = [f"{n} {what}" for n, what in zip(further, ("points", "image points"), strict=True) if what not in lacks]
    output.wrote(out, f"wrote {out}: {', '.join([f'{images} images', *held])}")
    output.tell(**size)


def _values(block: Block, adjust: bool) -> tuple[Unknowns, str]:
    """The values of a block that is no result, and what they are."""
    if not adjust:
        said = "start values of the block: --adjust adjusts it first, or give the results of jaxphoto adjust"
        return start_of(block), said
    adjusted = jaxphoto.adjust(block)
    if not bool(adjusted.converged):
        raise InputError(f"the block cannot be exported: {adjusted.outcome.value}")
    return adjusted.unknowns, f"adjusted values, sigma naught {float(adjusted.sigma0):.3g}"


def _say(output: Output, done: Exported, values: str, of_cameras: bool) -> None:
    """What was written, and what was lost: of cameras where the format has them."""
    output.say(values)
    lost = {name: {"rms_px": c.rms_px, "max_px": c.max_px} for name, c in done.cameras.items()}
    misfits = {"map_misfit": done.map_misfit, "moved": done.moved}
    output.tell(values=values, cameras=lost, **{name: m and m._asdict() for name, m in misfits.items()})
    for name, conversion in done.cameras.items() if of_cameras else ():
        output.say(f"camera {name}: {conversion.lost}")
    if done.moved is not None:
        told = f"rms {done.moved.rms_px:.3g} px, largest {done.moved.max_px:.3g} px"
        why = f", and were moved by {told}, to where the written cameras see their rays" if done.moved.max_px else ""
        output.say(f"image points count from the principal point{why}")
    if done.map_misfit is not None:
        told = f"rms {done.map_misfit.rms_px:.3g} px, largest {done.map_misfit.max_px:.3g} px"
        output.say(f"a map is not Cartesian: in its coordinates image points miss by {told}")
