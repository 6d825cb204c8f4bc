"""`jaxphoto orient`: photographs, or a block without approximate values, to an oriented block."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from jaxphoto.camera import DISTORTIONS, InteriorOrientation
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.progress import FEWER_PAIRS, StepsLeft
from jaxphoto.errors import InputError
from jaxphoto.extras.photos.features import LONGEST_PX
from jaxphoto.extras.photos.matching import MatchedPhotographs, match_photographs
from jaxphoto.extras.photos.photograph_pairs import photograph_pairs, usual_choice
from jaxphoto.io import read_block, write_block
from jaxphoto.io.block_folder import check_block_target, whole_block
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.io.json_file import read_json
from jaxphoto.io.kept_pieces import KeptPieces, beside, check_pieces
from jaxphoto.io.photographs import photographs, sensor_and_interior
from jaxphoto.procedures.adjust import needs_orientation
from jaxphoto.procedures.calibration import distortion_model
from jaxphoto.procedures.orientation import Oriented, orient, orient_block
from jaxphoto.report.orientation import print_orientation, write_orientation


@command("orient")
def orient_command(
    output: Output,
    images: Annotated[list[Path], typer.Argument(help="Photographs of one camera; or one block folder.")],
    out: Annotated[Path, typer.Option(help="Block folder to write; a block in it is replaced.")],
    pairs: Annotated[
        str | None,
        typer.Option(
            help="Photographs to compare: exhaustive, sequence:K, position:K, similar:K (default: exhaustive up to 40, "
            "else position:20 or, where not all have one, similar:20)."
        ),
    ] = None,
    features: Annotated[
        int | None,
        typer.Option(help="Of a photograph, at most (default: 10000 of up to 40 photographs, else 5000).", min=100),
    ] = None,
    longest_px: Annotated[
        int | None, typer.Option(help="Longer side, in pixels, to look for features (default: 2400).", min=200)
    ] = None,
    c_mm: Annotated[float | None, typer.Option(help="Where the principal distance starts; else from EXIF.")] = None,
    pixel_mm: Annotated[float | None, typer.Option(help="Size of a pixel; else from EXIF.")] = None,
    model: Annotated[str | None, one_of(DISTORTIONS, help="Distortion (default: brown).")] = None,
    r0_mm: Annotated[
        float | None, typer.Option(help="Balance radius R0 of smac (default: 0), where radial distortion is none.")
    ] = None,
) -> None:
    """Orient photographs to one another from their features alone, for `jaxphoto adjust` to calibrate the camera.

    Given a block folder, find the approximate orientation that its images.csv lacks. Exit code 1: written, but not
    converged or not settled.
    """
    check_block_target(out, *images)
    if len(images) == 1 and (images[0] / TOML).is_file():
        _refuse_options(
            images[0],
            pairs=pairs,
            features=features,
            longest_px=longest_px,
            c_mm=c_mm,
            pixel_mm=pixel_mm,
            model=model,
            r0_mm=r0_mm,
        )
        with output.progress.status("reading the block") as status:
            n_known, n = _orient_folder(images[0], out, lambda said: status.update(said))
        output.wrote(out, f"{n_known} of {n} images oriented; wrote {out}")
        output.tell(n_images=n, n_oriented=n_known)
        return
    check_pieces(beside(out))
    with output.progress.status("reading the photographs") as status, ExitStack() as opened:
        read = photographs(images)
        camera = sensor_and_interior(read, pixel_mm, c_mm)
        distortion = distortion_model(model or "brown", camera.sensor, r0_mm or 0.0)
        compared = photograph_pairs(read, pairs or usual_choice(read))
        output.say(camera.origin)
        start = camera.interior
        keep = opened.enter_context(KeptPieces(beside(out)).alone())
        matched = match_photographs(
            read,
            camera.sensor,
            start,
            compared,
            count=features,
            longest_px=longest_px or LONGEST_PX,
            keep=keep,
            progress=StepsLeft(output.progress, status, FEWER_PAIRS),
        )
        found = orient(
            [p.name for p in read],
            camera.sensor,
            InteriorOrientation(start.c, start.x_p, start.y_p, distortion),
            matched.xy_mm,
            matched.pairs,
            matched.sigma_mm,
            title=f"{len(read)} photographs",
            report=lambda said: status.update(said),
        )
        found = _with_reasons(found, matched)
        status.update(f"writing {out}")
        with whole_block(found.block, out) as folder:
            write_orientation(found, folder, n_gross=matched.n_gross, sigma_factor=matched.sigma_factor)
        keep.remove()
    output.say(
        f"{matched.n_gross} matches by looks left out before: off the epipolar line, or of pairs with too few; the "
        f"others scatter {matched.sigma_factor:.2g} times as much as in views of a plane"
    )
    print_orientation(found.report, output.screen)
    output.wrote(out, f"wrote {out}: adjust it with jaxphoto adjust {out} --out DIR")
    output.tell(**read_json(out / "orientation.json"))
    if not found.report.converged:
        raise typer.Exit(1)


def _refuse_options(folder: Path, **options: object) -> None:
    given = [f"--{name.replace('_', '-')}" for name, value in options.items() if value is not None]
    if given:
        raise InputError(
            f"{folder} is a block folder, whose own image points and cameras count: leave out {', '.join(given)}, or "
            "change block.toml"
        )


def _orient_folder(folder: Path, out: Path, report: Callable[[str], None]) -> tuple[int, int]:
    """How many images of the block in `folder` are oriented in that written to `out`, and how many there are."""
    block = read_block(folder)
    if not needs_orientation(block):
        raise InputError(
            f"{folder} needs no orientation: from what is known, resection reaches all its images; adjust it as it is"
        )
    with_start = orient_block(block, report)
    write_block(with_start, out)
    return int(np.sum(with_start.start.image_known)), len(block.images)


def _with_reasons(found: Oriented, matched: MatchedPhotographs) -> Oriented:
    """`found`, whose report says why photographs are not oriented that never matched another one."""
    why = {name: matched.left_out.get(name, reason) for name, reason in found.report.unoriented.items()}
    return found._replace(report=found.report._replace(unoriented=why))
