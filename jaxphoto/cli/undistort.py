"""`jaxphoto undistort`: photographs and their camera in, photographs without distortion and a pinhole camera out."""

from functools import partial
from pathlib import Path
from typing import Annotated, get_args

import typer

from jaxphoto.camera.undistortion import Keep
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.progress import StepsLeft
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.io.sound_photographs import folders_not_looked_into, in_short, sound_photographs
from jaxphoto.io.undistorted import write_undistorted
from jaxphoto.writing import check_folder


@command("undistort")
def undistort_command(
    output: Output,
    photographs: Annotated[list[Path], typer.Argument(help="Folders of photographs, or photographs, of one camera.")],
    camera: Annotated[Path, typer.Option(help="Results, block, COLMAP model, or a file as jaxphoto camera reads it.")],
    out: Annotated[Path, typer.Option(help="Folder for the photographs and their camera.toml.")],
    which: Annotated[str | None, typer.Option(help="Which camera, where the file holds several.")] = None,
    keep: Annotated[
        Keep, one_of(get_args(Keep), help="crop: what fills the new photographs; all: everything, with black corners.")
    ] = "crop",
) -> None:
    """Resample photographs to a camera without distortion. Exit code 1: written, but some were left out."""
    check_folder(out, camera, *photographs)
    with output.progress.status("reading the photographs") as status:
        given = read_camera_file(camera, camera=which)
        read, spoilt = sound_photographs(photographs)
        done = write_undistorted(
            read,
            given,
            out,
            keep,
            progress=partial(StepsLeft(output.progress, status), "undistorting"),
        )
    left = spoilt | done.left_out
    for sentence in (*in_short(left), *folders_not_looked_into(photographs).values()):
        output.warn(f"left out: {sentence}")
    sensor, interior = done.camera
    size = f"{sensor.width_px} x {sensor.height_px} pixels"
    c_px = float(interior.c) / sensor.pixel_mm
    n = len(read) - len(done.left_out)
    output.say(f"{n} photographs of {size}, c = {c_px:.6g} pixels")
    output.wrote(out, f"wrote {out}")
    output.tell(n_photographs=n, width_px=sensor.width_px, height_px=sensor.height_px, c_px=c_px, left_out=list(left))
    if left:
        raise typer.Exit(1)
