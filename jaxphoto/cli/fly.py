"""`jaxphoto fly`: a folder of photographs to a georeferenced block, its adjustment and one page about both."""

import datetime
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import Annotated

import typer

from jaxphoto.camera import DISTORTIONS, InteriorOrientation
from jaxphoto.cli.choices import one_of
from jaxphoto.cli.exposure_options import heights_of, lever_arm_of, map_codes
from jaxphoto.cli.made import typed
from jaxphoto.cli.output import Output, command
from jaxphoto.cli.progress import FEWER_PAIRS, StepsLeft
from jaxphoto.cli.provenance import Provenance
from jaxphoto.errors import InputError, counted
from jaxphoto.extras.photos.control_targets import target_looker
from jaxphoto.extras.photos.features import LONGEST_PX
from jaxphoto.extras.photos.matching import match_photographs
from jaxphoto.extras.photos.photograph_pairs import MostSimilar, photograph_pairs, usual_choice, usual_count
from jaxphoto.extras.photos.targets.on_ground import SYNTAX, read_target
from jaxphoto.georeferencing.geoid_heights import WGS84
from jaxphoto.georeferencing.map_frame import check_heights
from jaxphoto.io.block_folder import whole_block
from jaxphoto.io.control_files import FORMS, read_control
from jaxphoto.io.exports import write_photograph_files
from jaxphoto.io.exposures import exposure_files, located
from jaxphoto.io.kept_pieces import KeptPieces, beside, check_pieces
from jaxphoto.io.photographs import known_lens, sensor_and_interior
from jaxphoto.io.sound_photographs import folders_not_looked_into, in_short, sound_photographs
from jaxphoto.procedures.calibration import distortion_model
from jaxphoto.procedures.control.of_flight import flight_control
from jaxphoto.procedures.flight import KnownOfFlight, calibrate_flight
from jaxphoto.report import Level, prepare_pictures
from jaxphoto.report.flight import (
    FlightSource,
    block_folder,
    camera_sentences,
    report_of,
    write_flight,
    write_part_orientation,
)
from jaxphoto.report.terminal import plain
from jaxphoto.writing import check_folder, whole_folder


@command("fly")
def fly_command(
    output: Output,
    context: typer.Context,
    photographs: Annotated[list[Path], typer.Argument(help="Folders of photographs, or photographs, of one camera.")],
    out: Annotated[Path, typer.Option(help="Folder for blocks and results; earlier results in it are replaced.")],
    pairs: Annotated[
        str | None,
        typer.Option(
            help="Photographs to compare: exhaustive, sequence:K, position:K, similar:K (default: position:20 or, "
            "where not all have one, similar:20; exhaustive up to 40)."
        ),
    ] = None,
    epsg: Annotated[
        str | None,
        typer.Option(help="Map system of the block, such as 25832 or 25832+7837 (default: the zone of UTM)."),
    ] = None,
    features: Annotated[
        int | None,
        typer.Option(help="Of a photograph, at most (default: 10000 of up to 40 photographs, else 5000).", min=100),
    ] = None,
    longest_px: Annotated[
        int, typer.Option(help="Longer side, in pixels, to look for features.", min=200)
    ] = LONGEST_PX,
    c_mm: Annotated[float | None, typer.Option(help="Where the principal distance starts; else from EXIF.")] = None,
    pixel_mm: Annotated[float | None, typer.Option(help="Size of a pixel; else from EXIF.")] = None,
    model: Annotated[str, one_of(DISTORTIONS, help="Distortion.")] = "brown",
    no_lens_prior: Annotated[
        bool,
        typer.Option("--no-lens-prior", help="Do not observe what is known of such lenses (docs/lens_priors.md)."),
    ] = False,
    rolling_shutter: Annotated[
        bool,
        typer.Option(
            "--rolling-shutter",
            help="Estimate the readout time of the rows, by positions and times of EXIF.",
        ),
    ] = False,
    exposures: Annotated[
        list[Path] | None,
        typer.Option(help="Files of exposures elsewhere than in the folders: .MRK, .pos, SBET, a table."),
    ] = None,
    lever_arm: Annotated[
        str | None, typer.Option(help="From camera to antenna, in metres: right,forward,up of the aircraft.")
    ] = None,
    heights: Annotated[
        str | None,
        typer.Option(
            help="Heights are above the ellipsoid, geoid or take-off, where files do not say it; an EPSG code of "
            "heights (5773: EGM96) has its geoid added."
        ),
    ] = None,
    control: Annotated[Path | None, typer.Option(help=f"Surveyed points: {', '.join(FORMS)}.")] = None,
    marks: Annotated[Path | None, typer.Option(help="Marks of the points, where --control has none.")] = None,
    control_epsg: Annotated[
        str | None,
        typer.Option(help="System of the points where no file says it: 25832, 25832+7837, local."),
    ] = None,
    targets: Annotated[
        str | None, typer.Option(help=f"Targets to find at the points: {', '.join(SYNTAX.values())}.")
    ] = None,
) -> None:
    """Calibrate the camera of a flight from its photographs and their positions: orient, georeference, adjust, judge.

    What cannot be used is left out and named. Exit code 1: written, but the verdict is red.
    """
    check_folder(out, *photographs, *filter(None, (control, marks)), *(exposures or ()))
    if control is None and (marks or control_epsg or targets):
        raise InputError("something is told of control, but no points are given; add --control FILE")
    surveyed, target = read_control(control, marks) if control else None, read_target(targets) if targets else None
    check_pieces(beside(out))
    code, vertical = map_codes(epsg)
    above, arm = heights_of(heights), lever_arm_of(lever_arm)
    if isinstance(above, int):
        check_heights(WGS84, above)
    Thread(target=prepare_pictures, daemon=True).start()
    with output.progress.status("reading the photographs") as status, ExitStack() as opened:
        read, spoilt = sound_photographs(photographs)
        for sentence in (*in_short(spoilt), *folders_not_looked_into(photographs).values()):
            output.progress.print(f"left out: {plain(sentence)}", soft_wrap=True)
        told = located(read, photographs, exposures or (), code=code, arm=arm, heights=above)
        read = told.photographs
        for sentence in told.sentences:
            output.say(sentence)
        given = None
        if surveyed:
            look = target_looker(target, {p.name: p.path for p in read}) if target else None
            names, at = [p.name for p in read], [p.gps for p in read]
            given, code = flight_control(surveyed, control_epsg, names, at, look, code)
        camera = sensor_and_interior(read, pixel_mm, c_mm)
        distortion = distortion_model(model, camera.sensor)
        compared, count = photograph_pairs(read, pairs or usual_choice(read)), features or usual_count(len(read))
        output.screen.print(camera.origin, soft_wrap=True)
        output.say(f"{counted(len(read), 'photograph')}, {_in_words(compared)}")
        keep = opened.enter_context(KeptPieces(beside(out)).alone())
        matched = match_photographs(
            read,
            camera.sensor,
            camera.interior,
            compared,
            count=count,
            longest_px=longest_px,
            in_parts=True,
            keep=keep,
            progress=StepsLeft(output.progress, status, FEWER_PAIRS),
        )
        names, start = [p.name for p in read], camera.interior
        taken = {p.name: (p.taken.clock_s, p.taken.resolution_s) for p in read if p.taken}
        flight = calibrate_flight(
            matched.named(names),
            camera.sensor,
            InteriorOrientation(start.c, start.x_p, start.y_p, distortion),
            KnownOfFlight(
                {p.name: p.gps for p in read},
                {p.name: p.attitude for p in read},
                code,
                given,
                None if no_lens_prior else known_lens(read, camera, distortion),
                taken if rolling_shutter else None,
                vertical,
                sorted(taken, key=lambda name: taken[name][0]) if len(taken) == len(read) else (),
            ),
            status.update,
        )
        flight = flight._replace(left_out=matched.left_out | flight.left_out)
        status.update("computing statistics")
        reports = [report_of(part) for part in flight.parts]
        options = {
            "pairs": pairs or usual_choice(read),
            "epsg": epsg,
            "features": count,
            "longest_px": longest_px,
            "c_mm": c_mm,
            "pixel_mm": pixel_mm,
            "model": model,
            "lens_prior": not no_lens_prior,
            "rolling_shutter": rolling_shutter,
            "lever_arm": lever_arm,
            "heights": heights,
            "control_epsg": control_epsg,
            "targets": targets,
        }
        beside_them = [path for folder in photographs if folder.is_dir() for path in exposure_files(folder)]
        others = dict.fromkeys([*filter(None, (control, marks)), *(exposures or ()), *beside_them])
        signed = Provenance.of([p.path for p in read], list(others), options)
        status.update(f"writing {out}")
        with whole_folder(out) as work:
            write_photograph_files({p.name: p.path.name for p in read}, work)
            source = FlightSource(
                told.sentences,
                camera.origin,
                start,
                taken,
                signed.conditions_for(flight.parts[0].adjusted.block.images),
                signed.inputs,
                signed.told,
                datetime.date.today().isoformat(),
                typed(context),
            )
            sign = lambda part, folder: signed.write(part.adjusted.block.images, folder)  # noqa: E731
            verdict = write_flight(flight, reports, spoilt, work, source, sign)
            for number, part in enumerate(flight.parts, 1):
                with whole_block(part.adjusted.block, work / block_folder(number)) as folder:
                    write_part_orientation(part, folder)
                    sign(part, folder)
            why_not = signed.certify(work)
        keep.remove()
    for number, part in enumerate(flight.parts, 1):
        report = part.oriented.report
        sizes = f"{len(report.order)} photographs, {report.n_image_points} image points, {report.mean_px:.2f} px"
        output.say(f"part {number}: {sizes}")
        for sentence in camera_sentences(reports[number - 1]):
            output.say(f"  {sentence}")
        for sentence in part.placed.sentences if part.placed else (part.why_not,):
            output.say(f"  {plain(sentence)}")
        for sentence in part.controlled.sentences if part.controlled else ():
            output.say(f"  {plain(sentence)}")
    for name, why in flight.left_out.items():
        output.say(f"{name} is not used: {why}")
    output.say(verdict.headline)
    for finding in verdict.findings:
        if finding.level > Level.INFORMATION:
            output.say(f"  {finding.text}")
    if why_not:
        output.say(f"no certificate: {why_not}")
    output.wrote(out, f"results in {out} (open report.html)")
    if verdict.level == Level.ALARM:
        raise typer.Exit(1)


def _in_words(compared: list[tuple[int, int]] | MostSimilar) -> str:
    if isinstance(compared, MostSimilar):
        return f"each to compare with the {compared.number} that look most like it"
    return f"{counted(len(compared), 'pair')} to compare"
