"""`jaxphoto undistort`: photographs and their camera in, photographs without distortion and a pinhole camera out."""

from pathlib import Path
from typing import Annotated, get_args

import typer

from jaxphoto.camera.undistortion import Keep
from jaxphoto.cli.app import app
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.console import plain_console
from jaxphoto.io.cameras import read_camera_file
from jaxphoto.io.sound_photographs import folders_not_looked_into, sound_photographs
from jaxphoto.io.undistorted import write_undistorted
from jaxphoto.report.terminal import plain
from jaxphoto.writing import check_folder


@app.command("undistort")
def undistort_command(
    photographs: Annotated[list[Path], typer.Argument(help="Folders of photographs, or photographs, of one camera.")],
    camera: Annotated[Path, typer.Option(help="Camera file, folder of results, block or COLMAP model.")],
    out: Annotated[Path, typer.Option(help="Folder for the photographs and their camera.toml.")],
    which: Annotated[str | None, typer.Option(help="Which camera, where the file holds several.")] = None,
    keep: Annotated[
        Keep, one_of(get_args(Keep), help="crop: what fills the new photographs; all: everything, with black corners.")
    ] = "crop",
) -> None:
    """Resample photographs to a camera without distortion. Exit code 1: written, but some were left out."""
    check_folder(out, camera, *photographs)
    console, errors = plain_console(), plain_console(stderr=True)
    with errors.status("reading the photographs") as status:
        given = read_camera_file(camera, camera=which)
        read, spoilt = sound_photographs(photographs)
        done = write_undistorted(
            read,
            given,
            out,
            keep,
            progress=lambda n, of: status.update(f"undistorting: {n} of {of}"),
        )
    left = spoilt | done.left_out
    for sentence in (left | folders_not_looked_into(photographs)).values():
        errors.print(plain(f"left out: {sentence}"), soft_wrap=True)
    sensor, interior = done.camera
    size = f"{sensor.width_px} x {sensor.height_px} pixels"
    c_px = float(interior.c) / sensor.pixel_mm
    console.print(f"{len(read) - len(done.left_out)} photographs of {size}, c = {c_px:.6g} pixels", soft_wrap=True)
    console.print(plain(f"wrote {out}"), soft_wrap=True)
    if left:
        raise typer.Exit(1)
