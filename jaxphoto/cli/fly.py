"""`jaxphoto fly`: a folder of photographs to a georeferenced block, its adjustment and one page about both."""

from pathlib import Path
from threading import Thread
from typing import Annotated

import numpy as np
import typer

from jaxphoto.camera import DISTORTIONS, InteriorOrientation
from jaxphoto.cli.app import app
from jaxphoto.cli.console import plain_console
from jaxphoto.cli.provenance import Provenance
from jaxphoto.georeferencing.map_frame import map_system
from jaxphoto.image_measurement.features import FEATURES, LONGEST_PX
from jaxphoto.image_measurement.matching import MatchedPhotographs, match_photographs
from jaxphoto.image_measurement.photograph_pairs import photograph_pairs
from jaxphoto.io.block_folder import whole_block
from jaxphoto.io.photographs import Photograph, sensor_and_interior
from jaxphoto.io.sound_photographs import sound_photographs
from jaxphoto.procedures.calibration import distortion_model
from jaxphoto.procedures.flight import MatchedPart, calibrate_flight
from jaxphoto.report import Level, prepare_pictures
from jaxphoto.report.flight import block_folder, report_of, write_flight, write_part_orientation
from jaxphoto.report.terminal import plain
from jaxphoto.writing import check_folder, whole_folder

# So many nearest of each are compared where all have positions: as far as photographs of four fifths overlap still show
# the same, in all directions.
_NEAREST = 20


@app.command("fly")
def fly_command(
    photographs: Annotated[list[Path], typer.Argument(help="Folders of photographs, or photographs, of one camera.")],
    out: Annotated[Path, typer.Option(help="Folder for blocks and results; earlier results in it are replaced.")],
    pairs: Annotated[
        str | None,
        typer.Option(
            help="Photographs to compare: exhaustive, sequence:K, position:K (default: position:20 where all have one)."
        ),
    ] = None,
    epsg: Annotated[int | None, typer.Option(help="Map system of the block (default: the zone of UTM).")] = None,
    features: Annotated[int, typer.Option(help="Of a photograph, at most.", min=100)] = FEATURES,
    longest_px: Annotated[
        int, typer.Option(help="Longer side, in pixels, to look for features.", min=200)
    ] = LONGEST_PX,
    c_mm: Annotated[float | None, typer.Option(help="Where the principal distance starts; else from EXIF.")] = None,
    pixel_mm: Annotated[float | None, typer.Option(help="Size of a pixel; else from EXIF.")] = None,
    model: Annotated[str, typer.Option(help=f"Distortion: {', '.join(DISTORTIONS)}.")] = "brown",
) -> None:
    """Calibrate the camera of a flight from its photographs and their positions: orient, georeference, adjust, judge.

    What cannot be used is left out and named. Exit code 1: written, but the verdict is red.
    """
    check_folder(out, *photographs)
    if epsg is not None:
        map_system(epsg)
    Thread(target=prepare_pictures, daemon=True).start()
    console, errors = plain_console(), plain_console(stderr=True)
    with errors.status("reading the photographs") as status:
        read, spoilt = sound_photographs(photographs)
        for sentence in spoilt.values():
            errors.print(f"left out: {plain(sentence)}", soft_wrap=True)
        camera = sensor_and_interior(read, pixel_mm, c_mm)
        distortion = distortion_model(model, camera.sensor)
        compared = photograph_pairs(read, pairs or _usual_pairs(read))
        console.print(camera.origin, soft_wrap=True)
        console.print(f"{len(read)} photographs, {len(compared)} pairs to compare", soft_wrap=True)
        matched = match_photographs(
            read,
            camera.sensor,
            camera.interior,
            compared,
            count=features,
            longest_px=longest_px,
            in_parts=True,
            progress=lambda done, of: status.update(f"features and matches: {done} of {of}"),
        )
        names, start = [p.name for p in read], camera.interior
        flight = calibrate_flight(
            [_part(names, group, matched.of(group)) for group in matched.parts],
            camera.sensor,
            InteriorOrientation(start.c, start.x_p, start.y_p, distortion),
            {p.name: p.gps for p in read},
            epsg,
            status.update,
        )
        flight = flight._replace(left_out=matched.left_out | flight.left_out)
        status.update("computing statistics")
        reports = [report_of(part) for part in flight.parts]
        options = {"features": features, "longest_px": longest_px, "model": model, "pairs": pairs or _usual_pairs(read)}
        signed = Provenance.of([p.path for p in read], options | {"epsg": epsg, "c_mm": c_mm, "pixel_mm": pixel_mm})
        status.update(f"writing {out}")
        with whole_folder(out) as work:
            verdict = write_flight(flight, reports, spoilt, work, signed.told, signed.write)
            for number, part in enumerate(flight.parts, 1):
                with whole_block(part.adjusted.block, work / block_folder(number)) as folder:
                    write_part_orientation(part, folder)
                    signed.write(part, folder)
            why_not = signed.certify(work)
    for number, part in enumerate(flight.parts, 1):
        report = part.oriented.report
        sizes = f"{len(report.order)} photographs, {report.n_image_points} image points, {report.mean_px:.2f} px"
        console.print(f"part {number}: {sizes}", soft_wrap=True)
        for sentence in part.placed.sentences if part.placed else (part.why_not,):
            console.print(f"  {plain(sentence)}", soft_wrap=True)
    for name, why in flight.left_out.items():
        console.print(plain(f"{name} is not used: {why}"), soft_wrap=True)
    console.print(plain(verdict.headline), soft_wrap=True)
    for finding in verdict.findings:
        if finding.level > Level.INFORMATION:
            console.print(plain(f"  {finding.text}"), soft_wrap=True)
    if why_not:
        console.print(plain(f"no certificate: {why_not}"), soft_wrap=True)
    console.print(f"results in {plain(str(out))} (open report.html)", soft_wrap=True)
    if verdict.level == Level.ALARM:
        raise typer.Exit(1)


def _part(names: list[str], group: np.ndarray, own: MatchedPhotographs) -> MatchedPart:
    return MatchedPart([names[k] for k in group], own.xy_mm, own.sigma_mm, own.pairs, own.n_gross, own.sigma_factor)


def _usual_pairs(photographs: list[Photograph]) -> str:
    placed = all(p.gps is not None for p in photographs)
    return f"position:{_NEAREST}" if placed and len(photographs) > 2 * _NEAREST else "exhaustive"
