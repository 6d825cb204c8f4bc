"""`jaxphoto orient`: photographs, or a block without approximate values, to an oriented block."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from jaxphoto.camera import DISTORTIONS, AbstractDistortion, InteriorOrientation, constant_names
from jaxphoto.cli.app import app
from jaxphoto.errors import InputError
from jaxphoto.io import read_block, write_block
from jaxphoto.io.block_folder import check_block_target
from jaxphoto.io.block_folder.layout import TOML
from jaxphoto.io.matching import match_photographs
from jaxphoto.io.pairs import photograph_pairs
from jaxphoto.io.photographs import photographs, sensor_and_interior
from jaxphoto.orientation.approximate import has_beginning
from jaxphoto.procedures.orientation import orient, orient_block
from jaxphoto.report.orientation import print_orientation, write_orientation


@app.command("orient")
def orient_command(
    images: Annotated[list[Path], typer.Argument(help="Photographs of one camera; or one block folder.")],
    out: Annotated[Path, typer.Option(help="Block folder to write; a block in it is replaced.")],
    pairs: Annotated[
        str, typer.Option(help="Photographs to compare: exhaustive, sequence:K, position:K.")
    ] = "exhaustive",
    c_mm: Annotated[float | None, typer.Option(help="Where the principal distance starts; else from EXIF.")] = None,
    pixel_mm: Annotated[float | None, typer.Option(help="Size of a pixel; else from EXIF.")] = None,
    model: Annotated[str, typer.Option(help="Distortion: brown, smac, ...")] = "brown",
    r0_mm: Annotated[float, typer.Option(help="Of smac and pps_radial: the radius of no radial distortion.")] = 0.0,
) -> None:
    """Orient photographs to one another from their features alone, for `jaxphoto adjust` to calibrate the camera.

    Given a block folder, find the approximate orientation that its images.csv lacks.
    """
    check_block_target(out, *images)
    console, errors = Console(), Console(stderr=True)
    if len(images) == 1 and (images[0] / TOML).is_file():
        with errors.status("reading the block") as status:
            block = read_block(images[0])
            if has_beginning(block):
                raise InputError(
                    f"{images[0]} needs no orientation: images are known, or see four known points; adjust it as it is"
                )
            with_start = orient_block(block, status.update)
            write_block(with_start, out)
        known = int(np.sum(with_start.start.image_known))
        console.print(f"{known} of {len(block.images)} images oriented; wrote {out}", highlight=False, soft_wrap=True)
        return
    distortion = _distortion(model, r0_mm)
    with errors.status("reading the photographs") as status:
        read = photographs(images)
        camera = sensor_and_interior(read, pixel_mm, c_mm)
        console.print(camera.origin, highlight=False, soft_wrap=True)
        start = camera.interior
        matched = match_photographs(
            read,
            camera.sensor,
            start,
            photograph_pairs(read, pairs),
            progress=lambda done, of: status.update(f"features and matches: {done} of {of}"),
        )
        found = orient(
            [p.name for p in read],
            camera.sensor,
            InteriorOrientation(start.c, start.x_p, start.y_p, distortion),
            matched.xy_mm,
            matched.pairs,
            matched.sigma_mm,
            title=f"{len(read)} photographs",
            report=status.update,
        )
        status.update(f"writing {out}")
        write_block(found.block, out)
        write_orientation(found, out)
    console.print(
        f"{matched.n_gross} matches by looks left out before: off the epipolar line, or of pairs with too few",
        highlight=False,
        soft_wrap=True,
    )
    print_orientation(found.report, console)
    console.print(f"wrote {out}: adjust it with jaxphoto adjust {out} --out DIR", highlight=False, soft_wrap=True)


def _distortion(model: str, r0_mm: float) -> AbstractDistortion:
    if model not in DISTORTIONS:
        raise InputError(f"--model {model}: there are {', '.join(DISTORTIONS)}")
    constants = constant_names(DISTORTIONS[model])
    if set(constants) - {"r0_mm"}:
        raise InputError(
            f"--model {model} has constants of its own ({', '.join(constants)}); orient with brown, then change "
            "block.toml"
        )
    return DISTORTIONS[model](**dict.fromkeys(constants.values(), r0_mm))
