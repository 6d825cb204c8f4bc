"""`jaxphoto camera`: a camera file in, one of another program out."""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.camera import AbstractDistortion, get_parameter, parameter_names
from jaxphoto.cli.choices import Second, one_of, place
from jaxphoto.cli.output import Output, command
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import CAMERA_MODELS, CAMERAS_WRITTEN, LOSS_PX, write_camera_file
from jaxphoto.io.camera_files import CAMERAS_READ, read_camera_file
from jaxphoto.writing import check_file


@command("camera")
def camera_command(
    output: Output,
    source: Annotated[
        Path, typer.Argument(help=f"Folder of results, block or COLMAP model; or a file: {CAMERAS_READ}.")
    ],
    second: Second = None,
    out: Annotated[Path | None, typer.Option(help="Camera file to write (needed).")] = None,
    out_format: Annotated[
        str | None,
        one_of(CAMERAS_WRITTEN, "--format", help="Of --out; told by its name when not given."),
    ] = None,
    camera: Annotated[str | None, typer.Option(help="Which camera, where SOURCE holds several.")] = None,
    pixel_mm: Annotated[float | None, typer.Option(help="Size of a pixel, where SOURCE does not give it.")] = None,
    width_px: Annotated[int | None, typer.Option(min=1, help="Width, where SOURCE does not give it.")] = None,
    height_px: Annotated[int | None, typer.Option(min=1, help="Height, where SOURCE does not give it.")] = None,
    block: Annotated[Path | None, typer.Option(help="Block of which SOURCE is the result.")] = None,
    distortion: Annotated[
        str | None, one_of(AbstractDistortion.known(), help="Model in a .toml; that of SOURCE when not given.")
    ] = None,
    model: Annotated[
        str | None,
        one_of(CAMERA_MODELS, help="Largest model of the format to use; any that the camera needs when not given."),
    ] = None,
    loss_px: Annotated[float, typer.Option(min=0, help="Most that a fit may miss, at its worst point.")] = LOSS_PX,
) -> None:
    """Convert a camera file: exactly where the models allow it, otherwise fitted, the residual stated in pixels."""
    out = place(out, second)
    check_file(out, source)
    if (width_px is None) != (height_px is None):
        raise InputError("--width-px and --height-px belong together; give both or none")
    size = None if width_px is None or height_px is None else (width_px, height_px)
    read = read_camera_file(source, camera=camera, pixel_mm=pixel_mm, size_px=size, block=block)
    kind = AbstractDistortion.known()[distortion] if distortion is not None else None
    with output.progress.status("converting"):
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
    models = [type(interior.distortion).__name__ for interior in (read.interior, done.interior)]
    output.say(f"{read.name}: {models[0]} -> {models[1]}")
    if read.note:
        output.say(f"note: {read.note}")
    for name in parameter_names(done.interior):
        value = float(get_parameter(done.interior, name))
        if value != 0 or name == "c_mm":
            output.say(f"  {name} = {value:.9g}")
    output.say(done.lost)
    if done.covered < 1:
        output.say(f"the given distortion folds in {1 - done.covered:.1%} of the format, which was left out")
    output.wrote(out, f"wrote {out}")
    parameters = {name: get_parameter(done.interior, name) for name in parameter_names(done.interior)}
    output.tell(
        camera=read.name, models=models, lost=done.lost, rms_px=done.rms_px, max_px=done.max_px, covered=done.covered
    )
    output.tell(parameters=parameters, note=read.note)
