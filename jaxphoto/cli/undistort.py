"""`jaxphoto undistort`: photographs and their camera in, photographs without distortion and a pinhole camera out."""

from pathlib import Path
from typing import Annotated

import typer

from jaxphoto.cli.app import app
from jaxphoto.cli.console import plain_console
from jaxphoto.errors import InputError
from jaxphoto.io.cameras import read_camera_file
from jaxphoto.io.sound_photographs import sound_photographs
from jaxphoto.io.undistorted import write_undistorted
from jaxphoto.report.terminal import plain
from jaxphoto.writing import check_folder

_KEEP = ("crop", "all")


@app.command("undistort")
def undistort_command(
    photographs: Annotated[list[Path], typer.Argument(help="Folders of photographs, or photographs, of one camera.")],
    camera: Annotated[Path, typer.Option(help="Camera file, folder of results, block or COLMAP model.")],
    out: Annotated[Path, typer.Option(help="Folder for the photographs and their camera.toml.")],
    which: Annotated[str | None, typer.Option(help="Which camera, where the file holds several.")] = None,
    keep: Annotated[
        str, typer.Option(help="crop: what fills the new photographs; all: everything, with black corners.")
    ] = "crop",
) -> None:
    """Resample photographs to a camera without distortion. Exit code 1: written, but some were left out."""
    if keep not in _KEEP:
        raise InputError(f"--keep {keep}: there are {', '.join(_KEEP)}")
    check_folder(out, camera, *photographs)
    console, errors = plain_console(), plain_console(stderr=True)
    with errors.status("reading the photographs") as status:
        given = read_camera_file(camera, camera=which)
        read, spoilt = sound_photographs(photographs)
        done = write_undistorted(
            read,
            given,
            out,
            keep,  # type: ignore[arg-type]
            progress=lambda n, of: status.update(f"undistorting: {n} of {of}"),
        )
    left = spoilt | done.left_out
    for sentence in left.values():
        errors.print(plain(f"left out: {sentence}"), soft_wrap=True)
    sensor, interior = done.camera
    size = f"{sensor.width_px} x {sensor.height_px} pixels"
    c_px = float(interior.c) / sensor.pixel_mm
    console.print(f"{len(read) - len(done.left_out)} photographs of {size}, c = {c_px:.6g} pixels", soft_wrap=True)
    console.print(plain(f"wrote {out}"), soft_wrap=True)
    if left:
        raise typer.Exit(1)
