"""`jaxphoto camera`: a camera file in, one of another program out."""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.camera import AbstractDistortion, get_parameter, parameter_names
from jaxphoto.cli.app import app
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.console import plain_console
from jaxphoto.errors import InputError
from jaxphoto.io.cameras import CAMERA_FORMATS, CAMERA_MODELS, LOSS_PX, read_camera_file, write_camera_file
from jaxphoto.writing import check_file


@app.command("camera")
def camera_command(
    source: Annotated[Path, typer.Argument(help="Camera file, folder of results, block or COLMAP model.")],
    out: Annotated[Path, typer.Argument(help="Camera file to write.")],
    out_format: Annotated[
        str | None,
        one_of(CAMERA_FORMATS, "--format", help="Of OUT; told by its name when not given."),
    ] = None,
    camera: Annotated[str | None, typer.Option(help="Which camera, where IN holds several.")] = None,
    pixel_mm: Annotated[float | None, typer.Option(help="Size of a pixel, where IN does not give it.")] = None,
    width_px: Annotated[int | None, typer.Option(min=1, help="Width, where IN does not give it.")] = None,
    height_px: Annotated[int | None, typer.Option(min=1, help="Height, where IN does not give it.")] = None,
    block: Annotated[Path | None, typer.Option(help="Block of which IN is the result.")] = None,
    distortion: Annotated[
        str | None, one_of(AbstractDistortion.known(), help="Model in a block.toml; that of IN when not given.")
    ] = None,
    model: Annotated[
        str | None,
        one_of(CAMERA_MODELS, help="Largest model of OUT's format to use; when not given, any that it needs."),
    ] = None,
    loss_px: Annotated[float, typer.Option(min=0, help="Most that a fit may miss, at its worst point.")] = LOSS_PX,
) -> None:
    """Convert a camera file: exactly where the models allow it, otherwise fitted, the residual stated in pixels."""
    check_file(out, source)
    if (width_px is None) != (height_px is None):
        raise InputError("--width-px and --height-px belong together; give both or none")
    size = None if width_px is None or height_px is None else (width_px, height_px)
    read = read_camera_file(source, camera=camera, pixel_mm=pixel_mm, size_px=size, block=block)
    kind = AbstractDistortion.known()[distortion] if distortion is not None else None
    done = write_camera_file(
        out,
        read.sensor,
        read.interior,
        out_format,
        name=read.name,
        distortion=kind,
        covariance=read.covariance,
        reservation=read.note,
        model=model,
        loss_px=loss_px,
    )
    console = plain_console()
    console.print(
        f"{read.name}: {type(read.interior.distortion).__name__} -> {type(done.interior.distortion).__name__}",
        soft_wrap=True,
    )
    if read.note:
        console.print(f"note: {read.note}", soft_wrap=True)
    for name in parameter_names(done.interior):
        value = float(get_parameter(done.interior, name))
        if value != 0 or name == "c_mm":
            console.print(f"  {name} = {value:.9g}", soft_wrap=True)
    console.print(done.lost, soft_wrap=True)
    if done.covered < 1:
        console.print(
            f"the given distortion folds in {1 - done.covered:.1%} of the format, which was left out", soft_wrap=True
        )
    console.print(f"wrote {out}", soft_wrap=True)
