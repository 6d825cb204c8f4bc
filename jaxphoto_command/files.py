"""Commands that convert files."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer import Argument, Option

from jaxphoto_command import options as opt
from jaxphoto_command.application import command
from jaxphoto_command.output import Output

PANEL = "Files and formats"
_ADJUSTED = "jaxphoto example cross_block && jaxphoto adjust cross_block --out results && "
Source = Annotated[Path, Argument(help="Results, block folder, or file or folder of another program.")]
Second = Annotated[Path | None, Argument(hidden=True, metavar="OUT")]


def _target(out: Path | None, second: Path | None) -> Path:
    """Return --out, or the second argument."""
    if (out is None) == (second is None):
        raise typer.BadParameter(
            "Missing option: --out" if out is None else f"--out {out} and {second}: give one only."
        )
    return out or second  # type: ignore[return-value]


@command("convert", PANEL, f"{_ADJUSTED}jaxphoto convert results --to colmap --out sparse")
def convert(
    output: Output,
    source: Source,
    second: Second = None,
    out: Annotated[Path | None, Option(help="Folder to write (required).")] = None,
    source_format: Annotated[
        str | None,
        Option("--format", metavar="FORMAT", help="Format of SOURCE (docs/formats.md; default: by its content)."),
    ] = None,
    to: Annotated[str, Option(metavar="FORMAT", help="Format of --out (docs/formats.md).")] = "block",
    block: Annotated[Path | None, Option(help="Block folder of the results in SOURCE, if moved.")] = None,
    part: Annotated[int, Option(min=1, help="Number of the part of a flight; 1 is the largest.")] = 1,
    photographs: Annotated[list[Path] | None, Option(help="Folder of the photographs, for their file names.")] = None,
    adjust: Annotated[bool, Option("--adjust", help="Adjust the block in SOURCE first.")] = False,
) -> None:
    """Convert files of other programs to a block folder, or a block or results to files of other programs."""
    from jaxphoto.extras.formats import EXPORTS, Project, export, read_source
    from jaxphoto.io import write_block
    from jaxphoto.io.camera_files import ASSUMED_PIXEL_MM
    from jaxphoto.io.result_folder import adjusted_block, is_result, photograph_files
    from jaxphoto.writing import check_folder

    out = _target(out, second)
    result = source_format is None and is_result(source)
    if adjust and (result or to == "block"):
        raise typer.BadParameter("--adjust applies to a block that is exported, not to results or --to block.")
    if not result and (block is not None or part != 1):
        raise typer.BadParameter(f"--block and --part apply to results only; {source} is not a result folder.")
    if out.suffix.lower() in {suffix for known in EXPORTS.values() for suffix in known.endings}:
        raise typer.BadParameter(f"--out {out}: {to} is a folder of files; omit {out.suffix}.")
    check_folder(out, source)
    if to != "block" and to not in EXPORTS:
        raise typer.BadParameter(f"--to {to}: unknown format; choose one of block, {', '.join(EXPORTS)}.")
    lacks: Any = EXPORTS[to].lacks if to in EXPORTS else ()
    with output.progress(f"reading {source}") as progress:
        read = adjusted_block(source, block, part) if result else read_source(source, source_format)
        size = {
            "n_images": len(read.images),
            "n_points": len(read.points),
            "n_image_points": len(read.image_points.image),
        }
        if to == "block":
            progress.update(f"writing {out}")
            write_block(read, out)
        else:
            progress.update("adjusting" if adjust else f"writing {out}")
            values, text = (read.start.unknowns, "adjusted values") if result else _values(read, adjust)
            files = photograph_files(read.images, photographs or (), source if result else None)
            written = export(Project.of_block(read, values, files), out, to)
            _report_export(output, written, text, "cameras" not in lacks)
    assumed = [name for name, sensor in read.sensors.items() if sensor.pixel_assumed]
    if to == "block" and not result and assumed:
        cameras = f"camera {assumed[0]}" if len(assumed) == 1 else f"{len(assumed)} cameras"
        output.say(
            f"{cameras}: pixel size {ASSUMED_PIXEL_MM:g} mm assumed (the files have pixels only): c in um is f in px"
        )
    counts = {"images": len(read.images), "points": len(read.points), "image points": len(read.image_points.image)}
    parts = ", ".join(f"{n} {name}" for name, n in counts.items() if name not in lacks)
    output.wrote(out, f"wrote {out}: {parts}")
    output.add(**size)


def _values(block: Any, adjust: bool) -> tuple[Any, str]:
    """Return initial or adjusted values of a block, and their description."""
    import jaxphoto
    from jaxphoto.errors import InputError
    from jaxphoto.procedures.adjust import start_of

    if not adjust:
        return start_of(block), "initial values of the block (to adjust it first: --adjust)"
    adjusted = jaxphoto.adjust(block)
    if not bool(adjusted.converged):
        raise InputError(f"the block cannot be exported: {adjusted.outcome.value}")
    return adjusted.unknowns, f"adjusted values, sigma naught {float(adjusted.sigma0):.3g}"


def _report_export(output: Output, written: Any, values: str, cameras: bool) -> None:
    """Report the written values and the loss of accuracy."""
    output.say(values)
    losses = {name: {"rms_px": c.rms_px, "max_px": c.max_px} for name, c in written.cameras.items()}
    output.add(values=values, cameras=losses, moved_px=written.moved_px)
    for name, conversion in written.cameras.items() if cameras else ():
        output.say(f"camera {name}: {conversion.lost}")
    if written.moved_px is not None:
        rms, largest = written.moved_px
        moved = f"; moved by rms {rms:.3g} px, maximum {largest:.3g} px to fit the written cameras" if largest else ""
        output.say(f"image points are relative to the principal point{moved}")


@command("camera", PANEL, f"{_ADJUSTED}jaxphoto camera results --out cameras.txt")
def camera(
    output: Output,
    source: Annotated[
        Path,
        Argument(
            help="Results, block folder or COLMAP model; or a file: OpenCV's and ROS' YAML, COLMAP's cameras.txt, "
            "Agisoft's XML, mrcal's .cameramodel, a SMAC report, interior.csv, block.toml."
        ),
    ],
    second: Second = None,
    out: Annotated[Path | None, Option(help="Camera file to write (required).")] = None,
    out_format: Annotated[
        Literal["opencv", "colmap", "agisoft", "block"] | None,
        Option("--format", help="Format of --out (default: by its name)."),
    ] = None,
    camera: opt.Camera = None,
    pixel_mm: opt.PixelSize = None,
    width_px: Annotated[int | None, Option(min=1, help="Image width, if SOURCE lacks it.")] = None,
    height_px: Annotated[int | None, Option(min=1, help="Image height, if SOURCE lacks it.")] = None,
    block: Annotated[Path | None, Option(help="Block folder of the results in SOURCE.")] = None,
    distortion: Annotated[str | None, Option(help="Distortion model of a .toml file (default: as in SOURCE).")] = None,
    loss_px: Annotated[float, Option(min=0, help="Maximum misfit of a fitted model.")] = 1.0,
) -> None:
    """Convert a camera file: exactly if possible, otherwise by a fitted model with its misfit in pixels."""
    from jaxphoto.camera import AbstractDistortion, get_parameter, parameter_names
    from jaxphoto.extras.formats import write_camera_file
    from jaxphoto.io.camera_files import read_camera_file
    from jaxphoto.writing import check_file

    out = _target(out, second)
    check_file(out, source)
    if (width_px is None) != (height_px is None):
        raise typer.BadParameter("Give both --width-px and --height-px, or neither.")
    size = None if width_px is None or height_px is None else (width_px, height_px)
    read = read_camera_file(source, camera=camera, pixel_mm=pixel_mm, size_px=size, block=block)
    with output.progress("converting"):
        written = write_camera_file(
            out,
            read.sensor,
            read.interior,
            out_format,
            name=read.name,
            distortion=None if distortion is None else AbstractDistortion.called(distortion),
            covariance=read.covariance,
            reservation=read.note,
            loss_px=loss_px,
        )
    models = [type(interior.distortion).__name__ for interior in (read.interior, written.interior)]
    output.say(f"{read.name}: {models[0]} -> {models[1]}")
    if read.note:
        output.say(f"note: {read.note}")
    parameters = {name: float(get_parameter(written.interior, name)) for name in parameter_names(written.interior)}
    output.say(*(f"  {name} = {value:.9g}" for name, value in parameters.items() if value or name == "c_mm"))
    output.say(written.lost)
    if written.covered < 1:
        output.say(
            f"the distortion is not invertible in {1 - written.covered:.1%} of the image format, which was omitted"
        )
    output.wrote(out, f"wrote {out}")
    output.add(
        camera=read.name,
        models=models,
        lost=written.lost,
        rms_px=written.rms_px,
        max_px=written.max_px,
        covered=written.covered,
        parameters=parameters,
        note=read.note,
    )
